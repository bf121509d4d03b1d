"""How a batch goes, on the screen: a live table on a terminal, a line for every change elsewhere."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rich.console
import rich.live
import rich.markup
import rich.table

from avatarbuild.batch.jobs import Job, Outcome
from avatarbuild.report.html import duration

_BEGINS = re.compile(rb"INFO avatarbuild\.pipeline: stage (\w+) begins")
_TAIL = 65536
_STYLES = {"done": "green", "failed": "red", "running": "bold", "waiting": "dim", "stopped": "yellow"}


@dataclass
class _Line:
    state: str = "waiting"
    stage: str = ""
    begun: float = 0.0
    seconds: float = 0.0
    message: str = ""


class Board:
    """
    What is known of every subject while the batch runs. Where a run is, its project's log tells, wherever it runs:
    it lies on the shared folder.
    """

    def __init__(self, jobs: list[Job], screen: rich.console.Console) -> None:
        self.logs = {job.subject: job.project / "avatarbuild.log" for job in jobs}
        self.sizes = {subject: _size(path) for subject, path in self.logs.items()}
        self.lines = {job.subject: _Line() for job in jobs}
        self.screen = screen
        self.live: rich.live.Live | None = None

    def __enter__(self) -> Board:
        if self.screen.is_terminal:
            self.live = rich.live.Live(console=self.screen, auto_refresh=False, get_renderable=self._table)
            self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.live:
            self.live.stop()

    def look(self) -> None:
        """Reads where each run is."""
        for subject, line in self.lines.items():
            if line.state not in ("waiting", "running"):
                continue
            size = _size(self.logs[subject])
            if size == self.sizes[subject]:
                continue
            if line.state == "waiting":
                line.state, line.begun = "running", time.monotonic()
            stage = _stage(self.logs[subject], self.sizes[subject])
            if stage and stage != line.stage:
                line.stage = stage
                self._say(f"{subject}: {stage}")
        self._draw()

    def ended(self, outcome: Outcome) -> None:
        """A subject's run is over."""
        line = self.lines[outcome.subject]
        line.state = {"": "done", "stopped": "stopped"}.get(outcome.reason, "failed")
        line.seconds, line.message = outcome.seconds, outcome.message
        done = sum(one.state in ("done", "failed") for one in self.lines.values())
        where = f" on {outcome.worker}" if outcome.worker else ""
        text = f"{outcome.subject}: {line.state} after {duration(outcome.seconds)}{where}, {outcome.peak / 1e9:.1f} GB"
        self._say(f"{text} ({done} of {len(self.lines)}){'; ' if line.message else ''}{line.message}")
        self._draw()

    def _say(self, text: str) -> None:
        if not self.live:
            self.screen.print(rich.markup.escape(text), soft_wrap=True)

    def _draw(self) -> None:
        if self.live:
            self.live.refresh()

    def _table(self) -> rich.table.Table:
        table = rich.table.Table("subject", "state", "stage", "time", "", box=None)
        counts: dict[str, int] = {}
        for line in self.lines.values():
            counts[line.state] = counts.get(line.state, 0) + 1
        # what matters first, as many as fit
        order = ("running", "failed", "stopped", "done", "waiting")
        fitting = max(self.screen.height - 4, 5)
        shown: list[tuple[str, Any]] = sorted(self.lines.items(), key=lambda item: order.index(item[1].state))[:fitting]
        kept = {name for name, _ in shown}
        for name, line in self.lines.items():
            if name in kept:
                seconds = time.monotonic() - line.begun if line.state == "running" else line.seconds
                state = f"[{_STYLES[line.state]}]{line.state}[/]"
                time_ = duration(seconds) if seconds else ""
                table.add_row(rich.markup.escape(name), state, line.stage, time_, rich.markup.escape(line.message))
        table.caption = ", ".join(f"{number} {state}" for state, number in counts.items())
        return table


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _stage(log: Path, after: int) -> str:
    """The stage that began last, of what was written to a log after its first `after` bytes."""
    try:
        with log.open("rb") as file:
            file.seek(max(after, _size(log) - _TAIL))
            found = _BEGINS.findall(file.read())
    except OSError:
        return ""
    return found[-1].decode() if found else ""

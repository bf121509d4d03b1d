"""`avatarbuild batch` as a function: jobs made, run, shown and summed up."""

from __future__ import annotations

import contextlib
import logging
import os
import time
import uuid
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

import rich.console
import rich.markup

from avatarbuild.batch import cluster, summary, workers
from avatarbuild.batch.board import Board
from avatarbuild.batch.jobs import Job, Outcome, find_captures
from avatarbuild.errors import InputError
from avatarbuild.whole_file import whole_file

_EVERY = 60.0  # seconds between two summaries while the batch runs


@dataclass(frozen=True)
class Means:
    """With what a batch is run: the options of the command, None where they are not given; memory in bytes."""

    workers: int | None = None
    threads: int | None = None
    memory: int | None = None
    seconds: float | None = None
    scheduler: str | None = None


def run_batch(
    captures: Path, output: Path, words: list[str], until: str | None, means: Means, screen: rich.console.Console
) -> list[summary.Row]:
    """
    Brings the project OUTPUT/NAME.avatar of every capture CAPTURES/NAME up to date, and writes summary.csv and
    index.html, also where it is stopped. words: the options of `avatarbuild run`.

    Raises InputError where the folders cannot serve; what befalls one subject is in its row.
    """
    output = Path(os.path.abspath(output))
    found = find_captures(captures, output)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{output} cannot be made ({error.strerror}): name another folder with -o") from None
    batch = uuid.uuid4().hex  # names the claims of this run, and reaches no output
    jobs = [
        Job(
            *(path.name, path, output / f"{path.name}.avatar", tuple(words), batch),
            threads=means.threads,
            memory=means.memory,
            seconds=means.seconds,
        )
        for path in found
    ]
    outcomes: dict[str, Outcome] = {}
    with _warnings_on(screen), Board(jobs, screen) as board:
        told = time.monotonic()
        try:
            with contextlib.closing(_outcomes(jobs, means)) as coming:  # Ctrl-C ends the runs before the summary
                for outcome in coming:
                    if outcome is not None:
                        outcomes[outcome.subject] = outcome
                        board.ended(outcome)
                        if time.monotonic() - told > _EVERY:
                            _write(jobs, outcomes, until, output)
                            told = time.monotonic()
                    board.look()
        finally:
            made = _write(jobs, outcomes, until, output)
    return made


def _outcomes(jobs: list[Job], means: Means) -> Generator[Outcome | None, None, None]:
    if means.scheduler is not None:
        return cluster.on_cluster(jobs, means.scheduler)
    shared = workers.share(means.workers, means.threads, means.memory, len(jobs))
    return workers.on_this_machine(jobs, shared)


def _write(jobs: list[Job], outcomes: dict[str, Outcome], until: str | None, output: Path) -> list[summary.Row]:
    made = summary.rows(jobs, outcomes, until)
    projects = {job.subject: job.project for job in jobs}
    for name, data in (("summary.csv", summary.table(made)), ("index.html", summary.page(made, projects))):
        with whole_file(output / name, "free some space") as partial:
            partial.write_bytes(data)
    return made


@contextlib.contextmanager
def _warnings_on(screen: rich.console.Console) -> Iterator[None]:
    class Lines(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            screen.print(f"[yellow]warning[/] {rich.markup.escape(record.getMessage())}", soft_wrap=True)

    batch = logging.getLogger("avatarbuild.batch")
    lines = Lines(logging.WARNING)
    batch.addHandler(lines)
    try:
        yield
    finally:
        batch.removeHandler(lines)

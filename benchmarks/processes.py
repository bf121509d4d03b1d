"""What a process and its children cost, for the benchmarks that run the whole program."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

from avatarbuild.batch.subject import held_memory

CLI = Path(__file__).parent.parent / "cli.py"


class Cost(NamedTuple):
    """Seconds, the processor's seconds, the largest memory held at one moment (GB); children are included."""

    seconds: float
    core_seconds: float
    peak: float
    code: int


def run(words: list, environment: dict[str, str] | None = None) -> Cost:
    """Runs `avatarbuild WORDS` and says on the standard error what it said, where it fails."""
    before, begun, peak = os.times(), time.perf_counter(), 0
    command = [sys.executable, str(CLI), *map(str, words)]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env={**os.environ, **(environment or {})}
    )
    while True:
        try:
            _, said = process.communicate(timeout=0.2)
            break
        except subprocess.TimeoutExpired:
            peak = max(peak, held_memory(process.pid))
    after = os.times()
    used = after.children_user + after.children_system - before.children_user - before.children_system
    if process.returncode:
        line = said.decode(errors="replace").strip().splitlines()[-1:]
        print(f"{words[0]} ended with {process.returncode}: {line}", file=sys.stderr)
    return Cost(time.perf_counter() - begun, used, peak / 1e9, process.returncode)

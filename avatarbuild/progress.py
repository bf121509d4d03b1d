"""How a stage tells what it is doing, without knowing who listens."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Protocol


class Task(Protocol):
    """A piece of work of known length."""

    def advance(self, n: float = 1) -> None:
        """Says that n more units are done."""


class Progress(Protocol):
    """What a stage function receives; the command line shows bars with an estimate, tests use `Silent`."""

    def task(self, label: str, total: float) -> contextlib.AbstractContextManager[Task]:
        """Opens a task of `total` units, shown under `label` until the context ends."""


class _SilentTask:
    def advance(self, n: float = 1) -> None:
        pass


class Silent:
    """Shows nothing."""

    @contextlib.contextmanager
    def task(self, label: str, total: float) -> Iterator[Task]:
        yield _SilentTask()

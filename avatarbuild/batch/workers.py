"""A batch on this machine: how many runs at once, and their pool."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import threading
from collections.abc import Generator
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

import psutil

from avatarbuild.batch.jobs import Job, Outcome
from avatarbuild.batch.subject import build
from avatarbuild.errors import InputError
from avatarbuild.parallel import cores

log = logging.getLogger(__name__)

NEEDED = 6_000_000_000  # bytes: what a capture of 50 photos and a minute of video takes at most, and a margin
_KEPT_FREE = 0.1  # share of the free memory that no run is given


class Share(NamedTuple):
    """How many runs at once; each one's threads and bytes of memory; all bytes that may be given to one alone."""

    workers: int
    threads: int
    memory: int
    whole: int


def share(workers: int | None, threads: int | None, memory: int | None, jobs: int) -> Share:
    """
    Divides the machine: by default as many workers as memory allows, at most one a core.

    memory: bytes a worker, None: 6 GB are needed, and all free memory is divided. Fewer workers than asked for where
    the memory would not do, with a warning.

    Raises InputError for numbers below one.
    """
    for name, value in (("--workers", workers), ("--threads", threads), ("--memory", memory)):
        if value is not None and value < 1:
            raise InputError(f"{name} must be at least 1" if name != "--memory" else "--memory must be above 0 GB")
    whole = int((1 - _KEPT_FREE) * free_memory())
    fitting = max(1, whole // (memory or NEEDED))
    wanted = workers or cores()
    count = min(wanted, fitting, max(jobs, 1))
    if workers is not None and fitting < min(workers, jobs):
        log.warning(
            "%d workers instead of %d: %.1f GB are free, and each needs %.1f GB (see --memory)",
            *(count, workers, whole / 1e9, (memory or NEEDED) / 1e9),
        )
    each = memory or whole // count
    return Share(count, threads or max(1, cores() // count), each, max(whole, each))


def free_memory() -> int:
    """Bytes that this process and its children may still take: the machine's, or its container's."""
    free = psutil.virtual_memory().available
    with contextlib.suppress(OSError, ValueError):
        group = Path("/sys/fs/cgroup")
        used = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        free = min(free, int((group / "memory.max").read_text()) - int(used["anon"]))
    return free


def on_this_machine(jobs: list[Job], shared: Share) -> Generator[Outcome | None, None, None]:
    """
    Yields each job's outcome as it ends, and None about once a second between.

    A run that outgrew its share of memory is tried again when all others have ended, alone with all of it.
    """
    stop = threading.Event()
    given = [dataclasses.replace(job, threads=shared.threads, memory=shared.memory) for job in jobs]
    outgrown = []
    pool = ThreadPoolExecutor(shared.workers)
    try:
        waiting = {pool.submit(build, job, stop) for job in given}
        while waiting:
            ended, waiting = wait(waiting, timeout=1.0, return_when=FIRST_COMPLETED)
            for future in ended:
                outcome = future.result()
                if outcome.reason == "memory" and shared.whole > shared.memory:
                    log.warning("%s: %s; it is tried again alone, at the end", outcome.subject, outcome.message)
                    outgrown.append(outcome.subject)
                    continue
                yield outcome
            yield None
        for job in given:
            if job.subject in outgrown:
                alone = dataclasses.replace(job, memory=shared.whole, threads=max(shared.threads, cores()))
                future = pool.submit(build, alone, stop)
                while not wait([future], timeout=1.0).done:
                    yield None
                yield future.result()
    finally:
        stop.set()
        pool.shutdown(cancel_futures=True)

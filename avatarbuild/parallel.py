"""Work shared among the processor's cores, with results that do not depend on their number."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


THREADS = "AVATARBUILD_THREADS"  # variable: how many processors to use where others work on the machine too


def cores() -> int:
    """Processors that this process may use."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    told = os.environ.get(THREADS, "")
    return min(there, int(told)) if told.isdecimal() and int(told) else there


def in_order(function: Callable[[T], R], items: Iterable[T], ahead: int = 4) -> Iterator[R]:
    """function(item) of each item in order, computed by as many threads as there are cores, a few items ahead."""
    with ThreadPoolExecutor(cores()) as pool:
        yield from _ordered(pool, function, items, cores() + ahead)


def each_alone(function: Callable[[T], R], items: Iterable[T], ahead: int = 4) -> Iterator[R]:
    """
    `in_order` where the libraries' own threads rest: work of many small array expressions and kernels, each on the one
    thread that has its item, takes a sixth of the time that threads within threads waste on waiting for one another.
    """
    import numba

    with _libraries_alone(), ThreadPoolExecutor(cores(), initializer=numba.set_num_threads, initargs=(1,)) as pool:
        yield from _ordered(pool, function, items, cores() + ahead)


def in_processes(function: Callable[[T], R], items: Iterable[T], ahead: int = 1) -> Iterator[R]:
    """
    The same by processes, for compiled code that keeps Python's lock; function and items must be picklable.

    Processes are spawned, since GNU OpenMP and forks abort: a script that calls this needs the usual
    `if __name__ == "__main__"`.
    """
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(cores(), mp_context=spawn, initializer=_end_with_parent) as pool:
        yield from _ordered(pool, function, items, cores() + ahead)


@contextmanager
def _libraries_alone() -> Iterator[None]:
    import cv2
    import threadpoolctl

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpoolctl.threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(before)


def _ordered(pool: Executor, function: Callable[[T], R], items: Iterable[T], most: int) -> Iterator[R]:
    waiting: list[Future[R]] = []
    try:
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) >= most:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for work for ever."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()

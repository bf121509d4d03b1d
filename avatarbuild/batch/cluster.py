"""A batch on a Dask cluster: one capture a task, files in, files out, on a folder that all workers share."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Generator
from typing import Any

from avatarbuild.batch import claims
from avatarbuild.batch.jobs import Job, Outcome
from avatarbuild.batch.subject import build
from avatarbuild.errors import InputError
from avatarbuild.parallel import cores

log = logging.getLogger(__name__)

PATIENCE = 600.0  # seconds that a scheduler may be gone
_CONNECT = 10.0
_ELSEWHERE = 120.0  # seconds that a failed run waits for another worker to appear, at least
_LONELY = 30.0


def on_cluster(jobs: list[Job], address: str) -> Generator[Outcome | None, None, None]:
    """
    Yields each job's outcome as it ends, and None about once a second between.

    Dask gives the task of a worker that dies to another one. A run that fails is tried once more on another worker,
    since from afar nobody can tell a bad capture from a machine whose disk is full or whose folder is not mounted; not
    one that ran out of time. When the scheduler has gone and come back, what is not done is handed in again.

    Raises InputError where `distributed` is not installed, and where no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler needs the package `distributed`: pip install 'avatarbuild[cluster]'") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters of it is said here
    left = {job.subject: job for job in jobs}
    refused: dict[str, set[str]] = {}
    gone: float | None = None
    known = False
    try:
        while left:
            try:
                with Client(address, timeout=_CONNECT, set_as_default=False, name="avatarbuild-batch") as client:
                    if gone is not None:
                        log.warning("the scheduler at %s is back", address)
                    gone, known = None, True
                    yield from _gathered(client, left, refused)
            except (OSError, ValueError, TimeoutError) as error:
                if not known:
                    raise InputError(f"no Dask scheduler answers at {address} ({_line(error)}): start one") from None
                if gone is None:
                    log.warning("the scheduler at %s is gone; waiting for it", address)
                    gone = time.monotonic()
                elif time.monotonic() - gone > PATIENCE:
                    raise InputError(
                        f"the scheduler at {address} has been gone for {PATIENCE / 60:g} minutes: start it and run the "
                        "batch again, which goes on from here"
                    ) from None
                yield None
                time.sleep(1.0)
    finally:
        if left:
            claims.revoke(jobs[0].claims, jobs[0].batch)


def build_on_worker(job: Job) -> Outcome:
    """`build` with this worker's share of the threads and of the memory that it was started with."""
    from distributed import get_worker

    worker = get_worker()
    places = worker.state.nthreads
    limit = worker.memory_manager.memory_limit
    given = dataclasses.replace(
        job,
        threads=job.threads or max(1, cores() // places),
        memory=job.memory or (limit // places if limit else None),
    )
    return dataclasses.replace(build(given), worker=str(worker.name))


def _gathered(client: Any, left: dict[str, Job], refused: dict[str, set[str]]) -> Generator[Outcome | None, None, None]:
    """
    Hands in what is left and takes jobs out of `left` as they end. refused: the workers, by name, on which a subject
    failed. Raises ConnectionError where the scheduler goes.
    """
    futures: dict[Any, tuple[Job, set[str]]] = {}
    held: list[tuple[float, Job, Outcome | None]] = []

    def hand_in(job: Job, addresses: set[str]) -> None:
        only = {"workers": sorted(addresses)} if addresses else {}
        futures[client.submit(build_on_worker, job, pure=False, **only)] = (job, addresses)

    for job in left.values():
        if job.subject in refused:
            held.append((time.monotonic(), job, None))
        else:
            hand_in(job, set())
    lonely: float | None = time.monotonic()
    while futures or held:
        if client.status != "running":
            raise ConnectionError(client.status)
        workers = _workers(client)
        for future in [future for future in futures if future.status != "pending"]:
            job, _ = futures.pop(future)
            if future.status in ("cancelled", "lost"):
                raise ConnectionError(future.status)
            outcome = _outcome(future, job)
            if outcome.reason not in ("", "time"):
                refused.setdefault(job.subject, set()).add(outcome.worker)
                if len(refused[job.subject]) < 2:
                    held.append((time.monotonic(), job, outcome))
                    continue
            del left[job.subject]
            yield outcome
        for future, (job, addresses) in list(futures.items()):
            if addresses and not addresses & workers.keys():  # all that it was meant for are gone
                del futures[future]
                future.cancel()
                held.append((time.monotonic(), job, None))
        for since, job, last in held.copy():
            others = {address for address, name in workers.items() if name not in refused[job.subject]}
            if not others and (futures or time.monotonic() - since < _ELSEWHERE):
                continue
            held.remove((since, job, last))
            if others or last is None:
                if last is not None:
                    log.warning("%s: %s; it is tried on another worker", job.subject, last.message)
                hand_in(job, others)
            else:
                del left[job.subject]
                yield last
        if lonely is not None and time.monotonic() - lonely > _LONELY:
            if not workers:
                log.warning("the scheduler has no workers: start some with `dask worker %s`", client.scheduler.address)
            lonely = None
        yield None
        time.sleep(0.5)


def _outcome(future: Any, job: Job) -> Outcome:
    if future.status == "error":
        error = future.exception(timeout=_CONNECT)
        if type(error).__name__ == "KilledWorker":
            return Outcome(job.subject, "died", "every worker that had it died: is there memory enough?", 0.0, 0)
        return Outcome(job.subject, "fault", f"{type(error).__name__}: {_line(error)}", 0.0, 0)
    return future.result(timeout=_CONNECT)


def _workers(client: Any) -> dict[str, str]:
    """Address -> name; a worker that is started again has another address."""
    return {address: str(about["name"]) for address, about in client.scheduler_info(n_workers=-1)["workers"].items()}


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__

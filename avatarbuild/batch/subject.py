"""One subject of a batch: its run in a process of its own, watched for time, memory and its claim."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import IO

import psutil

import avatarbuild
from avatarbuild.batch.claims import Claim, claim
from avatarbuild.batch.jobs import Job, Outcome
from avatarbuild.errors import InputError
from avatarbuild.parallel import THREADS, cores

COMMAND = (sys.executable, "-m", "avatarbuild.batch.process", "run")
_LOOK = 0.25  # seconds between two looks at a run
_WAIT = 2.0  # between two attempts at a subject that another process has
_THREADS_OF_LIBRARIES = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"),
    "OPENIMAGEIO_THREADS",
)


def build(job: Job, stop: threading.Event | None = None) -> Outcome:
    """
    Brings a job's project up to date, in a process that ends with this one.

    Where somebody else works on the subject, waits until that ends; what is then fresh is not made again. A run that
    takes more than its time or memory is ended, as a killed one is: finished stages are kept.
    """
    stop = stop or threading.Event()
    begun = time.monotonic()
    try:
        while (held := claim(job.claims, job.project.name, job.batch)) is None:
            if stop.wait(_WAIT):
                return Outcome(job.subject, "stopped", "stopped before it began", 0.0, 0)
        try:
            return dataclasses.replace(_run(job, held, stop), seconds=time.monotonic() - begun)
        finally:
            held.release()
    except InputError as error:
        return Outcome(job.subject, "input", str(error), time.monotonic() - begun, 0)
    except OSError as error:  # no process can be begun, say: this subject's fault and not the batch's end
        return Outcome(job.subject, "fault", f"{type(error).__name__}: {error}", time.monotonic() - begun, 0)


def _run(job: Job, held: Claim, stop: threading.Event) -> Outcome:
    environment = {**os.environ, **one_share(job.threads or cores())}
    # the program may run from a checkout, without being installed
    paths = [str(Path(avatarbuild.__file__).parent.parent), os.environ.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)
    command = [*COMMAND, str(job.capture), "-o", str(job.project)]
    begun, peak = time.monotonic(), 0
    with tempfile.TemporaryFile() as said:
        run = subprocess.Popen(
            [*command, *job.words],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=said,
            env=environment,
            start_new_session=True,  # Ctrl-C is the batch's to answer
        )
        try:
            while run.poll() is None:
                used = held_memory(run.pid)
                peak = max(peak, used)
                ended = _must_end(job, used, time.monotonic() - begun)
                if not ended and (stop.is_set() or not held.holds()):
                    ended = ("stopped", "stopped; the same command goes on from here")
                if ended:
                    return Outcome(job.subject, *ended, 0.0, peak)
                time.sleep(_LOOK)
        finally:
            _end(run)
        return Outcome(job.subject, *_verdict(run.returncode, said), 0.0, peak)


def one_share(threads: int) -> dict[str, str]:
    """Variables of a process that shall compute with so many threads."""
    return dict.fromkeys((*_THREADS_OF_LIBRARIES, THREADS), str(threads))


def _must_end(job: Job, used: int, seconds: float) -> tuple[str, str] | None:
    if job.seconds is not None and seconds > job.seconds:
        return "time", (
            f"stopped after {job.seconds / 60:g} minutes, its time limit: raise --time-limit and run the batch again, "
            "finished stages are kept"
        )
    if job.memory is not None and used > job.memory:
        return "memory", (
            f"stopped at {used / 1e9:.1f} GB, its share of memory is {job.memory / 1e9:.1f} GB: give fewer --workers, "
            "more --memory, or --quality draft"
        )
    return None


def held_memory(process: int) -> int:
    """Bytes that a process and its children hold in memory; 0 where it has just ended."""
    total = 0
    try:
        top = psutil.Process(process)
        family = [top, *top.children(recursive=True)]
    except psutil.Error:
        return 0
    for one in family:
        try:
            total += one.memory_info().rss
        except psutil.Error:
            continue
    return total


def _end(run: subprocess.Popen) -> None:
    """Ends a run and its children, and waits until they are gone."""
    try:
        family = psutil.Process(run.pid).children(recursive=True) if run.poll() is None else []
    except psutil.Error:
        family = []
    run.kill()
    for one in family:
        try:
            one.kill()
        except psutil.Error:
            continue
    run.wait()
    psutil.wait_procs(family, timeout=10)
    if run.stdin:
        run.stdin.close()


def _verdict(code: int, said: IO[bytes]) -> tuple[str, str]:
    said.seek(0)
    lines = said.read().decode(errors="replace").splitlines()
    if code == 0:
        return "", ""
    told = [line.partition(" ")[2] for line in lines if line.startswith(("error ", "fault "))]
    last = told[-1] if told else next((line for line in reversed(lines) if line.strip()), "it said nothing")
    if code == 2:
        return "input", last
    if code < 0:
        return "died", f"its process was ended by signal {-code}: run the batch again, finished stages are kept"
    return "fault", last

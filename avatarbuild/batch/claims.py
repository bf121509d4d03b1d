"""
Claims: who works on a subject, told by files on the folder that all share, so that nobody starts it twice.

The lock of a project is the operating system's, and on some network file systems it is known to one host only. A claim
is a file NAME.NUMBER that is made in one step or not at all. Its holder renews it every few seconds. One whose file has
not been renewed for STALE seconds, by the file system's own clock, or whose process is gone from this host, is taken
over by making NAME.(NUMBER + 1), which one alone can do; a former holder that comes back to life finds the higher
number, or none, and stops.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
import time
from pathlib import Path

import psutil

from avatarbuild.errors import InputError

STALE = 180.0  # seconds
RENEWED = 5.0


class Claim:
    """A held claim; `holds` renews it and tells whether it is still ours."""

    def __init__(self, folder: Path, name: str, number: int) -> None:
        self.folder, self.name, self.number = folder, name, number
        self.path = folder / f"{name}.{number}"
        self.renewed = time.monotonic()

    def holds(self) -> bool:
        """False where somebody has taken it over or revoked it."""
        if time.monotonic() - self.renewed < RENEWED:
            return True
        try:
            os.utime(self.path)
            highest = _highest(self.folder, self.name)
        except FileNotFoundError:
            return False
        except OSError:  # a shared folder that does not answer for a moment
            return time.monotonic() - self.renewed < STALE
        self.renewed = time.monotonic()
        return highest == self.number

    def release(self) -> None:
        """Lets the subject go, and clears away what dead holders left."""
        with contextlib.suppress(OSError):
            if _highest(self.folder, self.name) == self.number:
                for number in _numbers(self.folder, self.name):
                    (self.folder / f"{self.name}.{number}").unlink(missing_ok=True)


def claim(folder: Path, name: str, batch: str) -> Claim | None:
    """
    Claims a subject; None where somebody alive holds it.

    Raises InputError where the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        number = _highest(folder, name)
        if number is not None and _alive(folder / f"{name}.{number}"):
            return None
        made = Claim(folder, name, 0 if number is None else number + 1)
        with made.path.open("x", encoding="utf-8") as file:
            json.dump({"host": socket.gethostname(), "process": _process(os.getpid()), "batch": batch}, file)
    except FileExistsError:
        return None
    except OSError as error:
        raise InputError(f"{folder} cannot be written ({error.strerror}): name another folder with -o") from None
    return made


def revoke(folder: Path, batch: str) -> None:
    """Takes back all claims of a batch: whoever works for it stops within seconds."""
    for path in folder.glob("*.*"):
        if _told(path).get("batch") == batch:
            with contextlib.suppress(OSError):
                path.unlink()


def _numbers(folder: Path, name: str) -> list[int]:
    endings = [path.name.removeprefix(name + ".") for path in folder.iterdir() if path.name.startswith(name + ".")]
    return sorted(int(ending) for ending in endings if ending.isdecimal())


def _highest(folder: Path, name: str) -> int | None:
    return max(_numbers(folder, name), default=None)


def _alive(path: Path) -> bool:
    told = _told(path)
    if told.get("host") == socket.gethostname() and "process" in told:
        return _process(told["process"][0]) == told["process"]
    try:
        return _now(path.parent) - path.stat().st_mtime < STALE
    except FileNotFoundError:
        return False


def _now(folder: Path) -> float:
    """The time of the file system's clock: hosts' clocks differ."""
    probe = folder / f".clock-{socket.gethostname()}-{os.getpid()}-{threading.get_ident()}"
    probe.touch()
    try:
        return probe.stat().st_mtime
    finally:
        probe.unlink(missing_ok=True)


def _told(path: Path) -> dict:
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # being made at this moment
        return {}
    return told if isinstance(told, dict) else {}


def _process(number: int) -> list[float] | None:
    """[number, when it began], since numbers are given again; None where it has ended, waited for or not."""
    try:
        process = psutil.Process(number)
        return None if process.status() == psutil.STATUS_ZOMBIE else [number, process.create_time()]
    except psutil.Error:
        return None

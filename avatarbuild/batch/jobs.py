"""The subjects of a batch: which sub-folders are captures, and what is to be done for each."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from avatarbuild.capture_folder import SETTINGS, natural
from avatarbuild.errors import InputError
from avatarbuild.formats.images import is_photo
from avatarbuild.formats.video import is_video

CLAIMS = ".claims"
_PASSED_OVER = (".avatar", ".truth")  # projects, and what `simulate` knows of a capture
_OF_ONE_CAPTURE = {"photos", "video", "videos"}


@dataclass(frozen=True)
class Job:
    """
    One capture's run, as it is handed to a worker. Paths are absolute, on a folder that all workers share.

    words    the options of `avatarbuild run`;  batch: which batch asks
    threads  None: the worker's cores, divided among its places
    memory   bytes that the run may take, its children's included; None: what the worker was given
    seconds  after which the run is stopped; None: never
    """

    subject: str
    capture: Path
    project: Path
    words: tuple[str, ...] = ()
    batch: str = ""
    threads: int | None = None
    memory: int | None = None
    seconds: float | None = None

    @property
    def claims(self) -> Path:
        """Where those who work on a subject say so."""
        return self.project.parent / CLAIMS


@dataclass(frozen=True)
class Outcome:
    """
    What became of a job.

    reason   '' where all is done; 'input' (exit code 2), 'fault' (1), 'time', 'memory', 'died' (ended by a signal),
             'stopped' (from outside)
    message  one line for the user;  seconds, peak (bytes) of this run;  worker: where it ran, '' for this machine
    """

    subject: str
    reason: str
    message: str
    seconds: float
    peak: int
    worker: str = ""


def find_captures(folder: Path, output: Path) -> list[Path]:
    """
    The sub-folders of a folder, by natural name; hidden ones, projects, truths and `output` are passed over.

    Raises InputError where there is none, or the folder is itself a capture.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder: name the one whose sub-folders are captures")
    try:
        entries = sorted(folder.iterdir(), key=lambda path: natural(path.name))
    except OSError as error:
        raise InputError(f"{folder} cannot be read ({error.strerror}): check its permissions") from None
    found = [
        path
        for path in entries
        if path.is_dir()
        and not path.name.startswith((".", "__MACOSX"))
        and not path.name.endswith(_PASSED_OVER)
        and not (path / "project.toml").is_file()
        and not (output.exists() and path.samefile(output))
    ]
    own = [path.name for path in entries if path.name == SETTINGS or is_photo(path) or is_video(path)]
    if own or (found and {path.name.casefold() for path in found} <= _OF_ONE_CAPTURE):
        what = own[0] if own else found[0].name
        raise InputError(
            f"{folder} looks like one capture (it holds {what}): for one, `avatarbuild run`; for many, name the "
            "folder whose sub-folders are captures"
        )
    if not found:
        raise InputError(f"{folder} has no sub-folder that could be a capture: put each person's files in one")
    return [Path(os.path.abspath(path)) for path in found]

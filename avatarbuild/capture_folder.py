"""A capture folder: which of its files are the photos, which may be the video, and what capture.toml says."""

from __future__ import annotations

import fnmatch
import hashlib
import os
import re
import tomllib
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from avatarbuild.errors import InputError
from avatarbuild.formats.images import is_photo
from avatarbuild.formats.video import is_video, open_video
from avatarbuild.options import nearest

SETTINGS = "capture.toml"
_KEYS = ("video", "photos", "exclude", "focal", "frontal", "known_length")
_MIN_SUBJECT_PHOTOS = 8
_LIVE_SECONDS = 5.0  # the moving half of a Live Photo or Motion Photo lasts about 3

# of the same picture in several formats, the one nearest to the sensor that every decoder reads comes first
_FORMATS = (".heic", ".heif", ".hif", ".jpg", ".jpeg", ".tif", ".tiff", ".png", ".dng")
# IMG_E1234 is IMG_1234 edited; the others are an editor's or a file manager's copies
_EDITED = re.compile(r"^(IMG_)E(\d{4,})$")
_COPY = re.compile(r"^(.+?)(?:[-_ ](?:edited|edit|copy|kopie|bearbeitet)|~\d+| \(\d+\)| \d{1,2})$", re.IGNORECASE)


@dataclass(frozen=True)
class CaptureFolder:
    """
    root       the folder
    photos     files relative to it, by natural name
    videos     files relative to it that may be the expression video; one alone where capture.toml names it
    settings   what capture.toml says, checked: see docs/capture-guide.md
    left_out   (file, reason) of what looks like a photo or video and is not used
    warnings   what the user should know
    subjects   subfolders that each look like a capture of their own
    """

    root: Path
    photos: list[Path]
    videos: list[Path]
    settings: dict[str, Any]
    left_out: list[tuple[Path, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    subjects: list[str] = field(default_factory=list)

    @property
    def files(self) -> list[Path]:
        """Every file that the avatar depends on, relative to the root."""
        settings = [Path(SETTINGS)] if (self.root / SETTINGS).is_file() else []
        return [*settings, *self.photos, *self.videos]


def natural(path: Path | str) -> tuple[Any, ...]:
    """A sorting key under which IMG_9 comes before IMG_10, whatever the letters' case."""
    parts = re.split(r"([0-9]+)", str(path).casefold())
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in parts], str(path)


def open_capture(root: Path) -> CaptureFolder:
    """
    Lists a capture folder. Hidden files and project folders are passed over, links are followed.

    Raises InputError if it is no folder, cannot be read, or capture.toml is faulty.
    """
    if not root.exists():
        raise InputError(f"{root} does not exist: give the folder that holds the photos and the video")
    if not root.is_dir():
        raise InputError(f"{root} is a file: give the folder that holds the photos and the video")
    files, warnings = _files(root)
    settings = read_settings(root)
    left_out: list[tuple[Path, str]] = []
    excluded = settings.get("exclude", [])
    for f in [f for f in files if any(_matches(f, pattern) for pattern in excluded)]:
        files.remove(f)
        left_out.append((f, f"excluded by {SETTINGS}"))
    photos = [f for f in files if is_photo(f)]
    videos = [f for f in files if is_video(f)]
    if "photos" in settings:
        photos = [f for f in photos if any(_matches(f, pattern) for pattern in settings["photos"])]
    photos = _without_copies(root, photos, left_out)
    if "video" in settings:
        named = Path(settings["video"])
        if not (root / named).is_file():
            raise InputError(f"{root / SETTINGS} names the video '{named}', which is not there: name one that is")
        videos = [named]
    else:
        pictures = {(p.parent, p.stem.casefold()) for p in photos}
        live = {v for v in videos if (v.parent, v.stem.casefold()) in pictures and _is_short(root / v)}
        left_out += [(v, "the moving half of a Live Photo") for v in videos if v in live]
        videos = [v for v in videos if v not in live]
    subjects = _subjects(photos, videos)
    return CaptureFolder(root, photos, videos, settings, left_out, warnings, subjects)


def read_settings(root: Path) -> dict[str, Any]:
    """capture.toml's settings, checked; {} without the file. Raises InputError."""
    path = root / SETTINGS
    if not path.is_file():
        return {}
    try:
        settings = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as e:
        raise InputError(f"{path}: {' '.join(str(e).split())}; correct it or remove the file") from e
    for key in settings:
        if key not in _KEYS:
            raise InputError(f"{path}: no setting '{key}', {nearest(key, list(_KEYS))}")
    for key in ("video", "frontal"):
        if not isinstance(settings.get(key, ""), str):
            raise InputError(f'{path}: {key} must be a file\'s name in quotes, such as {key} = "IMG_0001.JPG"')
    for key in ("photos", "exclude"):
        value = settings.get(key, [])
        value = [value] if isinstance(value, str) else value
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise InputError(f'{path}: {key} must be a list of names or patterns, such as {key} = ["photos/*.jpg"]')
        if key in settings:
            settings[key] = value
    focal = settings.get("focal", 26.0)
    if isinstance(focal, bool) or not isinstance(focal, int | float) or not 5 <= focal <= 400:
        raise InputError(f"{path}: focal is {focal!r}: the 35 mm equivalent in millimetres is needed, such as 26")
    if "known_length" in settings:
        settings["known_length"] = _known_length(path, settings["known_length"])
    return settings


def _known_length(path: Path, value: Any) -> dict[str, Any]:
    """{'mm': float, 'points': [{'photo': str, 'a': [x, y], 'b': [x, y]}, …]} or InputError."""
    form = '{mm = 85.6, points = [{photo = "IMG_0001.JPG", a = [812, 940], b = [1033, 951]}, …]}'
    try:
        length = float(value["mm"])
        points = [
            {"photo": str(p["photo"]), "a": [float(v) for v in p["a"]], "b": [float(v) for v in p["b"]]}
            for p in value["points"]
        ]
    except (KeyError, TypeError, ValueError) as e:
        raise InputError(f"{path}: known_length must be {form}") from e
    if not 1 <= length <= 5000:
        raise InputError(f"{path}: known_length is {length:g} mm: a length of 1 to 5000 mm in the scene is needed")
    if len({p["photo"] for p in points}) < 2 or any(len(p["a"]) != 2 or len(p["b"]) != 2 for p in points):
        raise InputError(f"{path}: known_length needs both ends, a = [x, y] and b = [x, y], in at least two photos")
    return {"mm": length, "points": points}


def _files(root: Path) -> tuple[list[Path], list[str]]:
    """All visible files under root, relative, by natural name; a warning for each folder that cannot be read."""
    found: list[Path] = []
    warnings: list[str] = []
    visited = set()

    def fault(e: OSError) -> None:
        if Path(e.filename or "") == root:
            raise InputError(f"{root} cannot be read ({e.strerror}): check its permissions") from e
        warnings.append(f"the folder {e.filename} cannot be read ({e.strerror}); its files are left out")

    for folder, folders, names in os.walk(root, followlinks=True, onerror=fault):
        real = os.path.realpath(folder)
        if real in visited:  # a link to a folder above it
            folders.clear()
            continue
        visited.add(real)
        folders[:] = sorted(f for f in folders if not f.startswith((".", "__MACOSX")) and not f.endswith(".avatar"))
        if folder != str(root) and "project.toml" in names:  # a project that was made inside the capture
            folders.clear()
            continue
        found += [Path(folder, name).relative_to(root) for name in names if not name.startswith(".")]
    return sorted((f for f in found if (root / f).is_file()), key=natural), warnings


def _without_copies(root: Path, photos: list[Path], left_out: list[tuple[Path, str]]) -> list[Path]:
    """The photos without edited copies, second formats of one picture and files of equal bytes."""
    by_stem: dict[tuple[Path, str], list[Path]] = defaultdict(list)
    for p in photos:
        by_stem[p.parent, p.stem.casefold()].append(p)
    kept = []
    for p in photos:
        original = _original_stem(p.stem)
        if original is not None and (p.parent, original.casefold()) in by_stem:
            left_out.append((p, f"an edited or second copy of {original}"))
            continue
        same = sorted(by_stem[p.parent, p.stem.casefold()], key=lambda q: (_FORMATS.index(q.suffix.lower()), str(q)))
        if same[0] != p:
            left_out.append((p, f"the same picture as {same[0].name}"))
            continue
        kept.append(p)
    return _without_equal_files(root, kept, left_out)


def _original_stem(stem: str) -> str | None:
    """The stem that an edited or copied file's original would have; None if the name is nobody's copy."""
    edited = _EDITED.match(stem)
    if edited:
        return edited[1] + edited[2]
    copied = _COPY.match(stem)
    return copied[1] if copied else None


def _without_equal_files(root: Path, photos: list[Path], left_out: list[tuple[Path, str]]) -> list[Path]:
    by_size: dict[int, list[Path]] = defaultdict(list)
    for p in photos:
        by_size[(root / p).stat().st_size].append(p)
    dropped = set()
    for size, same_size in by_size.items():
        first: dict[bytes, Path] = {}
        for p in same_size if size and len(same_size) > 1 else []:
            try:
                digest = hashlib.sha256((root / p).read_bytes()).digest()
            except OSError:  # told when the photo is read
                continue
            if digest in first:
                dropped.add(p)
                left_out.append((p, f"the same file as {first[digest]}"))
            first.setdefault(digest, p)
    return [p for p in photos if p not in dropped]


def _is_short(path: Path) -> bool:
    try:
        return open_video(path).duration <= _LIVE_SECONDS
    except InputError:  # told when the video is chosen
        return False


def _subjects(photos: list[Path], videos: list[Path]) -> list[str]:
    """Top subfolders that hold enough photos and a video each, if there are several."""
    count: dict[str, int] = defaultdict(int)
    for p in photos:
        if len(p.parts) > 1:
            count[p.parts[0]] += 1
    filmed = {v.parts[0] for v in videos if len(v.parts) > 1}
    subjects = sorted((s for s, n in count.items() if n >= _MIN_SUBJECT_PHOTOS and s in filmed), key=natural)
    return subjects if len(subjects) > 1 else []


def _matches(path: Path, pattern: str) -> bool:
    """Whether a relative path, or its name alone, matches a pattern, whatever the letters' case."""
    low = pattern.replace("\\", "/").casefold()
    return any(fnmatch.fnmatchcase(text.casefold(), low) for text in (path.as_posix(), path.name))

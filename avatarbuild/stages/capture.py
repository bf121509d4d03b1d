"""Stage capture: photos and video made upright and sRGB, the subject's landmarks, pose and expression in each."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from avatarbuild import judgement
from avatarbuild.artefacts import Capture, Clip
from avatarbuild.capture_folder import CaptureFolder, open_capture
from avatarbuild.errors import InputError
from avatarbuild.footage import read_clip
from avatarbuild.judgement import MIN_PHOTOS
from avatarbuild.options import CaptureOptions
from avatarbuild.progress import Progress
from avatarbuild.survey import (
    Survey,
    choose_video,
    read_photos,
    survey_photos,
    video_focal,
)

log = logging.getLogger(__name__)


def run(source: Path, options: CaptureOptions, progress: Progress) -> Capture:
    """
    Reads a capture folder.

    Raises InputError if it is no readable folder, holds several subjects' captures or fewer than 8 usable photos, or
    if capture.toml is faulty.
    """
    folder = open_capture(source)
    if folder.subjects:
        names = ", ".join(folder.subjects)
        raise InputError(f"{source} holds {len(folder.subjects)} captures ({names}): run on one of them, or use batch")
    with progress.task("photos", len(folder.photos)) as task:
        shots, faults = read_photos(folder, options.max_megapixels * 1e6, options.presence, options.jpeg_quality, task)
    if len(shots) < MIN_PHOTOS:
        raise InputError(_too_few(folder, len(shots), faults))
    warnings = [*folder.warnings, *(f"left out: {why}" for _, why in faults)]
    photos = survey_photos(shots, options.presence, folder.settings)
    clip, frames, more = _clip(folder, photos, options, progress)
    warnings += more
    trusted = photos.views.trusted(options.presence, options.max_yaw)
    face = judgement.has_face(photos, options.presence, options.max_yaw)
    seconds = 0.0 if clip is None else float(clip.times[-1])
    findings = judgement.judge(photos, frames, seconds, folder, options.presence, options.max_yaw)
    warnings += [f"{f.name}: {f.found}; {f.advice}" for f in findings if f.verdict != "good"]
    capture = Capture(
        photos=photos.views,
        clip=clip,
        frontal=_frontal(folder, photos, trusted) if face else -1,
        neutral=judgement.neutral(photos.views, trusted & face),
        face=face,
        settings=_settings(folder, photos, [shot.photo.size for shot in shots]),
        figures=_figures(photos, clip, trusted),
        warnings=warnings,
    )
    log.info("%s", ", ".join(f"{k} {v}" for k, v in capture.figures.items()))
    return capture


def _too_few(folder: CaptureFolder, usable: int, faults: list[tuple[Path, str]]) -> str:
    source = folder.root
    if not usable and not faults and folder.videos:
        return (
            f"{source} holds a video but no photos (JPEG, HEIC, PNG, TIFF): a video alone gives no head, "
            f"at least {MIN_PHOTOS} photos are needed, about 80 are good"
        )
    if not usable and not faults:
        return f"{source} holds no photos (JPEG, HEIC, PNG, TIFF): at least {MIN_PHOTOS} are needed, about 80 are good"
    why = f" and {len(faults)} that cannot be read (the first: {faults[0][1]})" if faults else ""
    return f"{source} holds {usable} usable photos{why}: at least {MIN_PHOTOS} are needed, about 80 are good"


def _clip(
    folder: CaptureFolder, photos: Survey, options: CaptureOptions, progress: Progress
) -> tuple[Clip | None, Survey | None, list[str]]:
    """The expression video with its chosen frames, its survey, and warnings."""
    chosen, warnings = choose_video(folder, options.presence, photos.identity)
    if chosen is None:
        return None, None, warnings  # the lack itself is judged with the rest
    if len(folder.videos) > 1:
        warnings.append(f"the video used is {chosen.path.name}, the longest with a face; capture.toml can name another")
    focal = video_focal(chosen, photos.views, bool(photos.assumed.all()))
    file = chosen.path.relative_to(folder.root)
    clip, frames = read_clip(chosen, file, focal, photos.identity, options, progress, copies=True)
    return clip, frames, warnings


def _frontal(folder: CaptureFolder, photos: Survey, trusted: np.ndarray) -> int:
    """The photo that capture.toml names, else the trusted one with least yaw and pitch."""
    named = folder.settings.get("frontal")
    if named is not None:
        stems = [Path(file).name.casefold() for file in photos.views.files]
        wanted = Path(named).name.casefold()
        if wanted not in stems:
            raise InputError(
                f"capture.toml says that '{named}' is the most frontal photo, which is not there or unusable"
            )
        return stems.index(wanted)
    off = np.hypot(photos.views.pose[:, 0], photos.views.pose[:, 1])
    return int(np.argmin(np.where(trusted, off, np.inf)))


def _settings(folder: CaptureFolder, photos: Survey, originals: list[tuple[int, int]]) -> dict[str, Any]:
    """capture.toml's settings, with the known length's ends in pixels of the stored photos (first centre at 0.5)."""
    settings = dict(folder.settings)
    if "known_length" not in settings:
        return settings
    views = photos.views
    by_name = {Path(file).name.casefold(): i for i, file in enumerate(views.files)}
    ends = []
    for point in settings["known_length"]["points"]:
        i = by_name.get(Path(point["photo"]).name.casefold())
        if i is None:
            raise InputError(
                f"capture.toml: known_length names the photo '{point['photo']}', which is not there or unusable"
            )
        scale = views.size[i] / np.array(originals[i], float)
        a, b = ((np.array(point[end]) + 0.5) * scale for end in "ab")
        ends.append({"photo": views.names[i], "a": a.tolist(), "b": b.tolist()})
    settings["known_length"] = {"mm": settings["known_length"]["mm"], "points": ends}
    return settings


def _figures(photos: Survey, clip: Clip | None, trusted: np.ndarray) -> dict[str, Any]:
    yaw = photos.views.pose[trusted, 0]
    figures: dict[str, Any] = {
        "photos": len(photos.views),
        "photos_with_face": int(np.isfinite(photos.views.presence).sum()),
        "photos_trusted": int(trusted.sum()),
        "yaw_range": [round(float(v), 1) for v in (yaw.min(), yaw.max())] if trusted.any() else None,
        "lenses": int(photos.views.lens.max()) + 1,
        "face_pixels_per_mm": round(float(np.median(photos.resolution[trusted])), 2) if trusted.any() else None,
    }
    if clip is not None:
        figures["video"] = clip.file
        figures["video_seconds"] = round(float(clip.times[-1]), 2)
        figures["frames"] = len(clip.times)
        figures["frames_processed"] = len(clip.processed)
    return figures

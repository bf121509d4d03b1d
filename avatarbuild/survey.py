"""What a look at every photo and frame of a capture tells; the stage keeps it, the capture doctor judges it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avatarbuild import faces
from avatarbuild.artefacts import StoredImage, Views
from avatarbuild.capture_folder import CaptureFolder, natural
from avatarbuild.errors import InputError
from avatarbuild.faces import Identity, Look, look
from avatarbuild.formats import images, video
from avatarbuild.parallel import in_order
from avatarbuild.progress import Task
from avatarbuild.template import ARKIT_NAMES

MAIN_LENS = 26.0  # mm equivalent: a phone's main camera, assumed where nothing is told
FURTHER = 5  # every so many frames of a video are searched for people behind the subject
VIDEO_CROP = 1.12  # a phone's video sees less than its photos, for the stabiliser's margin
_FILM_DIAGONAL = 43.267  # mm


@dataclass(frozen=True)
class Shot:
    """A photo that was read: its file relative to the capture, what its header tells, a look, and its JPEG copy."""

    file: Path
    photo: images.PhotoFacts
    size: tuple[int, int]
    focal: float
    look: Look
    copy: bytes


@dataclass(frozen=True)
class Survey:
    """
    Views of k pictures and what is judged but not kept.

    blur        (k,) mm on the face (pixels of the whole picture where there is none)
    resolution  (k,) pixels a millimetre on the face, in the file's own size
    side_light, contrast  (k,) as focus.Measures
    others      (k,) further faces of comparable size
    identity    what the subject's frontal faces have in common, None without any
    unlike      (k,) how unlike the photos' subject the most alike face is; NaN without a sure frontal one
    assumed     (k,) bool: the focal length is an assumption
    """

    views: Views
    blur: np.ndarray
    resolution: np.ndarray
    side_light: np.ndarray
    contrast: np.ndarray
    others: np.ndarray
    identity: Identity | None
    unlike: np.ndarray
    assumed: np.ndarray


def focal_in_pixels(equivalent: float, size: tuple[int, int]) -> float:
    """Pixels for a 35 mm equivalent focal length in mm, by the diagonal."""
    return equivalent / _FILM_DIAGONAL * float(np.hypot(*size))


def video_focal(source: video.VideoFile, photos: Views, assumed: bool) -> float:
    """Pixels, since no video tells: the photos' lens and the usual crop; `assumed`: theirs is a guess."""
    equivalent = np.median(photos.focal / np.hypot(*photos.size.T)) * np.hypot(*source.size)
    return VIDEO_CROP * (focal_in_pixels(MAIN_LENS, source.size) if assumed else float(equivalent))


def read_photos(
    folder: CaptureFolder, max_pixels: float, presence: float, jpeg_quality: int | None, task: Task
) -> tuple[list[Shot], list[tuple[Path, str]]]:
    """
    The photos in shooting order, and (file, why) of those that cannot be read.

    Shooting order is by the camera's clock, then natural name; by name alone where a photo has no time.
    jpeg_quality None: no copies are made, and faces are traced without the second, mirrored look.
    """

    def read(file: Path) -> Shot | InputError:
        try:
            photo = images.read_photo(folder.root / file, max_pixels)
        except InputError as e:
            return e
        seen = look(photo.rgb, presence, careful=jpeg_quality is not None, further=True)
        copy = b"" if jpeg_quality is None else images.encode_jpeg(photo.rgb, jpeg_quality)
        return Shot(file, photo.facts, (photo.rgb.shape[1], photo.rgb.shape[0]), photo.focal, seen, copy)

    shots, faults = [], []
    for file, result in zip(folder.photos, in_order(read, folder.photos)):
        task.advance()
        if isinstance(result, InputError):
            faults.append((file, str(result)))
        else:
            shots.append(result)
    timed = all(np.isfinite(shot.photo.time) for shot in shots)
    shots.sort(key=lambda shot: (shot.photo.time if timed else 0.0, natural(shot.file)))
    return shots, faults


def survey_photos(shots: list[Shot], presence: float, settings: dict[str, Any]) -> Survey:
    """The photos' views, with the subject followed; `settings` are capture.toml's."""
    looks = [shot.look for shot in shots]
    chosen = faces.follow(looks, presence, continuous=False)
    person = faces.identity(looks, chosen, presence)
    chosen = faces.follow(looks, presence, continuous=False, known=person)
    lenses: dict[str, int] = {}
    lens = np.array([lenses.setdefault(shot.photo.lens, len(lenses)) for shot in shots], np.int64)
    focal = np.array([shot.focal for shot in shots])
    assumed = ~np.isfinite(focal)
    stated = settings.get("focal")
    for i, shot in enumerate(shots):
        if stated is not None or assumed[i]:
            focal[i] = focal_in_pixels(MAIN_LENS if stated is None else float(stated), shot.size)
    if stated is not None:
        assumed[:] = False
    return _survey(
        names=_unique_names([shot.file for shot in shots]),
        files=[shot.file.as_posix() for shot in shots],
        copies=[StoredImage(shot.copy) for shot in shots],
        looks=looks,
        chosen=chosen,
        known=faces.identity(looks, chosen, presence),
        original=np.array([shot.photo.size[0] / shot.size[0] for shot in shots]),
        focal=focal,
        lens=lens,
        time=np.array([shot.photo.time for shot in shots]),
        presence=presence,
        assumed=assumed,
    )


def survey_frames(
    file: Path,
    indices: list[int],
    times: np.ndarray,
    looks: list[Look],
    copies: list[bytes],
    known: Identity | None,
    focal: float,
    presence: float,
) -> Survey:
    """The frames' views, with the subject followed from frame to frame."""
    k = len(looks)
    return _survey(
        names=[f"{i:06d}" for i in indices],
        files=[file.as_posix()] * k,
        copies=[StoredImage(copy) for copy in copies],
        looks=looks,
        chosen=faces.follow(looks, presence, continuous=True, known=known),
        known=known,
        original=np.ones(k),
        focal=np.full(k, focal),
        lens=np.zeros(k, np.int64),
        time=times,
        presence=presence,
        assumed=np.ones(k, bool),
    )


def choose_video(
    folder: CaptureFolder, presence: float, known: Identity | None
) -> tuple[video.VideoFile | None, list[str]]:
    """
    The longest video that shows a face in half of a few frames all over it, and warnings about the others.

    A video whose face seems to be another's than the `known` one is taken only where there is no other.
    """
    warnings, sound = [], []
    for file in folder.videos:
        try:
            sound.append(video.open_video(folder.root / file))
        except InputError as e:
            warnings.append(f"left out: {e}")
    sound.sort(key=lambda v: (-v.duration, natural(v.path)))
    doubtful: list[video.VideoFile] = []
    for v in sound:
        sure, tried, another = glance(v, presence, known)
        if 2 * sure < max(tried, 1):
            warnings.append(f"the video {v.path.name} shows a face in {sure} of {tried} frames; it is not used")
            continue
        if not another:
            more = [f"the video {d.path.name} seems to show another person; it is not used" for d in doubtful]
            return v, warnings + more
        doubtful.append(v)
    return (doubtful[0] if doubtful else None), warnings


def glance(v: video.VideoFile, presence: float, known: Identity | None) -> tuple[int, int, bool]:
    """How many of a few frames all over a video show a face, how many there are, and whether it seems another's."""
    looks = [look(rgb, presence, careful=False) for _, _, rgb in video.decode_frames(v.path, _tried(v))]
    sure = sum(bool(item.faces) and item.faces[0].face.presence >= presence for item in looks)
    unlike = [value for item in looks if np.isfinite(value := faces.least_unlikeness(item, known, presence))]
    return sure, len(looks), bool(unlike) and float(np.median(unlike)) > faces.ANOTHER


def _tried(v: video.VideoFile) -> list[int]:
    """Up to 7 frames all over a video: keyframes where there are enough, which decode fastest."""
    keys = video.keyframes(v.path)
    if len(keys) < 5:
        return [int(i) for i in np.linspace(0, v.frames - 1, 5)[1:-1]]
    return sorted({int(i) for i in keys[np.linspace(0, len(keys) - 1, 7).round().astype(int)]})


def _survey(
    names: list[str],
    files: list[str],
    copies: list[StoredImage],
    looks: list[Look],
    chosen: list[int],
    known: Identity | None,
    original: np.ndarray,
    focal: np.ndarray,
    lens: np.ndarray,
    time: np.ndarray,
    presence: float,
    assumed: np.ndarray,
) -> Survey:
    subject = [look.faces[i] if i >= 0 else None for look, i in zip(looks, chosen)]
    # a face that is nobody's of interest still lends its light to the picture
    measures = [look.measures or (s or look.faces[0]).measures for look, s in zip(looks, subject)]
    blur = np.array([m.blur for m in measures])
    resolution = np.array([np.nan if s is None else s.resolution for s in subject])
    k = len(names)

    def of_face(value: Callable[[Any], Any], *shape: int) -> np.ndarray:
        rows = [np.full(shape, np.nan) if s is None else np.asarray(value(s), float) for s in subject]
        return np.array(rows).reshape(k, *shape)

    views = Views(
        names=names,
        files=files,
        images=copies,
        size=np.array([look.size for look in looks], np.int64).reshape(k, 2),
        focal=focal,
        lens=lens,
        time=time,
        sharpness=1.0 / blur,
        exposure=np.array([m.exposure for m in measures]),
        white_balance=np.array([m.white_balance for m in measures]).reshape(k, 2),
        clipped=np.array([m.clipped for m in measures]),
        landmarks=of_face(lambda s: s.face.points, 478, 3),
        presence=of_face(lambda s: s.face.presence),
        scores=of_face(lambda s: s.face.scores, len(ARKIT_NAMES)),
        pose=of_face(lambda s: s.pose, 3),
    )
    return Survey(
        views=views,
        blur=np.where(np.isfinite(resolution), blur / resolution, np.nan),
        resolution=resolution * original,
        side_light=np.array([m.side_light for m in measures]),
        contrast=np.array([m.contrast for m in measures]),
        others=np.array([faces.others(look, i, presence) for look, i in zip(looks, chosen)], int),
        identity=faces.identity(looks, chosen, presence),
        unlike=np.array([faces.least_unlikeness(look, known, presence) for look in looks]),
        assumed=assumed,
    )


def _unique_names(files: list[Path]) -> list[str]:
    """The files' stems; with their folder's name or a number where two are equal, whatever the letters' case."""
    taken: set[str] = set()
    names = []
    for file in files:
        name, i = file.stem, 1
        if name.casefold() in taken and len(file.parts) > 1:
            name = f"{file.parent.name}_{file.stem}"
        base = name
        while name.casefold() in taken:
            i += 1
            name = f"{base}_{i}"
        taken.add(name.casefold())
        names.append(name)
    return names

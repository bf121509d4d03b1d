"""What there is to correct in a project: the frontal photo's contours, the points in the video's processed frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from avatarbuild.artefacts import Cameras, Capture, Clip, Neutral, Performance, StoredImage, Views
from avatarbuild.errors import InputError
from avatarbuild.formats.corrections import Corrections
from avatarbuild.formats.images import decode_jpeg, encode_jpeg
from avatarbuild.landmarks import IRIS_RIGHT
from avatarbuild.project import Project
from avatarbuild.registration.drawn import RIMS, at_shares, middle
from avatarbuild.template import Template
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.rig import Places

_ROOM = 0.3  # of the face's size about it
_NEAR_MM = 3.0  # residual that halves a frame's worth
_SURE = 0.5  # quality of frames that tell how the detector's points lie on the tracked head
PARTS = {"whole": 1600, "face": 2000, "thumb": 112}  # a picture's pieces, and the longer side at most
_CENTRE = 0.5  # what is sent counts pixels from the first one's centre, as corrections.json does


@dataclass(frozen=True)
class Contour:
    """A contour's lines (q, 2) pixels from the subject's right to left: the detector's, and the registered head's."""

    name: str
    detector: np.ndarray
    fit: np.ndarray | None


@dataclass(frozen=True)
class Portrait:
    """The frontal photo. box (4,) int: left, top, right, bottom of the face's part."""

    name: str
    image: StoredImage
    size: tuple[int, int]
    box: np.ndarray
    contours: list[Contour]


@dataclass(frozen=True)
class Footage:
    """
    j processed frames of the clip. marks, fits (j, 68, 2) pixels: the detector's points, and the tracked head's, NaN
    where there are none; box (j, 4) int; quality (j,) in 0..1, residual (j,) mm, NaN where not tracked; worth (j,): the
    lower, the sooner somebody should look.
    """

    clip: Clip
    marks: np.ndarray
    fits: np.ndarray
    box: np.ndarray
    quality: np.ndarray
    residual: np.ndarray
    worth: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(j,) bool: the detector found the face."""
        return np.isfinite(self.clip.frames.presence)


@dataclass(frozen=True)
class Subject:
    """A project's portrait and footage, None where it has none; notes tell why."""

    name: str
    portrait: Portrait | None
    footage: Footage | None
    notes: dict[str, str]


def open_subject(project: Project) -> Subject:
    """Raises InputError where stage capture has not run, found nothing to correct, or has been damaged since."""
    if project.stamp("capture") is None:
        raise InputError(f"{project.root} has no photos yet: run `avatarbuild run` up to stage capture at least")
    capture = project.read("capture", Capture)
    template = project.template().load()
    notes = {}
    portrait = footage = None
    if capture.frontal < 0 or not np.isfinite(capture.photos.presence[capture.frontal]):
        notes["photo"] = "No face was found in the photos: there is nothing to draw on."
    else:
        portrait = _portrait(project, capture, template)
    if capture.clip is None:
        notes["video"] = "This capture has no video: there are no frames to correct."
    elif not np.isfinite(capture.clip.frames.presence).any():
        notes["video"] = f"No face was found in {capture.clip.file}: there are no frames to correct."
    else:
        footage = _footage(project, capture.clip, template)
    if portrait is None and footage is None:
        raise InputError(
            f"{project.root}: no face was found in the photos, nor in a video: there is nothing to correct"
        )
    return Subject(project.root.name, portrait, footage, notes)


def _portrait(project: Project, capture: Capture, template: Template) -> Portrait:
    i = capture.frontal
    photos = capture.photos
    fits: dict[str, np.ndarray] = {}
    if all(project.stamp(stage) is not None for stage in ("cameras", "neutral")):
        fits = _fitted(project, photos, i, template)
    contours = []
    for name, (_, chains) in RIMS.items():
        line = middle(photos.landmarks[i, :, :2], chains)
        along = np.linspace(0, 1, len(line))
        fit = at_shares(fits[name], along) if name in fits else None
        contours.append(Contour(name, line, fit))
    size = (int(photos.size[i, 0]), int(photos.size[i, 1]))
    return Portrait(photos.names[i], photos.images[i], size, _box(photos.landmarks[i], size), contours)


def _fitted(project: Project, photos: Views, i: int, template: Template) -> dict[str, np.ndarray]:
    """The registered head's contours in photo i; nothing where the photo is not placed."""
    from avatarbuild.sfm.metric import placed_photos
    from avatarbuild.texture.photos import placed_in_head

    cameras = project.read("cameras", Cameras)
    head = project.read("neutral", Neutral)
    if len(head.vertices) != template.vertex_count:
        return {}
    placed = placed_photos(cameras.model, [f"{name}.jpg" for name in photos.names])
    for view in placed_in_head(photos, placed, head.head_from_cloud):
        if view.photo == i:
            turn = cv2.Rodrigues(view.R)[0]
            rims = {name: head.vertices[template.contours[own]] for name, (own, _) in RIMS.items()}
            return {name: cv2.projectPoints(x, turn, view.t, view.K, view.dist)[0][:, 0] for name, x in rims.items()}
    return {}


def _footage(project: Project, clip: Clip, template: Template) -> Footage:
    views = clip.frames
    seen = np.isfinite(views.presence)
    marks = np.where(seen[:, None, None], views.landmarks[:, template.landmarks68, :2], np.nan)
    fits, quality = np.full_like(marks, np.nan), np.full(len(marks), np.nan)
    residual = np.full(len(marks), np.nan)
    if project.stamp("tracking") is not None:
        made = project.read("tracking", Performance)
        if made.video == clip.file and np.array_equal(made.processed, clip.processed[seen]):
            quality[seen] = made.quality[made.processed]
            fits[seen], mm = _tracked(made, template)
            residual[seen] = _residual(marks[seen], fits[seen], quality[seen], mm)
    worth = np.where(np.isfinite(quality), quality / (1 + (np.nan_to_num(residual) / _NEAR_MM) ** 2), views.presence)
    sightings = np.flatnonzero(seen)
    size = clip.size
    boxes = [_box(views.landmarks[sightings[np.abs(sightings - i).argmin()]], size) for i in range(len(marks))]
    return Footage(clip, marks, fits, np.array(boxes), quality, residual, np.where(seen, worth, np.inf))


def _tracked(made: Performance, template: Template) -> tuple[np.ndarray, np.ndarray]:
    """(j, 68, 2) pixels of the 68 points on the tracked head, and (j,) mm a pixel there."""
    on = template.landmarks68
    places = Places(template.landmark_triangles[on], template.landmark_barycentric[on])
    rest = places.on(made.neutral, template.triangles)
    moves = np.stack([places.on(delta, template.triangles) for delta in made.deltas.astype(np.float64)])
    x = rest + np.tensordot(made.weights[made.processed], moves, 1)
    camera = np.einsum("fij,fpj->fpi", made.rotation[made.processed], x) + made.translation[made.processed, None]
    lens = Lens(made.focal, made.k1, made.size)
    return lens.project(camera)[0], camera[..., 2].mean(axis=1) / made.focal


def _residual(marks: np.ndarray, fits: np.ndarray, quality: np.ndarray, mm: np.ndarray) -> np.ndarray:
    """(j,) mm: the median way from the tracked head's points to the detector's, less what is the same in all frames."""
    way = marks - fits
    way = way - np.median(way[quality >= _SURE] if (quality >= _SURE).any() else way, axis=0)
    return np.median(np.linalg.norm(way, axis=2), axis=1) * mm


def _box(landmarks: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    points = landmarks[: IRIS_RIGHT.start, :2]
    low, high = points.min(axis=0), points.max(axis=0)
    room = _ROOM * float((high - low).max())
    first = np.clip(np.floor(low - room), 0, np.array(size) - 16)
    return np.concatenate([first, np.clip(np.ceil(high + room), first + 16, size)]).astype(int)


def piece(image: StoredImage, box: np.ndarray, part: str) -> bytes:
    """A JPEG of the whole picture or of the face's part, its longer side no longer than PARTS says."""
    rgb = decode_jpeg(image.data())
    if part != "whole":
        rgb = rgb[box[1] : box[3], box[0] : box[2]]
    scale = PARTS[part] / max(rgb.shape[:2])
    if scale < 1:
        w, h = (max(1, round(side * scale)) for side in rgb.shape[1::-1])
        rgb = cv2.resize(rgb, (w, h), interpolation=cv2.INTER_AREA)
    return encode_jpeg(np.ascontiguousarray(rgb), 80 if part == "thumb" else 92)


def described(subject: Subject) -> dict[str, Any]:
    """The subject as the page gets it; points count pixels from the first one's centre."""
    photo = video = None
    if (p := subject.portrait) is not None:
        photo = {
            "name": p.name,
            "size": p.size,
            "box": p.box.tolist(),
            "contours": [
                {"name": c.name, "detector": _list(c.detector), "fit": None if c.fit is None else _list(c.fit)}
                for c in p.contours
            ],
        }
    if (f := subject.footage) is not None:
        order = np.argsort(f.worth, kind="stable")
        video = {
            "file": f.clip.file,
            "size": f.clip.size,
            "worst": f.clip.processed[order].tolist(),
            "frames": [
                {
                    "frame": int(number),
                    "time": round(float(f.clip.times[number]), 3),
                    "found": bool(f.seen[i]),
                    "presence": _number(f.clip.frames.presence[i]),
                    "quality": _number(f.quality[i]),
                    "residual": _number(f.residual[i]),
                    "worth": _number(f.worth[i]),
                    "box": f.box[i].tolist(),
                    "points": _list(f.marks[i]) if f.seen[i] else None,
                    "fit": _list(f.fits[i]) if np.isfinite(f.fits[i]).all() else None,
                }
                for i, number in enumerate(f.clip.processed)
            ],
        }
    return {"version": 1, "project": subject.name, "photo": photo, "video": video, "notes": subject.notes}


def require_known(told: Corrections, subject: Subject, photos: list[str]) -> None:
    """Raises InputError for frames and photos that the project does not have, and points far outside their picture."""
    clip = subject.footage.clip if subject.footage is not None else None
    frames = len(clip.times) if clip is not None else 0
    for frame in (*told.video, *told.reviewed):
        if frame >= frames:
            raise InputError(f"there is no frame {frame}: the video has {frames}")
    for frame, points in told.video.items():
        assert clip is not None
        _require_near(np.array(list(points.values())), clip.size, f"frame {frame}")
    for name, contours in told.photo.items():
        if name not in photos:
            raise InputError(f"there is no photo {name}")
        if subject.portrait is not None and name == subject.portrait.name:
            _require_near(np.concatenate(list(contours.values())), subject.portrait.size, f"photo {name}")


def _require_near(points: np.ndarray, size: tuple[int, int], where: str) -> None:
    if not ((points > -np.array(size)) & (points < 2 * np.array(size))).all():
        raise InputError(f"{where}: a point lies far outside the picture")


def _list(points: np.ndarray) -> list[list[float]]:
    return np.round(points - _CENTRE, 2).tolist()


def _number(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def video_path(source: Path, subject: Subject) -> Path | None:
    """The clip in the capture's folder, None where it is not there."""
    if subject.footage is None or not (source / subject.footage.clip.file).is_file():
        return None
    return source / subject.footage.clip.file

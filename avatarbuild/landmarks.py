"""Faces in a picture: Google's face landmarker (three small networks) run by OpenCV alone.

A detector sees the whole picture in 128 x 128 pixels. For each face that it finds, a second network sees an upright
square of 256 x 256 pixels about the face and gives 478 points, the last ten of them on the irises, and the
probability that this is a face. A third turns 146 of the points into expression scores.

Coordinates are pixels with the first pixel's centre at 0.5, so a crop's corner and the picture's are both whole.
"""

from __future__ import annotations

import struct
import tempfile
import threading
import zipfile
from collections import deque
from collections.abc import Iterator
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from avatarbuild.template import ARKIT_NAMES

POINTS = 478
IRIS_RIGHT = slice(468, 473)  # the subject's right: centre, then the rim to the picture's right, above, left, below
IRIS_LEFT = slice(473, 478)
IRISES = (IRIS_LEFT, IRIS_RIGHT)
TRUSTED_PRESENCE, TRUSTED_YAW = 0.9, 60.0  # from and up to which (degrees) a face tells where the head is
EYE_CORNERS = (33, 263)  # outer corners: the subject's right eye, left eye

_ZIP = "face_landmarker.task"
DETECTOR_SIZE = 128
_CROP_SIZE = 256
_ROOM = 1.5  # a crop's side over the face's larger extent, as the network was trained
_ANCHOR_LAYERS = ((8, 2), (16, 6))  # stride in detector pixels, anchors a cell
_PASSES = 3  # new traces at most; one is enough where the square moves by less than this share of its side
_SETTLED = 0.06
_CLEAR = 0.7  # a detection this sure is a head, if only its side, and parts of the picture show no better one
_OVERLAP = 0.3  # detections that overlap by more (intersection over union) are one face
_PADDING = 0.35  # a border, as a share of the longer side, lets the detector see faces that the picture's edge cuts

# the third network's outputs: its first is "neutral", and it knows no tongueOut
_SCORE_ORDER: tuple[str, ...] = (
    *("browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "cheekPuff"),
    *("cheekSquintLeft", "cheekSquintRight", "eyeBlinkLeft", "eyeBlinkRight", "eyeLookDownLeft", "eyeLookDownRight"),
    *("eyeLookInLeft", "eyeLookInRight", "eyeLookOutLeft", "eyeLookOutRight", "eyeLookUpLeft", "eyeLookUpRight"),
    *("eyeSquintLeft", "eyeSquintRight", "eyeWideLeft", "eyeWideRight", "jawForward", "jawLeft", "jawOpen"),
    *("jawRight", "mouthClose", "mouthDimpleLeft", "mouthDimpleRight", "mouthFrownLeft", "mouthFrownRight"),
    *("mouthFunnel", "mouthLeft", "mouthLowerDownLeft", "mouthLowerDownRight", "mouthPressLeft", "mouthPressRight"),
    *("mouthPucker", "mouthRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper"),
    *("mouthSmileLeft", "mouthSmileRight", "mouthStretchLeft", "mouthStretchRight", "mouthUpperUpLeft"),
    *("mouthUpperUpRight", "noseSneerLeft", "noseSneerRight"),
)
_SCORE_COLUMNS = np.array([ARKIT_NAMES.index(name) for name in _SCORE_ORDER])

# the points that the third network reads, in its order
_SCORED_POINTS = np.array(
    [
        *(0, 1, 4, 5, 6, 7, 8, 10, 13, 14, 17, 21, 33, 37, 39, 40, 46, 52, 53, 54, 55, 58, 61, 63, 65, 66, 67, 70),
        *(78, 80, 81, 82, 84, 87, 88, 91, 93, 95, 103, 105, 107, 109, 127, 132, 133, 136, 144, 145, 146, 148, 149),
        *(150, 152, 153, 154, 155, 157, 158, 159, 160, 161, 162, 163, 168, 172, 173, 176, 178, 181, 185, 191, 195),
        *(197, 234, 246, 249, 251, 263, 267, 269, 270, 276, 282, 283, 284, 285, 288, 291, 293, 295, 296, 297, 300),
        *(308, 310, 311, 312, 314, 317, 318, 321, 323, 324, 332, 334, 336, 338, 356, 361, 362, 365, 373, 374, 375),
        *(377, 378, 379, 380, 381, 382, 384, 385, 386, 387, 388, 389, 390, 397, 398, 400, 402, 405, 409, 415, 454),
        *(466, 468, 469, 470, 471, 472, 473, 474, 475, 476, 477),
    ]
)


class Face(NamedTuple):
    """
    points    (478, 3) pixels; depth in pixels, growing away from the camera, about the face's mean
    presence  probability that the points lie on a face
    scores    (52,) ARKit expression scores in 0..1; NaN for tongueOut, which the network does not know
    """

    points: np.ndarray
    presence: float
    scores: np.ndarray


class Region(NamedTuple):
    """A square about a face: centre (2,) and side in pixels, turn in radians (clockwise in the picture)."""

    centre: np.ndarray
    side: float
    turn: float


class Detection(NamedTuple):
    """A face in the detector's eyes: its score, and the square that the landmarks are looked for in."""

    score: float
    region: Region


class CanonicalFace(NamedTuple):
    """points (468, 3) mm, head axes (x to the subject's left, y up, z out); rigidity (468,): Procrustes weights."""

    points: np.ndarray
    rigidity: np.ndarray


def find_faces(rgb: np.ndarray, presence: float = 0.9, most: int = 4, careful: bool = True) -> list[Face]:
    """
    The faces in an upright (h, w, 3) uint8 sRGB picture, the surest and largest first.

    Looks at the whole picture; where no face with at least `presence` comes of it, at the picture with a border, and
    where the detector saw nothing clearly, at overlapping parts of it. A doubtful face, such as a profile, is returned
    where the detector is sure of it and there is no better one. `careful` averages each face's points with those of
    its mirror image, for a tenth less noise and half as much time again.
    """
    faces: list[Face] = []
    for detections in _looks(rgb):
        for detection in detections:
            face = trace(rgb, detection.region, careful)
            if face.presence >= 0.5 * presence or (detection.score >= _CLEAR and not faces):
                faces.append(face)
        if any(face.presence >= presence for face in faces):
            break
    faces.sort(key=lambda face: -face.presence * face_size(face.points))
    kept: list[Face] = []
    for face in faces:
        if all(not same_place(face.points, other.points) for other in kept):
            kept.append(face)
    return kept[:most]


def trace(rgb: np.ndarray, region: Region, careful: bool = True) -> Face:
    """The face in a region: its points, traced anew in the square that they ask for until that stays put."""
    points, presence = _points(rgb, region)
    for _ in range(_PASSES):
        before, region = region, region_about(points)
        points, presence = _points(rgb, region)
        if _moved(before, region) < _SETTLED:
            break
    if careful:
        width = rgb.shape[1]
        middle = np.array([width - region.centre[0], region.centre[1]])
        other, _ = _points(np.ascontiguousarray(rgb[:, ::-1]), Region(middle, region.side, -region.turn))
        other[:, 0] = width - other[:, 0]
        points = (points + other[mirror()]) / 2
    return Face(points, presence, _scores(points))


def detect(rgb: np.ndarray, threshold: float = 0.4, padding: float = 0.0) -> list[Detection]:
    """Faces by the detector alone, best first; `padding` is a black border as a share of the longer side."""
    h, w = rgb.shape[:2]
    scale = DETECTOR_SIZE / (max(h, w) * (1 + 2 * padding))
    small = cv2.resize(rgb, (max(1, round(w * scale)), max(1, round(h * scale))), interpolation=cv2.INTER_AREA)
    x0, y0 = (DETECTOR_SIZE - small.shape[1]) // 2, (DETECTOR_SIZE - small.shape[0]) // 2
    square = np.zeros((DETECTOR_SIZE, DETECTOR_SIZE, 3), np.uint8)
    square[y0 : y0 + small.shape[0], x0 : x0 + small.shape[1]] = small
    boxes, logits = _run("detector", square.astype(np.float32) / 127.5 - 1.0)
    score = _logistic(logits.ravel())
    found = np.flatnonzero(score >= threshold)
    found = found[np.argsort(-score[found], kind="stable")]
    score, boxes = score[found], boxes.reshape(-1, 16)[found].astype(np.float64)
    # box centre, box size, six key points of which the first two are the eyes; offsets from the anchor in pixels
    at = _anchors()[found]
    size = boxes[:, 2:4]
    centre = boxes[:, :2] + at
    eyes = boxes[:, 4:8].reshape(-1, 2, 2) + at[:, None]
    to_picture = np.array([w / small.shape[1], h / small.shape[0]])
    detections = []
    free = np.ones(len(found), bool)
    for i in range(len(found)):
        if not free[i]:
            continue
        same = free & (_overlaps(centre[i], size[i], centre, size) > _OVERLAP)
        same[i] = True
        free &= ~same
        weight = score[same] / score[same].sum()
        middle = (weight @ centre[same] - (x0, y0)) * to_picture
        side = (weight @ size[same] * to_picture).max() * _ROOM
        right, left = np.tensordot(weight, eyes[same], 1) * to_picture
        turn = float(np.arctan2(left[1] - right[1], left[0] - right[0]))
        detections.append(Detection(float(score[i]), Region(middle, float(side), turn)))
    return detections


def region_about(points: np.ndarray) -> Region:
    """The square that the landmark network wants about known points (478, 3)."""
    right, left = points[EYE_CORNERS[0], :2], points[EYE_CORNERS[1], :2]
    turn = float(np.arctan2(left[1] - right[1], left[0] - right[0]))
    upright = points[:468, :2] @ _rotation(-turn).T
    low, high = upright.min(0), upright.max(0)
    return Region(_rotation(turn) @ ((low + high) / 2), float((high - low).max() * _ROOM), turn)


def crop(rgb: np.ndarray, region: Region, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The region as size x size pixels, free of aliases, and the (2, 3) map from its pixels to the picture's."""
    scale = region.side / size
    turned = _rotation(region.turn)
    to_picture = np.c_[turned * scale, region.centre - turned @ np.full(2, region.side / 2)]
    origin = np.zeros(2)
    step = 1
    if scale > 2:  # halve the surroundings first, so that the warp below skips no pixel
        step = 2 ** int(np.log2(scale))
        reach = region.side * 0.75
        low = np.maximum(np.floor((region.centre - reach) / step), 0).astype(int) * step
        high = np.minimum(np.ceil((region.centre + reach) / step).astype(int) * step, rgb.shape[1::-1])
        part = rgb[low[1] : high[1], low[0] : high[0]]
        if min(part.shape[:2]) >= step:
            part = part[: part.shape[0] // step * step, : part.shape[1] // step * step]
            rgb = cv2.resize(part, (part.shape[1] // step, part.shape[0] // step), interpolation=cv2.INTER_AREA)
            origin = low.astype(np.float64)
        else:
            step = 1
    matrix = np.c_[to_picture[:, :2], to_picture[:, 2] - origin] / step
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5) - 0.5  # OpenCV counts from the first pixel's centre
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(rgb, matrix, (size, size), flags=flags), to_picture


def face_size(points: np.ndarray) -> float:
    """Pixels: the diagonal of the points' box."""
    return float(np.linalg.norm(np.ptp(points[:468, :2], axis=0)))


@cache
def canonical_face() -> CanonicalFace:
    """The mean face that the landmarker's own geometry uses, read from the file that the networks come in."""
    with zipfile.ZipFile(_archive()) as archive:
        message = archive.read("geometry_pipeline_metadata_landmarks.binarypb")
    rigidity = np.zeros(468)
    points = np.empty((0, 3))
    for number, value in _protobuf_fields(message):
        if number == 1:  # a mesh, whose field 3 holds x y z u v of its vertices, in centimetres
            vertices = [v for n, v in _protobuf_fields(value) if n == 3]
            points = np.frombuffer(b"".join(vertices), "<f4").reshape(-1, 5)[:, :3].astype(np.float64) * 10.0
        elif number == 2:  # a point that counts in the alignment: its number and weight
            entry = dict(_protobuf_fields(value))
            rigidity[entry.get(1, 0)] = struct.unpack("<f", entry[2])[0]
    return CanonicalFace(points, rigidity)


@cache
def mirror() -> np.ndarray:
    """(478,) the point that each point becomes in a mirror."""
    face = canonical_face().points
    apart = np.linalg.norm(face[:, None] * (-1.0, 1.0, 1.0) - face, axis=2)
    return np.r_[apart.argmin(1), 473, 476, 475, 474, 477, 468, 471, 470, 469, 472]


class _Network:
    """A network in OpenCV's classic engine, which alone gives all outputs of these files."""

    def __init__(self, data: bytes, outputs: list[str]):
        # the overload that reads bytes ignores the engine, so the network goes through a file
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "network.tflite"
            path.write_bytes(data)
            with _reading:
                self.net = cv2.dnn.readNetFromTFLite(str(path), engine=cv2.dnn.ENGINE_CLASSIC)
        self.outputs = outputs

    def run(self, value: np.ndarray) -> list[np.ndarray]:
        """(h, w, 3) pictures become (1, 3, h, w) blobs; other arrays go in as they are."""
        blob = value.transpose(2, 0, 1)[None] if value.ndim == 3 and value.shape[2] == 3 else value
        self.net.setInput(np.ascontiguousarray(blob, np.float32))
        return [np.array(out) for out in self.net.forward(self.outputs)]


_idle: deque[dict[str, _Network]] = deque()
# OpenCV fills its table of operators when the first network is read: a second reader beside it finds half a table
_reading = threading.Lock()


def _archive() -> Path:
    return Path(str(files("avatarbuild") / "models" / _ZIP))


def _run(name: str, value: np.ndarray) -> list[np.ndarray]:
    """Runs a network that no other thread is using: a set of them is lent, and loaded where none is idle."""
    try:
        networks = _idle.pop()
    except IndexError:
        networks = _load()
    try:
        return networks[name].run(value)
    finally:
        _idle.append(networks)


def _load() -> dict[str, _Network]:
    with zipfile.ZipFile(_archive()) as archive:
        return {
            "detector": _Network(archive.read("face_detector.tflite"), ["regressors", "classificators"]),
            "points": _Network(archive.read("face_landmarks_detector.tflite"), ["Identity", "Identity_1"]),
            "scores": _Network(archive.read("face_blendshapes.tflite"), ["StatefulPartitionedCall:0"]),
        }


def _looks(rgb: np.ndarray) -> Iterator[list[Detection]]:
    """Detections by ever more patient looks: the whole, with a border, by overlapping halves and thirds."""
    clear = False
    for padding in (0.0, _PADDING):
        found = detect(rgb, padding=padding)
        clear = clear or any(detection.score >= _CLEAR for detection in found)
        yield found
    h, w = rgb.shape[:2]
    for parts in () if clear or max(h, w) <= _CROP_SIZE else (2, 3):
        side = 2 * max(h, w) // (parts + 1)
        yield detect_in_windows(rgb, side)[:8]


def detect_in_windows(rgb: np.ndarray, side: int, threshold: float = 0.4) -> list[Detection]:
    """Faces by the detector in overlapping square windows of `side` pixels, best first; a face may come twice."""
    found = []
    for y in _starts(rgb.shape[0], side):
        for x in _starts(rgb.shape[1], side):
            for score, region in detect(rgb[y : y + side, x : x + side], threshold):
                found.append(Detection(score, region._replace(centre=region.centre + np.array([x, y]))))
    return sorted(found, key=lambda detection: -detection.score)


def _starts(length: int, side: int) -> list[int]:
    """Where windows of `side`, overlapping by at least a third, begin on a line of `length`."""
    n = max(1, int(np.ceil((length - side) / (side * 2 / 3))) + 1)
    return sorted({int(v) for v in np.linspace(0, max(0, length - side), n)})


def _points(rgb: np.ndarray, region: Region) -> tuple[np.ndarray, float]:
    """(478, 3) points in the picture, and the presence."""
    square, to_picture = crop(rgb, region, _CROP_SIZE)
    points, logit = _run("points", square.astype(np.float32) / 255.0)
    local = points.reshape(POINTS, 3).astype(np.float64)
    found = np.empty((POINTS, 3))
    found[:, :2] = local[:, :2] @ to_picture[:, :2].T + to_picture[:, 2]
    found[:, 2] = local[:, 2] * (region.side / _CROP_SIZE)
    return found, float(_logistic(logit.ravel())[0])


def _scores(points: np.ndarray) -> np.ndarray:
    """(52,) scores; the network is blind to size and place but not to roll, so it sees the face upright."""
    upright = points[_SCORED_POINTS, :2] @ _rotation(-region_about(points).turn).T
    (values,) = _run("scores", upright[None])
    scores = np.full(len(ARKIT_NAMES), np.nan)
    scores[_SCORE_COLUMNS] = values.ravel()[1:]
    return scores


@cache
def _anchors() -> np.ndarray:
    """(896, 2) detector pixels."""
    layers = []
    for stride, count in _ANCHOR_LAYERS:
        y, x = np.mgrid[: DETECTOR_SIZE // stride, : DETECTOR_SIZE // stride]
        centres = np.stack([x + 0.5, y + 0.5], -1).reshape(-1, 2) * stride
        layers.append(np.repeat(centres, count, axis=0))
    return np.concatenate(layers)


def _overlaps(centre: np.ndarray, size: np.ndarray, centres: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """(k,) intersection over union of one box with k others."""
    low = np.maximum(centre - size / 2, centres - sizes / 2)
    high = np.minimum(centre + size / 2, centres + sizes / 2)
    common = np.prod(np.clip(high - low, 0, None), axis=1)
    return common / (np.prod(size) + np.prod(sizes, axis=1) - common)


def _moved(a: Region, b: Region) -> float:
    """How far a square's corners moved at most, about, as a share of its side."""
    turned = abs(np.angle(np.exp(1j * (a.turn - b.turn))))
    return float((np.abs(a.centre - b.centre).max() + abs(a.side - b.side) / 2) / b.side + turned / 2)


def same_place(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two point sets lie on one face: their middles are nearer than half the smaller one's size."""
    apart = np.linalg.norm(a[:468, :2].mean(0) - b[:468, :2].mean(0))
    return bool(apart < 0.5 * min(face_size(a), face_size(b)))


def _rotation(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _logistic(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-np.clip(x.astype(np.float64), -80, 80)))


def _protobuf_fields(message: bytes) -> Iterator[tuple[int, Any]]:
    """(number, value) of a protobuf message's fields; values of fixed size and messages come as bytes."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = message[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(message):
        key = varint()
        kind = key & 7
        if kind == 0:
            yield key >> 3, varint()
            continue
        length = {1: 8, 5: 4}.get(kind) or varint()
        yield key >> 3, message[at : at + length]
        at += length

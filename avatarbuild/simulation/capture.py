"""A whole capture: photos, video, and their truth in a folder beside it."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from avatarbuild.errors import InputError
from avatarbuild.formats.clip import encode_clip
from avatarbuild.options import option
from avatarbuild.progress import Progress, Silent
from avatarbuild.simulation import truth
from avatarbuild.simulation.light import Light, changed
from avatarbuild.simulation.performance import NO_PERFORMANCE, Performance, perform
from avatarbuild.simulation.photographs import Shot, develop, sweep, write_photo
from avatarbuild.simulation.rendering import Camera, draw
from avatarbuild.simulation.studio import Studio, build_studio, posed_head, surroundings
from avatarbuild.template import ARKIT_NAMES, PIVOT, Template

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SimulationOptions:
    """What `avatarbuild simulate` renders."""

    photos: int = option(40, "photos", "Photos of the sweep; 0 for none.", least=0)
    photo_width: int = option(1512, "pixels", "Width of the upright photos; their height is 4/3 of it.", least=96)
    video_seconds: float = option(12.0, "s", "Length of the expression video; 0 for none.", least=0)
    video_fps: float = option(30.0, "Hz", "Frame rate of the video.", least=1)
    video_width: int = option(1080, "pixels", "Width of the upright video; its height is 16/9 of it.", least=96)
    texture: int = option(2048, "texels", "Side of the skin's texture.", least=128)
    supersampling: int = option(2, "pixels", "Samples along each side of a pixel.", least=1)
    identity_spread: float = option(
        0.875, "factor", "Standard deviation of the template's coefficients: 1 is as people vary.", least=0
    )
    deviation: float = option(
        1.0, "factor", "How far person and expressions leave the template's linear space.", least=0
    )
    noise: float = option(1.0, "factor", "Sensor noise, 1 being a phone's in a lit room.", least=0)
    jpeg_quality: int = option(92, "1-100", "JPEG quality of the photos.", least=10)
    video_quality: int = option(19, "0-51", "Constant rate factor of the video: smaller is better.", least=0)
    orientations: bool = option(True, "yes or no", "Some photos are stored turned, with their EXIF orientation.")
    head_turn: float = option(
        0.0, "degrees", "Standard deviation of the head's turns in the room between photos.", least=0
    )
    expression_drift: float = option(
        0.0, "weight", "Size of the expression that comes and goes over the photos.", least=0
    )
    second_person: bool = option(False, "yes or no", "Somebody else sits behind the subject.")
    light: int = option(-1, "number", "Another light, all else the same; -1: the seed's own.", least=-1)


@dataclass(frozen=True)
class Photo:
    """One photo before it is written: rgb (h, w, 3) uint8 upright, its shot, the head's turn (4, 4) and weights."""

    rgb: np.ndarray
    shot: Shot
    turn: np.ndarray
    weights: np.ndarray


def simulate(
    folder: Path,
    seed: int = 0,
    options: SimulationOptions | None = None,
    *,
    truth_folder: Path | None = None,
    template: Template | None = None,
    progress: Progress | None = None,
) -> Path:
    """
    Render a capture into `folder` (photos/, video/) and its truth into `truth_folder` (default: folder + '.truth').

    The same seed, options and template give the same bytes. Returns the truth folder.

    Raises:
        InputError: the folder exists and is not empty, or an option is out of range.
    """
    o = options or SimulationOptions()
    _check(o)
    folder = Path(folder)
    beside = Path(truth_folder) if truth_folder is not None else folder.with_name(folder.name + ".truth")
    for place in (folder, beside):
        if place.exists() and any(place.iterdir()):
            raise InputError(f"{place} is not empty; name a new folder for the simulated capture")
        place.mkdir(parents=True, exist_ok=True)
    head = template or Template.load()
    listener = progress or Silent()
    studio = build_studio(
        head,
        seed,
        o.texture,
        wall_texel(o.photo_width),
        spread=o.identity_spread,
        deviation=o.deviation,
        second_person=o.second_person,
        light=o.light,
    )
    order = truth.order_of(head)
    exposure = _exposure(studio, studio.light)
    lit = studio.light.scaled(exposure)
    later = changed(studio.light, np.random.default_rng([seed, 3])).scaled(exposure)
    shots: list[Shot] = []
    turns: list[np.ndarray] = []
    counts = np.zeros(len(head.mean), np.int64)
    if o.photos:
        (folder / "photos").mkdir()
        with listener.task("photos", o.photos) as task:
            for index, photo in enumerate(take_photos(studio, seed, o, lit)):
                name = f"IMG_{index + 1:04d}.JPG"
                write_photo(folder / "photos" / name, photo.rgb, photo.shot.orientation, index, quality=o.jpeg_quality)
                posed = studio.head.subject.posed(photo.weights) @ photo.turn[:3, :3].T + photo.turn[:3, 3]
                counts += truth.visible(photo.shot.camera, posed, head.triangles)
                shots.append(photo.shot)
                turns.append(photo.turn)
                task.advance()
    record, performance = None, NO_PERFORMANCE
    if o.video_seconds > 0:
        (folder / "video").mkdir()
        size = (o.video_width, even(o.video_width * 16 / 9))
        performance = perform(np.random.default_rng([seed, 5]), o.video_seconds, o.video_fps, size)
        with listener.task("video", len(performance.weights)) as task:

            def frames() -> Iterator[np.ndarray]:
                for rgb in film(studio, seed, o, performance, later):
                    task.advance()
                    yield rgb

            encode_clip(folder / "video" / "MOV_0001.mp4", frames(), o.video_fps, quality=o.video_quality)
        _write_key_normals(beside, studio, performance, order)
        record = truth.video_record("MOV_0001.mp4", performance)
    names = [f"IMG_{i + 1:04d}.JPG" for i in range(len(shots))]
    truth.write_cameras(beside, shots, names, np.array(turns).reshape(-1, 4, 4), record)
    truth.write_mesh(beside, studio.head.subject, order)
    truth.write_video(beside, studio.head.subject, order, performance)
    truth.write_visibility(beside, counts, order, studio.head.chart)
    truth.write_albedo(beside, studio.head)
    truth.write_light(beside, lit, later, exposure)
    (beside / "simulation.json").write_text(json.dumps({"version": 1, "seed": seed, "options": asdict(o)}, indent=1))
    log.info("simulated %d photos and %g s of video, seed %d", len(shots), o.video_seconds, seed)
    return beside


def take_photos(studio: Studio, seed: int, o: SimulationOptions, light: Light) -> Iterator[Photo]:
    """The photos of a sweep in shooting order."""
    rng = np.random.default_rng([seed, 4])
    size = (o.photo_width, even(o.photo_width * 4 / 3))
    still = surroundings(studio, light)
    others = [posed_head(h, np.zeros(len(ARKIT_NAMES)), place) for h, place in studio.others]
    drift = _drifting(rng, o.photos) * o.expression_drift
    for i, shot in enumerate(sweep(rng, o.photos, size, orientations=o.orientations)):
        turn = _turned(np.radians(o.head_turn) * rng.standard_normal(3) * [0.7, 1.0, 0.5])
        head = posed_head(studio.head, drift[i], turn)
        linear = draw(shot.camera, [still], [head, *others], light, o.supersampling)
        rgb = develop(linear, shot, np.random.default_rng([seed, 6, i]), noise=o.noise)
        yield Photo(rgb, shot, turn, drift[i])


def film(
    studio: Studio, seed: int, o: SimulationOptions, performance: Performance, light: Light
) -> Iterator[np.ndarray]:
    """The frames (h, w, 3) uint8 of a performance."""
    rng = np.random.default_rng([seed, 7])
    still = surroundings(studio, light)
    others = [posed_head(h, np.zeros(len(ARKIT_NAMES)), place) for h, place in studio.others]
    balance = np.exp(rng.normal(0, [0.02, 0.0, 0.02]))
    brightness = float(np.exp(rng.normal(0, 0.05)))
    for weights, pose, camera in zip(performance.weights, performance.head_pose, performance.cameras, strict=True):
        linear = draw(camera, [still], [posed_head(studio.head, weights, pose), *others], light, o.supersampling)
        yield develop(linear, Shot(camera, 0, 0, brightness, balance, np.zeros(2), 1), rng, noise=o.noise)


def wall_texel(photo_width: int) -> float:
    """Size in mm of the walls' texels for photos of a width: about that of a pixel 2 m away."""
    return float(np.clip(2.2 * 1512 / max(photo_width, 1), 1.6, 6.0))


def even(x: float) -> int:
    """The nearest even integer: what video encoders take."""
    return 2 * round(x / 2)


def _check(o: SimulationOptions) -> None:
    for f in fields(o):
        least = f.metadata["least"]
        if least is not None and getattr(o, f.name) < least:
            raise InputError(f"simulate: {f.name} is {getattr(o, f.name)}; at least {least} is needed")
    if o.photos == 0 and o.video_seconds == 0:
        raise InputError("simulate: neither photos nor a video are asked for; set photos or video_seconds")


def _exposure(studio: Studio, light: Light) -> float:
    """What the phone chooses: bright skin and the whole frontal picture both at middle brightness."""
    K = np.array([[150.0, 0, 75], [0, 150, 100], [0, 0, 1]])
    camera = Camera(K, np.zeros(5), np.diag([1.0, -1, -1]), np.array([0, -28.0, 410]), (150, 200))
    head = posed_head(studio.head, np.zeros(len(ARKIT_NAMES)))
    alone = draw(camera, [], [head], light, 1).mean(axis=-1)
    whole = draw(camera, [surroundings(studio, light)], [head], light, 1).mean(axis=-1)
    skin = float(np.quantile(alone[alone > 0], 0.85))
    return float(np.exp(0.45 * np.log(0.42 / skin) + 0.55 * np.log(0.3 / np.median(whole))))


def _drifting(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 52) weights about 1 at most: a few shapes that come and go slowly."""
    weights = np.zeros((count, len(ARKIT_NAMES)))
    s = np.linspace(0, 2 * np.pi, max(count, 1))[:count]
    for names in (("mouthSmileLeft", "mouthSmileRight"), ("browInnerUp",), ("jawOpen",), ("eyeSquintLeft",)):
        level = np.maximum(np.sin(s * rng.uniform(0.7, 2.2) + rng.uniform(0, 6.3)), 0)
        for name in names:
            weights[:, ARKIT_NAMES.index(name)] = level
    return weights


def _turned(turn: np.ndarray) -> np.ndarray:
    """(4, 4): rotation by exp([turn]_x) about the top of the neck."""
    import cv2

    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(turn.reshape(3, 1))[0]
    pose[:3, 3] = PIVOT - pose[:3, :3] @ PIVOT
    return pose


def _write_key_normals(folder: Path, studio: Studio, performance: Performance, order: truth.Order) -> None:
    """Normals of five frames: the one whose wrinkles are deepest in each fifth of the clip."""
    face = truth.face_triangles(studio.head.subject.template, order)
    activity = performance.weights.sum(axis=1)
    for part in np.array_split(np.arange(len(activity)), min(5, len(activity))):
        i = int(part[activity[part].argmax()])
        skin = posed_head(studio.head, performance.weights[i], performance.head_pose[i])
        truth.write_normals(folder, i, skin, performance.cameras[i], face)

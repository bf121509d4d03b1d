"""Small scenes and captures with known truth, for everybody's tests. Made once a session, the same every time.

synthetic.template()                   the shipped head (tests are skipped where it is not built yet)
synthetic.capture(photos=10, ...)      a simulated capture folder and its truth
synthetic.truth(folder)                its cameras and mesh
synthetic.scene(count, size)           pictures of a textured surface with their cameras, no head involved
synthetic.neutral(seed)                the head of somebody who is not in the template, as stage neutral hands it on
synthetic.views(names, files, size)    images of which nothing else is known but what is given
"""

from __future__ import annotations

import atexit
import json
import shutil
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from avatarbuild.artefacts import Neutral, StoredImage, Views
from avatarbuild.errors import InputError
from avatarbuild.geometry.mipmap import build_mipmap
from avatarbuild.simulation.capture import SimulationOptions, simulate
from avatarbuild.simulation.noise import fractal
from avatarbuild.simulation.photographs import look_at
from avatarbuild.simulation.rendering import Camera, Lit, draw
from avatarbuild.simulation.subject import Subject, random_subject
from avatarbuild.template import Template


@dataclass(frozen=True)
class Truth:
    """What is known of a capture: cameras by file name (pixel centres at +0.5), neutral (n, 3) mm, triangles."""

    cameras: dict[str, Camera]
    neutral: np.ndarray
    triangles: np.ndarray
    landmarks68: np.ndarray


@dataclass(frozen=True)
class Scene:
    """images (k, h, w, 3) float32 linear in 0 … 1, the k cameras, and the surface: vertices (n, 3) mm, triangles."""

    images: np.ndarray
    cameras: list[Camera]
    vertices: np.ndarray
    triangles: np.ndarray


@cache
def _folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="avatarbuild-tests-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@cache
def template() -> Template:
    """The shipped head."""
    try:
        return Template.load()
    except InputError as error:
        pytest.skip(str(error))


@cache
def capture(seed: int = 1, **options: float) -> Path:
    """A simulated capture of a seed and SimulationOptions, small unless told otherwise; truth in folder + '.truth'."""
    small = {"photos": 8, "photo_width": 240, "video_seconds": 0.0, "video_width": 180, "texture": 512, **options}
    name = "-".join([f"seed{seed}", *(f"{key}{value}" for key, value in sorted(small.items()))])
    folder = _folder() / name
    simulate(folder, seed, SimulationOptions(**small), template=template())  # type: ignore[arg-type]
    return folder


def truth_folder(folder: Path) -> Path:
    """Where the truth of a capture made here lies."""
    return folder.with_name(folder.name + ".truth")


def truth(folder: Path) -> Truth:
    """The truth of a capture made here."""
    place = truth_folder(folder)
    told = json.loads((place / "cameras.json").read_text())
    cameras = {}
    for photo in told["photos"]:
        K = np.array(photo["K"])
        K[:2, 2] += 0.5
        size = (photo["width"], photo["height"])
        cameras[photo["file"]] = Camera(K, np.array(photo["dist"]), np.array(photo["R"]), np.array(photo["t"]), size)
    with np.load(place / "mesh.npz") as mesh:
        return Truth(cameras, mesh["neutral"].astype(np.float64), mesh["tri"], mesh["lm68"])


@cache
def scene(count: int = 5, size: tuple[int, int] = (240, 180), spread: float = 40.0, seed: int = 0) -> Scene:
    """`count` views over `spread` degrees of a bumpy textured patch, 200 mm wide, about the origin, from 400 mm."""
    rng = np.random.default_rng(seed)
    n = 80
    y, x = np.meshgrid(np.linspace(-100, 100, n + 1), np.linspace(-100, 100, n + 1), indexing="ij")
    z = 25 * np.exp(-(x**2 + y**2) / 60**2) + 4 * np.sin(x / 14) * np.cos(y / 17)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1)
    triangles = np.concatenate([np.stack([i, i + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + n + 1], 1)])
    uv = (vertices[:, :2] + 100) / 200
    rows, columns = np.mgrid[0:512, 0:512] * (200 / 512)
    points = np.stack([columns, rows, np.zeros_like(rows)], -1)
    texture = np.clip(0.4 * np.exp(0.35 * fractal(points, 9.0, 4, seed + 5)), 0.01, 1)[..., None].repeat(3, -1)
    tint = np.array([1.0, 0.85, 0.7]) * np.exp(0.1 * rng.standard_normal(3))
    patch = Lit(
        vertices, triangles.astype(np.int32), uv, triangles, build_mipmap(texture * tint), np.ones((len(uv), 3))
    )
    focal = 1.1 * max(size)
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    cameras = []
    for yaw in np.radians(np.linspace(-spread / 2, spread / 2, count)):
        eye = 400 * np.array([np.sin(yaw), 0.12 * np.cos(3 * yaw), np.cos(yaw)])
        R = look_at(eye, np.zeros(3))
        cameras.append(Camera(K, np.zeros(5), R, -R @ eye, size))
    nothing = None
    images = np.stack([draw(camera, [patch], [], nothing, 2) for camera in cameras])  # type: ignore[arg-type]
    return Scene(images, cameras, vertices, triangles)


@cache
def person(seed: int) -> Subject:
    """A random subject of the shipped head: neutral and expressions are outside the template's space."""
    return random_subject(template(), np.random.default_rng(seed))


@cache
def neutral(seed: int) -> Neutral:
    """What stage neutral would make of `person(seed)`, were it faultless; the eyeballs' texture is a plain disc."""
    t, subject = template(), person(seed)
    n = t.vertex_count
    origin = t.eye_positions(subject.identity).mean(axis=0)
    model = t.neutral(subject.identity) - origin
    y, x = np.mgrid[0:64, 0:64] - 31.5
    disc = np.where((np.hypot(x, y) < 13)[..., None], [96, 60, 40], [236, 232, 228]).astype(np.uint8)
    return Neutral(
        vertices=subject.neutral,
        triangles=t.triangles,
        coefficients=subject.identity,
        model=model,
        eye_centres=subject.eye_centres,
        eye_radius=np.full(2, 12.0),
        head_from_cloud=np.eye(4),
        seen=t.regions["face"].astype(float),
        distance=np.where(t.regions["face"], 0.0, np.nan) * np.ones(n),
        eye_texture=disc,
    )


def views(
    names: list[str],
    files: list[str],
    size: tuple[int, int],
    images: list[StoredImage] | None = None,
    **known: np.ndarray,
) -> Views:
    """Images of one size (width, height) and one lens; the fields of Views that are not given are NaN."""
    k = len(names)
    shapes = {"white_balance": (2,), "landmarks": (478, 3), "scores": (52,), "pose": (3,)}
    scalars = ("focal", "time", "sharpness", "exposure", "clipped", "presence")
    arrays = {name: np.full((k, *shape), np.nan) for name, shape in (shapes | dict.fromkeys(scalars, ())).items()}
    where = {"size": np.tile(size, (k, 1)), "lens": np.zeros(k, int)}
    return Views(names=names, files=files, images=images or [], **(where | arrays | known))

"""The head in a texture, lit anew so that it looks like a picture: how far albedo and still-lit texture reach.

The light is equation (1)'s, found for each picture and texture alike: harmonics of second order under the posed head's
own occlusion, nine numbers a channel, and those with a field of waves over 25 mm besides. `benchmarks/albedo.py PROJECT
video` prints the row of the video, `benchmarks/illumination.py rooms` that of one person in several rooms.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from avatarbuild.artefacts import Albedo, Capture, Performance, Refinement
from avatarbuild.formats.images import encode_png
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.mipmap import Mipmap, build_mipmap, sample_texture
from avatarbuild.geometry.raster import Raster, interpolate, project, rasterise
from avatarbuild.shading.clip import good_frames
from avatarbuild.template import Template
from avatarbuild.texture.occlusion import of_vertices
from avatarbuild.texture.photos import linear_picture, srgb_picture

FRAMES = 10
WAVE = 25.0  # mm: half of a wave this long passes into the field


class Head(NamedTuple):
    """vertices (n, 3) mm; triangles (m, 3); uv (u, 2), uv_triangles (m, 3); face (n,) where it is judged; skin: how
    many of the first triangles are skin; open (n,), bent (n, 3): its occlusion."""

    vertices: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray
    uv_triangles: np.ndarray
    face: np.ndarray
    skin: int
    open: np.ndarray
    bent: np.ndarray


class Shot(NamedTuple):
    """x_cam = R x + t; K with pixel centres at +0.5, dist (5,), size (w, h)."""

    K: np.ndarray
    dist: np.ndarray
    R: np.ndarray
    t: np.ndarray
    size: tuple[int, int]


class Seen(NamedTuple):
    """Of every pixel: linear colour of the texture, whether it shows the face, cosine to the view, a and b."""

    picture: np.ndarray
    face: np.ndarray
    cosine: np.ndarray
    open: np.ndarray
    bent: np.ndarray


def head_of(template: Template, vertices: np.ndarray) -> Head:
    """The template's head; the face without eyes and mouth is judged."""
    regions, skin = template.regions, template.parts["skin"]
    face = regions["face"] & ~regions["sockets"] & ~regions["mouth"]
    occlusion = of_vertices(vertices, template.triangles, skin.vertices)
    return Head(vertices, template.triangles, template.uv, template.uv_triangles, face, skin.triangles.stop, *occlusion)


def rendered(head: Head, levels: Mipmap, shot: Shot) -> Seen:
    """The head in a texture, unlit."""
    pixels, depth = project(head.vertices, shot.K, shot.dist, shot.R, shot.t)
    raster: Raster = rasterise(pixels, depth, head.triangles, shot.size)
    picture = sample_texture(levels, raster, pixels, depth, head.triangles, head.uv, head.uv_triangles)
    towards = -shot.R.T @ shot.t - head.vertices
    cosine = np.einsum("ij,ij->i", vertex_normals(head.vertices, head.triangles), towards)
    cosine /= np.linalg.norm(towards, axis=1)
    columns = np.nan_to_num(np.column_stack([head.face, cosine, head.open, head.bent]))
    smooth = interpolate(columns, head.triangles, raster.triangle, raster.barycentric)
    face = (smooth[..., 0] > 0.99) & (raster.triangle >= 0) & (raster.triangle < head.skin)
    return Seen(picture, face, smooth[..., 1], smooth[..., 2], smooth[..., 3:])


def harmonics(n: np.ndarray) -> np.ndarray:
    """(p, 9) phi(n) of equation (2)."""
    x, y, z = n.T
    return np.stack([np.ones_like(x), x, y, z, x * y, x * z, y * z, x * x - y * y, 3 * z * z - 1], axis=1)


def relit(seen: Seen, real: np.ndarray, use: np.ndarray, pixels: float) -> tuple[np.ndarray, np.ndarray]:
    """The picture under the light that makes it most like `real` over use (h, w), `pixels` to a mm: by harmonics
    alone, and with the field."""
    normal = seen.bent[use] / np.maximum(np.linalg.norm(seen.bent[use], axis=1, keepdims=True), 1e-6)
    phi = harmonics(normal) * seen.open[use][:, None]
    lit = np.zeros_like(seen.picture)
    for c in range(3):
        A = phi * seen.picture[use][:, c : c + 1]
        lit[use, c] = A @ np.linalg.lstsq(A, real[use][:, c], rcond=None)[0]
    sigma = WAVE / (2 * np.pi) * pixels
    masked = seen.picture * use[..., None].astype(np.float32)
    power = cv2.GaussianBlur(masked * masked, (0, 0), sigma)
    field = cv2.GaussianBlur((real - lit) * masked, (0, 0), sigma)
    return lit, lit + field / (power + 0.05 * power[use].mean(axis=0)) * seen.picture


def psnr(a: np.ndarray, b: np.ndarray, use: np.ndarray) -> float:
    """dB between two linear pictures, as sRGB in 0..255, over use (h, w)."""
    one, two = (srgb_picture(x)[use].astype(float) for x in (a, b))
    return float(10 * np.log10(255**2 / np.mean((one - two) ** 2)))


def video(folder: Path, capture: Capture, made: Albedo, truth: Path | None, pictures: Path | None) -> None:
    """
    PSNR on the face in ten of the video's frames, spread over the whole clip: the tracked head in refined shapes; with
    a truth that has a video also the true albedo on the true head, which tells what the fit leaves to a texture.
    """
    assert capture.clip is not None
    for name in ("07-tracking", "08-refinement"):
        if not (folder / name).exists():
            print(f"video: {name} is missing; run the project to the end first")
            return
    template = Template.load()
    performance = Performance.load(folder / "07-tracking")
    shapes = Refinement.load(folder / "08-refinement")
    good = good_frames(performance)
    rows = good[np.linspace(0, len(good) - 1, FRAMES).round().astype(int)]
    w, h = performance.size
    K = np.array([[performance.focal, 0, w / 2], [0, performance.focal, h / 2], [0, 0, 1]])
    textures = {name: build_mipmap(linear_picture(getattr(made, name))) for name in ("fused", "albedo")}
    true = true_video(truth) if truth is not None else None
    values: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        f = int(performance.processed[row])
        real = linear_picture(capture.clip.frames.images[row].rgb())
        posed = shapes.neutral + np.tensordot(performance.weights[f], shapes.deltas.astype(float), 1)
        dist = np.array([performance.k1, 0, 0, 0, 0])
        own = Shot(K, dist, performance.rotation[f], performance.translation[f], performance.size)
        head = head_of(template, posed)
        scenes = {name: (head, levels, own) for name, levels in textures.items()}
        if true is not None:
            scenes["true albedo, true head"] = true(f, performance.size)
        for name, (head, levels, shot) in scenes.items():
            seen = rendered(head, levels, shot)
            use = seen.face & (seen.cosine > 0.3)
            distance = float(np.linalg.norm(shot.R @ head.vertices[head.face].mean(axis=0) + shot.t))
            lit = relit(seen, real, use, shot.K[0, 0] / distance)
            values.setdefault(name, []).append((psnr(lit[0], real, use), psnr(lit[1], real, use)))
            if pictures is not None:
                side_by_side(pictures / f"frame{f}-{name.split(',')[0].replace(' ', '-')}.png", lit[1], real, use)
    print(f"PSNR on the face in {len(rows)} frames of the video, light refitted: harmonics, with the field")
    for name, each in values.items():
        plain, full = np.mean(each, axis=0)
        print(f"  {name:24s} {plain:5.1f}, {full:5.1f} dB ({', '.join(f'{v:.1f}' for _, v in each)})")


def true_video(truth: Path):  # type: ignore[no-untyped-def]
    """A function of frame and size: the true head in the true albedo, posed, its mipmap and its camera."""
    with np.load(truth / "mesh.npz") as m:
        neutral, triangles = m["neutral"].astype(float), m["tri"].astype(np.int32)
        uv, uv_triangles, skin = m["uv"].astype(float), m["uv_index"].astype(np.int32), m["material"] == 0
    with np.load(truth / "video.npz") as v:
        delta, pose, R, t = v["delta"].astype(float), v["head_pose"], v["cam_R"], v["cam_t"]
        K, dist = v["K"] + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], v["dist"]
    order = np.argsort(~skin, kind="stable")
    triangles, uv_triangles = triangles[order], uv_triangles[order]
    levels = build_mipmap(linear_picture(cv2.imread(str(truth / "albedo_face.png"))[..., ::-1].copy()))
    face = np.arange(len(neutral)) < 6706  # the narrow face: truth's vertices are ordered so

    def at(f: int, size: tuple[int, int]) -> tuple[Head, Mipmap, Shot]:
        vertices = neutral.copy()
        vertices[: delta.shape[1]] += delta[f]
        vertices = vertices @ pose[f][:3, :3].T + pose[f][:3, 3]
        occlusion = of_vertices(vertices, triangles, slice(0, delta.shape[1]))
        head = Head(vertices, triangles, uv, uv_triangles, face, int(skin.sum()), *occlusion)
        return head, levels, Shot(K, dist, R[f], t[f], size)

    return at


def side_by_side(path: Path, made: np.ndarray, real: np.ndarray, shown: np.ndarray) -> None:
    """The rendering on the photo, and the photo, half the size."""
    path.parent.mkdir(parents=True, exist_ok=True)
    both = np.hstack([srgb_picture(np.where(shown[..., None], made, real)), srgb_picture(real)])
    path.write_bytes(encode_png(cv2.resize(both, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)))

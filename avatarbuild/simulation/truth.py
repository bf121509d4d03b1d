"""What is known about a simulated capture: cameras, meshes, expressions, normals, albedo, visibility and light.

Vertices are written in an order of their own, so that a scorer can cut the face out by number: the narrow face first
(6,706), then the face (to 9,409), then the rest of the skin (to 11,248), each by its distance from the tip of the
nose; mouth, sockets, eyeballs, teeth, gums and tongue come last. Pixel centres on disk lie at integers.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from avatarbuild.formats.colour import encode_srgb
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.mipmap import sample_texture
from avatarbuild.geometry.raster import Raster, interpolate, rasterise
from avatarbuild.simulation.chart import Chart
from avatarbuild.simulation.light import Light
from avatarbuild.simulation.performance import Performance
from avatarbuild.simulation.photographs import Shot
from avatarbuild.simulation.rendering import Camera, Skin
from avatarbuild.simulation.studio import Head
from avatarbuild.simulation.subject import Subject
from avatarbuild.simulation.wrinkles import GROUPS, gains
from avatarbuild.template import Template

NARROW, FACE, SKIN = 6706, 9409, 11248
_ALBEDO = 2048
_CONVENTION = (
    "head space: mm, origin midway between the eyeball centres, +x the subject's left, +y up, +z out of the face. "
    "Cameras: OpenCV, X_cam = R X + t, pixel centres at integers, dist = k1, k2, p1, p2, k3, for the upright image. "
    "Video frame f: X_cam = cam_R (head_pose (neutral + delta)) + cam_t."
)


@dataclass(frozen=True)
class Order:
    """vertex (n,): the template's vertex at each place of the truth; place (n,): the reverse; landmarks68 (68,)."""

    vertex: np.ndarray
    place: np.ndarray
    landmarks68: np.ndarray


def order_of(template: Template) -> Order:
    """The order of the module's docstring."""
    regions = template.regions
    n = len(template.mean)
    nearest = template.landmark_barycentric.argmax(axis=1)
    of_478 = template.triangles[template.landmark_triangles, nearest]
    landmarks68 = of_478[template.landmarks68]
    distance = np.linalg.norm(template.mean - template.mean[landmarks68[30]], axis=1)
    skin = np.zeros(n, bool)
    skin[template.parts["skin"].vertices] = True
    hidden = regions["mouth"] | regions["sockets"]
    aside = regions["ears"] | regions["neck"] | regions["scalp"]
    rank = np.where(~skin, 3, np.where(hidden, 2, np.where(regions["face"] & ~aside, 0, 1)))
    rank[landmarks68] = 0
    vertex = np.lexsort((distance, rank))
    place = np.empty(n, np.int64)
    place[vertex] = np.arange(n)
    return Order(vertex, place, place[landmarks68])


def write_mesh(folder: Path, subject: Subject, order: Order) -> None:
    """mesh.npz and neutral_face.obj."""
    template = subject.template
    m = min(SKIN, len(order.vertex))
    triangles = order.place[template.triangles].astype(np.int32)
    material = np.ones(len(triangles), np.int32)
    material[template.parts["skin"].triangles] = 0
    neutral = subject.neutral[order.vertex].astype(np.float32)
    names = np.array(template.expression_names)
    _save(
        folder / "mesh.npz",
        neutral=neutral,
        tri=triangles,
        uv_index=template.uv_triangles.astype(np.int32),
        uv=template.uv.astype(np.float32),
        material=material,
        lm68=order.landmarks68,
        face_verts=np.arange(min(FACE, m)),
        narrow_face_verts=np.arange(min(NARROW, m)),
        generic=template.expressions[:, order.vertex[:m]].astype(np.float16),
        true=subject.expressions[:, order.vertex[:m]].astype(np.float16),
        names=names,
        arkit=names,
        identity=subject.identity,
        template_vertex=order.vertex,
    )
    faces = triangles[(triangles < min(FACE, m)).all(axis=1)] + 1
    lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in neutral[: min(FACE, m)]]
    lines += [f"f {a} {b} {c}" for a, b, c in faces]
    (folder / "neutral_face.obj").write_text("\n".join(lines) + "\n")


def write_cameras(
    folder: Path, shots: list[Shot], names: list[str], turns: np.ndarray, video: dict[str, Any] | None
) -> None:
    """cameras.json; `turns` (k, 4, 4): the head's motion in the room at each photo; cameras are told from the head."""
    photos = []
    for shot, name, turn in zip(shots, names, turns, strict=True):
        R, t = shot.camera.R @ turn[:3, :3], shot.camera.R @ turn[:3, 3] + shot.camera.t
        photos.append(
            {
                "file": name,
                "width": shot.camera.size[0],
                "height": shot.camera.size[1],
                "orientation": shot.orientation,
                "K": _integer_centres(shot.camera.K).tolist(),
                "dist": shot.camera.dist.tolist(),
                "R": R.tolist(),
                "t": t.tolist(),
                "yaw": shot.yaw,
                "pitch": shot.pitch,
                "motion_blur_px": float(np.hypot(*shot.blur)),
                "exposure": shot.exposure,
                "wb": shot.balance.tolist(),
                "room_from_head": turn.tolist(),
            }
        )
    told: dict[str, Any] = {"photos": photos, "convention": _CONVENTION}
    if video is not None:
        told["video"] = video
    (folder / "cameras.json").write_text(json.dumps(told))


def video_record(name: str, performance: Performance) -> dict[str, Any]:
    """The video's entry in cameras.json."""
    camera = performance.cameras[0]
    return {
        "file": name,
        "width": camera.size[0],
        "height": camera.size[1],
        "fps": performance.fps,
        "frames": len(performance.weights),
        "K": _integer_centres(camera.K).tolist(),
        "dist": camera.dist.tolist(),
    }


def write_video(folder: Path, subject: Subject, order: Order, performance: Performance) -> None:
    """video.npz: poses, cameras, vertex motion, weights and landmarks of every frame; of none without a video."""
    f, m = len(performance.weights), min(SKIN, len(order.vertex))
    delta = np.empty((f, m, 3), np.float16)
    points, seen = np.empty((f, 68, 2), np.float32), np.empty((f, 68), bool)
    marks = order.vertex[order.landmarks68]
    for i, (weights, pose, camera) in enumerate(
        zip(performance.weights, performance.head_pose, performance.cameras, strict=True)
    ):
        moved = subject.deltas(weights)
        delta[i] = moved[order.vertex[:m]]
        world = (subject.neutral + moved) @ pose[:3, :3].T + pose[:3, 3]
        pixels, _ = camera.project(world[marks])
        points[i] = pixels - 0.5
        seen[i] = visible(camera, world, subject.template.triangles, tolerance=1.5, facing=False)[marks]
    first = performance.cameras[:1]
    names = np.array(subject.template.expression_names)
    folded = [gains(dict(zip(names.tolist(), w.tolist(), strict=True))) for w in performance.weights]
    _save(
        folder / "video.npz",
        head_pose=performance.head_pose,
        cam_R=np.array([c.R for c in performance.cameras]).reshape(f, 3, 3),
        cam_t=np.array([c.t for c in performance.cameras]).reshape(f, 3),
        K=_integer_centres(first[0].K) if first else np.eye(3),
        dist=first[0].dist if first else np.zeros(5),
        delta=delta,
        weights=performance.weights.astype(np.float32),
        names=names,
        arkit=names,
        wrinkle_gain=np.array([[g[name] for name in GROUPS] for g in folded], np.float32).reshape(f, len(GROUPS)),
        wrinkle_names=np.array(list(GROUPS)),
        landmarks68=points,
        landmarks68_visible=seen,
    )


def visible(
    camera: Camera, vertices: np.ndarray, triangles: np.ndarray, *, tolerance: float = 1.0, facing: bool = True
) -> np.ndarray:
    """(n,) bool: inside the picture, not over `tolerance` mm behind what is drawn there, and facing the camera if
    `facing`; landmarks on the rims of lips and lids need not."""
    small = camera.scaled(max(0.5, 540 / camera.size[0]))
    pixels, depth = small.project(vertices)
    w, h = small.size
    drawn = rasterise(pixels, depth, triangles, (w, h)).depth
    with np.errstate(invalid="ignore"):
        inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < [w, h]).all(axis=1)
    where = np.where(inside[:, None], pixels, 0).astype(np.int64)
    ahead = ((camera.centre - vertices) * vertex_normals(vertices, triangles)).sum(axis=1) > 0
    return inside & (ahead | (not facing)) & (depth < drawn[where[:, 1], where[:, 0]] + tolerance)


def write_visibility(folder: Path, counts: np.ndarray, order: Order, chart: Chart) -> None:
    """visibility.npz: photos that see each vertex (m,), and which texels some photo sees."""
    m = min(SKIN, len(order.vertex))
    seen = chart.field((counts > 0).astype(np.float32)) > 0.5
    _save(folder / "visibility.npz", photo_count=counts[order.vertex[:m]].astype(np.int16), uv_mask=seen)


def write_normals(folder: Path, frame: int, skin: Skin, camera: Camera, face: np.ndarray) -> None:
    """normals_%04d.npz: int8 normals (camera axes, wrinkles included) in the face's box; `face` (m,) bool faces."""
    pixels, depth = camera.project(skin.vertices)
    raster = rasterise(pixels, depth, skin.triangles, camera.size, near=40)
    mask = (raster.triangle >= 0) & face[raster.triangle]
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return
    box = np.array([rows.min(), rows.max() + 1, columns.min(), columns.max() + 1])
    cut = np.s_[box[0] : box[1], box[2] : box[3]]
    part = Raster(*(np.ascontiguousarray(layer[cut]) for layer in raster))
    normal = relief_normals(skin, part, pixels - [box[2], box[0]], depth) @ camera.R.T.astype(np.float32)
    inside = mask[cut]
    stored = np.round(127 * normal * inside[..., None]).astype(np.int8)
    _save(folder / f"normals_{frame:04d}.npz", frame=np.array(frame), bbox=box, normal=stored, mask=inside)


def relief_normals(skin: Skin, raster: Raster, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """(h, w, 3): n - dh/du T - dh/dv B, normalised: the surface's normal under its still and moving relief."""
    n, t = (
        _unit(interpolate(v, skin.triangles, raster.triangle, raster.barycentric))
        for v in (skin.normals, skin.tangents)
    )
    t = _unit(t - (t * n).sum(-1, keepdims=True) * n)
    b = np.cross(n, t)
    uv = (skin.triangles, skin.uv, skin.uv_triangles)
    slope = sample_texture(skin.surface, raster, pixels, depth, *uv)[..., 4:6]
    if skin.detail is not None:
        slope = slope + sample_texture(skin.detail, raster, pixels, depth, *uv)[..., :2]
    return _unit(n - slope[..., :1] * t - slope[..., 1:] * b)


def write_albedo(folder: Path, head: Head) -> None:
    """albedo_face.png: sRGB, 2048 x 2048, in the template's chart."""
    albedo = head.surface.albedo
    if albedo.shape[0] != _ALBEDO:
        albedo = cv2.resize(albedo, (_ALBEDO, _ALBEDO), interpolation=cv2.INTER_AREA)
    stored = encode_srgb(albedo)
    if not cv2.imwrite(str(folder / "albedo_face.png"), stored[..., ::-1]):
        raise OSError(f"cannot write {folder / 'albedo_face.png'}")


def write_light(folder: Path, photos: Light, video: Light, exposure: float) -> None:
    """light.npz: y^T (3, 9) of avatarbuild.simulation.light and the environments (96, 192, 3)."""
    _save(
        folder / "light.npz",
        photo_SH=photos.harmonics.T,
        video_SH=video.harmonics.T,
        photo_env=photos.environment().astype(np.float16),
        video_env=video.environment().astype(np.float16),
        photo_exposure=np.array(exposure),
    )


def face_triangles(template: Template, order: Order) -> np.ndarray:
    """(m,) bool: triangles of the skin whose corners are all among the first FACE vertices."""
    face = (order.place[template.triangles] < FACE).all(axis=1)
    skin = np.zeros(len(face), bool)
    skin[template.parts["skin"].triangles] = True
    return face & skin


def _integer_centres(K: np.ndarray) -> np.ndarray:
    moved = K.copy()
    moved[:2, 2] -= 0.5
    return moved


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)


def _save(path: Path, **arrays: Any) -> None:
    # np.savez stamps no time into its archive, so equal arrays give equal bytes.
    with path.open("wb") as stream:
        np.savez_compressed(stream, **arrays)

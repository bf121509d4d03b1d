"""COLMAP's dense workspace: undistorted images, cameras and matching plan written; depth and normal maps read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def read_map(data: bytes) -> np.ndarray:
    """
    (h, w, c) float32 of a depth map (c = 1) or normal map (c = 3) in COLMAP's file: 'width&height&channels&', then
    float32, x fastest, then y, then channel.

    Raises ValueError where the bytes are no such map.
    """
    parts = data.split(b"&", 3)
    if len(parts) != 4 or not all(p.isdigit() for p in parts[:3]):
        raise ValueError("not a map in COLMAP's layout")
    w, h, c = (int(p) for p in parts[:3])
    if len(parts[3]) != 4 * w * h * c:
        raise ValueError(f"a map of {w} x {h} x {c} needs {4 * w * h * c} bytes and has {len(parts[3])}")
    planes = np.frombuffer(parts[3], "<f4").reshape(c, h, w)
    return np.ascontiguousarray(np.moveaxis(planes, 0, -1), np.float32)


def planes_of(depth: np.ndarray, normal: np.ndarray, K: np.ndarray) -> np.ndarray:
    """
    Planes (h, w, 3) of inverse depth and its slopes, from depth (h, w) and normals (h, w, 3) in camera axes.

    On the plane n . X = n . X_0: q(u, v) = g . (u, v, 1) with g = K^-T n / (n . X_0). 0 where either is unknown.
    """
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    rays = np.stack([u + 0.5, v + 0.5, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    n = normal.astype(np.float64)
    distance = (n * rays).sum(axis=-1) * depth
    known = (depth > 0) & (distance < 0)
    g = n @ np.linalg.inv(K) / np.where(known, distance, 1.0)[..., None]
    q = 1.0 / np.where(known, depth, 1.0)
    planes = np.stack([q, g[..., 0], g[..., 1]], axis=-1)
    return np.where(known[..., None], planes, 0.0).astype(np.float32)


def write_workspace(
    folder: Path,
    images: list[np.ndarray],
    K: list[np.ndarray],
    R: list[np.ndarray],
    t: list[np.ndarray],
    sources: list[list[int]],
) -> list[str]:
    """
    Writes images (h, w, 3) uint8 sRGB, PINHOLE cameras and patch-match.cfg; the images' names, '' without sources.

    x_cam = R x + t; pixel centres at +0.5 on both sides.
    """
    import pycolmap

    for part in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps", "stereo/consistency_graphs"):
        (folder / part).mkdir(parents=True)
    model = pycolmap.Reconstruction()
    names = [f"{i:04d}.png" for i in range(len(images))]
    for i, image in enumerate(images):
        height, width = image.shape[:2]
        params = [K[i][0, 0], K[i][1, 1], K[i][0, 2], K[i][1, 2]]
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params, camera_id=i + 1)
        model.add_camera_with_trivial_rig(camera)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R[i]), t[i])
        model.add_image_with_trivial_frame(pycolmap.Image(name=names[i], camera_id=i + 1, image_id=i + 1), pose)
        png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
        (folder / "images" / names[i]).write_bytes(png.tobytes())
    model.write_binary(str(folder / "sparse"))
    plan = [f"{names[i]}\n{', '.join(names[j] for j in mine)}\n" for i, mine in enumerate(sources) if mine]
    (folder / "stereo" / "patch-match.cfg").write_text("".join(plan))
    (folder / "stereo" / "fusion.cfg").write_text("".join(f"{names[i]}\n" for i, mine in enumerate(sources) if mine))
    return [name if mine else "" for name, mine in zip(names, sources)]


def run_patch_match(folder: Path, nearest: float, farthest: float, half_window: int, count: int) -> None:
    """COLMAP's PatchMatch on a CUDA card, with its geometric pass, for depths between the two bounds."""
    import pycolmap

    options = pycolmap.PatchMatchOptions()
    options.depth_min, options.depth_max = nearest, farthest
    options.window_radius = half_window
    options.num_samples = max(15, count)
    options.geom_consistency = True
    options.filter = False  # the fusion here judges agreement itself
    pycolmap.patch_match_stereo(str(folder), options=options)


def read_planes(folder: Path, name: str, K: np.ndarray) -> np.ndarray:
    """Planes (h, w, 3) of one image of a workspace after `run_patch_match`."""
    depth = read_map((folder / "stereo" / "depth_maps" / f"{name}.geometric.bin").read_bytes())
    normal = read_map((folder / "stereo" / "normal_maps" / f"{name}.geometric.bin").read_bytes())
    return planes_of(depth[..., 0], normal, K)

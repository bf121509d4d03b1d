"""Textured spheres and planes photographed by pinhole cameras, exactly: scenes for the tests of dense stereo."""

from __future__ import annotations

import numpy as np

from avatarbuild.geometry.stereo_views import StereoView, grey_pyramid, sharpness


def texture(points: np.ndarray) -> np.ndarray:
    """Grey levels of points (..., 3) in mm: 60 random waves of 4 to 20 mm."""
    rng = np.random.default_rng(5)
    direction = rng.normal(size=(60, 3))
    wave = direction / np.linalg.norm(direction, axis=1, keepdims=True) * (2 * np.pi / rng.uniform(4, 20, (60, 1)))
    return 128.0 + 8.0 * np.sin(points @ wave.T + rng.uniform(0, 2 * np.pi, 60)).sum(axis=-1)


def look_at(centre: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R, t of an upright camera at `centre` that looks at `target` (y up in the world, down in the image)."""
    z = (target - centre) / np.linalg.norm(target - centre)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return R, -R @ centre


def orbit(degrees: float, rise: float, distance: float, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R, t of a camera at these angles from the z axis through the target."""
    a, b = np.radians([degrees, rise])
    return look_at(target + distance * np.array([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)]), target)


def calibration(focal: float, width: int, height: int) -> np.ndarray:
    """K (3, 3) with the principal point in the middle."""
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def rays(K: np.ndarray, R: np.ndarray, t: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The camera's centre and world directions (h, w, 3) of depth 1 through the pixel centres."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    d = np.stack([u + 0.5, v + 0.5, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    return -R.T @ t, d @ R


def sphere_depth(K, R, t, shape, middle, radius) -> np.ndarray:
    """(h, w) depth of a sphere, inf beside it."""
    c, d = rays(K, R, t, shape)
    o = c - middle
    a, b = (d * d).sum(axis=-1), d @ o
    root = b * b - a * (o @ o - radius**2)
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def plane_depth(K, R, t, shape, point, normal) -> np.ndarray:
    """(h, w) depth of a plane."""
    c, d = rays(K, R, t, shape)
    return ((point - c) @ normal) / (d @ normal)


def picture(K, R, t, depth: np.ndarray) -> np.ndarray:
    """(h, w) grey levels of the textured surface at these depths, 30 beside it."""
    c, d = rays(K, R, t, depth.shape)
    hit = np.isfinite(depth)
    grey = np.full(depth.shape, 30.0)
    grey[hit] = texture(c + d[hit] * depth[hit][:, None])
    return np.clip(grey, 0, 255)


def view(i: int, K, R, t, depth: np.ndarray, levels: int) -> StereoView:
    """A StereoView of the surface."""
    colour = np.repeat(np.round(picture(K, R, t, depth)).astype(np.uint8)[..., None], 3, axis=2)
    grey = grey_pyramid(colour, levels)
    return StereoView(i, f"{i:02d}.jpg", K, R, t, colour, grey, sharpness(grey[0]))

"""The photos as dense stereo sees them: undistorted, cut to the subject's region, with their source photos."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np

from avatarbuild.geometry.patchmatch import Sources

_GREY = np.array([0.299, 0.587, 0.114], np.float32)


class Region(NamedTuple):
    """The ellipsoid that holds the subject: centre (3,), half axes (3,) along the world's axes."""

    centre: np.ndarray
    axes: np.ndarray


@dataclass(frozen=True)
class StereoView:
    """
    One photo at the working size, cut to the subject.

    photo      index of the photo;  name its image name
    K          (3, 3) of the cut image, no distortion;  R (3, 3), t (3,): x_cam = R x + t
    colour     (h, w, 3) uint8 sRGB
    grey       float32 grey levels, (h, w) and each next one half the size of the last
    sharpness  see `sharpness`
    """

    photo: int
    name: str
    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    colour: np.ndarray
    grey: list[np.ndarray]
    sharpness: float

    @property
    def centre(self) -> np.ndarray:
        """(3,) the camera's position."""
        return -self.R.T @ self.t

    def calibration(self, level: int) -> np.ndarray:
        """K (3, 3) of pyramid level `level`."""
        return np.diag([0.5**level, 0.5**level, 1.0]) @ self.K


def head_region() -> Region:
    """
    The head in the head frame, mm: origin between the eyes, y up, z out of the face.

    A tall adult head spans 80 mm to each side, 130 up, 125 down and 200 back (95th percentiles of anthropometric
    tables); the ellipsoid leaves 50 mm for hair and scale, holds the neck and cuts the shoulders.
    """
    return Region(np.array([0.0, -10.0, -75.0]), np.array([135.0, 190.0, 140.0]))


def subject_region(centres: np.ndarray, axes: np.ndarray, points: np.ndarray, seen: np.ndarray) -> Region:
    """
    The ball around what the cameras look at, where there is no head frame.

    Centre: the point nearest to all optical axes, argmin_c sum_i |(I - d_i d_i^T)(c - c_i)|, by reweighting. Radius:
    0.45 of the cameras' median distance, cut to 1.1 times the radius that holds 95 % of the sparse points inside.
    centres (k, 3), axes (k, 3) unit, points (n, 3), seen (n,) number of photos of each.
    """
    P = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    w = np.ones(len(centres))
    c = centres.mean(axis=0)
    for _ in range(20):
        A = np.einsum("k,kij->ij", w, P) + 1e-9 * np.eye(3)
        c = np.linalg.solve(A, np.einsum("k,kij,kj->i", w, P, centres))
        miss = np.linalg.norm(np.einsum("kij,kj->ki", P, c - centres), axis=1)
        w = 1.0 / np.maximum(miss, 0.02 * np.median(np.linalg.norm(centres - c, axis=1)))
    radius = 0.45 * float(np.median(np.linalg.norm(centres - c, axis=1)))
    near = np.linalg.norm(points - c, axis=1)
    inside = near[(near < radius) & (seen >= 3)]
    if len(inside) >= 100:
        radius = min(radius, 1.1 * float(np.quantile(inside, 0.95)))
    return Region(c, np.full(3, radius))


def region_bounds(region: Region, K: np.ndarray, R: np.ndarray, t: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """
    (2, h, w) float32: least and greatest inverse depth of each pixel's ray inside the region; 0 where it misses.

    With ray o + z d in units of the half axes: |o + z d| = 1.
    """
    v, u = np.mgrid[: shape[0], : shape[1]]
    pixels = np.stack([u + 0.5, v + 0.5, np.ones_like(u)], axis=-1)
    d = pixels @ (np.linalg.inv(K).T @ R) / region.axes
    o = (-R.T @ t - region.centre) / region.axes
    a = (d * d).sum(axis=-1)
    b = d @ o
    root = np.sqrt(np.maximum(b * b - a * (o @ o - 1.0), 0.0))
    far = (root - b) / a
    near = np.maximum((-root - b) / a, 0.1 * np.linalg.norm(-R.T @ t - region.centre))
    hit = (root > 0) & (far > near)
    return np.where(hit, np.stack([1.0 / np.where(hit, far, 1.0), 1.0 / near]), 0.0).astype(np.float32)


def silhouette_box(region: Region, K: np.ndarray, R: np.ndarray, t: np.ndarray) -> tuple[float, float, float, float]:
    """
    Left, top, right, bottom pixel bounds of the region's image.

    The silhouette is the dual conic of K [R t] Q* [R t]^T K^T with Q* the ellipsoid's dual quadric.
    """
    Q = np.zeros((4, 4))
    Q[:3, :3] = np.diag(region.axes**2) - np.outer(region.centre, region.centre)
    Q[:3, 3] = Q[3, :3] = -region.centre
    Q[3, 3] = -1.0
    P = K @ np.hstack([R, t[:, None]])
    C = P @ Q @ P.T
    if C[2, 2] >= 0:  # the camera is inside, or the region beside or behind it
        return -np.inf, -np.inf, np.inf, np.inf
    box = []
    for i in range(2):
        mid = C[i, 2] / C[2, 2]
        half = np.sqrt(max(mid * mid - C[i, i] / C[2, 2], 0.0))
        box.append((mid - half, mid + half))
    return box[0][0], box[1][0], box[0][1], box[1][1]


def pinhole(camera: Any, longest: int) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """
    K (3, 3) of the undistorted image scaled to `longest` pixels, and the box of it that the photo fills.

    camera: a pycolmap.Camera of the full size.
    """
    scale = min(1.0, longest / max(camera.width, camera.height))
    K = np.array(camera.calibration_matrix())
    focal = scale * 0.5 * (K[0, 0] + K[1, 1])
    K = np.array([[focal, 0.0, scale * K[0, 2]], [0.0, focal, scale * K[1, 2]], [0.0, 0.0, 1.0]])
    s = np.linspace(0.0, 1.0, 65)
    rim = {
        "left": np.stack([0 * s, camera.height * s], axis=1),
        "top": np.stack([camera.width * s, 0 * s], axis=1),
        "right": np.stack([0 * s + camera.width, camera.height * s], axis=1),
        "bottom": np.stack([camera.width * s, 0 * s + camera.height], axis=1),
    }
    flat = {side: np.asarray(camera.cam_from_img(at)) * focal + K[:2, 2] for side, at in rim.items()}
    left, top = flat["left"][:, 0].max(), flat["top"][:, 1].max()
    return K, (left, top, flat["right"][:, 0].min(), flat["bottom"][:, 1].min())


def undistorted(rgb: np.ndarray, camera: Any, K: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """
    (h, w, 3) uint8: the photo as the pinhole camera K of `size` (width, height) sees it.

    The photo is smoothed to the new pixels' size first, so that neither aliasing nor the bilinear samples of the
    matching favour whole pixels.
    """
    width, height = size
    step = 8  # lens distortion is smooth: its map is exact at every 8th pixel and linear between
    x, y = np.meshgrid(np.arange(0, width + step, step), np.arange(0, height + step, step))
    rays = (np.stack([x.ravel() + 0.5, y.ravel() + 0.5, np.ones(x.size)], axis=1) @ np.linalg.inv(K).T).reshape(-1, 3)
    at = np.asarray(camera.img_from_cam(rays)).reshape(*x.shape, 2)
    at = at * np.array([rgb.shape[1] / camera.width, rgb.shape[0] / camera.height])
    row, column = np.arange(height) / step, np.arange(width) / step
    grid = np.meshgrid(column.astype(np.float32), row.astype(np.float32))
    maps = [cv2.remap(at[..., i].astype(np.float32), *grid, cv2.INTER_LINEAR) - 0.5 for i in range(2)]
    scale = (rgb.shape[1] / camera.width) * camera.calibration_matrix()[0, 0] / K[0, 0]
    x0, x1 = max(int(maps[0].min()) - 8, 0), min(int(maps[0].max()) + 9, rgb.shape[1])
    y0, y1 = max(int(maps[1].min()) - 8, 0), min(int(maps[1].max()) + 9, rgb.shape[0])
    part = np.ascontiguousarray(rgb[y0:y1, x0:x1])
    if scale > 1.15:
        part = cv2.GaussianBlur(part, (0, 0), 0.5 * scale)
    return cv2.remap(part, maps[0] - x0, maps[1] - y0, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def stereo_view(
    photo: int,
    name: str,
    read: Callable[[], np.ndarray],
    camera: Any,
    R: np.ndarray,
    t: np.ndarray,
    region: Region,
    longest: int,
    levels: int,
    margin: int,
) -> StereoView | None:
    """
    The photo that `read` gives, scaled to `longest` pixels and cut to the region and `margin` pixels around it.

    None where it shows too little of the region to be matched.
    """
    K, inside = pinhole(camera, longest)
    box = silhouette_box(region, K, R, t)
    left, top = (int(np.ceil(max(a - margin, b))) for a, b in zip(box[:2], inside[:2]))
    right, bottom = (int(np.floor(min(a + margin, b))) for a, b in zip(box[2:], inside[2:]))
    unit = 2 ** (levels - 1)
    w, h = (right - left) // unit * unit, (bottom - top) // unit * unit
    if min(w, h) < max(8 * unit, 4 * margin):
        return None
    K[:2, 2] -= left, top
    colour = undistorted(read(), camera, K, (w, h))
    grey = grey_pyramid(colour, levels)
    return StereoView(photo, name, K, R.copy(), t.copy(), colour, grey, sharpness(grey[0]))


def grey_pyramid(colour: np.ndarray, levels: int) -> list[np.ndarray]:
    """Float32 grey levels of (h, w, 3) uint8 and their means over 2x2, 4x4, ... pixels, which h and w must allow."""
    pyramid = [colour.astype(np.float32) @ _GREY]
    for _ in range(levels - 1):
        g = pyramid[-1]
        pyramid.append(0.25 * (g[::2, ::2] + g[1::2, ::2] + g[::2, 1::2] + g[1::2, 1::2]))
    return pyramid


def sharpness(grey: np.ndarray) -> float:
    """
    Fine detail against coarse detail of (h, w) grey levels, in the direction that has least: motion blurs in one only.

    sqrt(min eig(C^-1 F)), F and C the mean gradient tensors of the bands g - G_2 g and G_2 g - G_5 g (G_s Gaussian).
    """

    def tensor(band: np.ndarray) -> np.ndarray:
        d = np.stack([cv2.Sobel(band, cv2.CV_32F, 1, 0).ravel(), cv2.Sobel(band, cv2.CV_32F, 0, 1).ravel()])
        return (d @ d.T).astype(np.float64) / band.size

    middle = cv2.GaussianBlur(grey, (0, 0), 2.0)
    fine, coarse = tensor(grey - middle), tensor(middle - cv2.GaussianBlur(grey, (0, 0), 5.0))
    ratio = np.linalg.eigvals(np.linalg.solve(coarse + 1e-6 * np.eye(2), fine))
    return float(np.sqrt(max(float(ratio.real.min()), 0.0)))


def relative_sharpness(sharp: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """(k,) sharpness over the median of the views within 25 degrees, which see the same; angle (k, k) degrees."""
    return np.array([sharp[i] / max(float(np.median(sharp[angle[i] < 25.0])), 1e-12) for i in range(len(sharp))])


def view_angles(centres: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """(k, k) degrees between the directions in which cameras at `centres` (k, 3) stand from `middle` (3,)."""
    d = centres - middle
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    return np.degrees(np.arccos(np.clip(d @ d.T, -1.0, 1.0)))


def angle_worth(degrees: np.ndarray) -> np.ndarray:
    """
    What a pair of views at this angle is worth, 0 to 1: best at 15 degrees.

    Below, depth is uncertain as 1 / sin(angle); above, the two see different things.
    """
    width = np.where(degrees < 15.0, 6.0, 10.0)
    return np.where((degrees < 3.0) | (degrees > 45.0), 0.0, np.exp(-0.5 * ((degrees - 15.0) / width) ** 2))


def choose_sources(
    angle: np.ndarray, footprints: np.ndarray, sharp: np.ndarray, overlap: np.ndarray, count: int
) -> list[list[int]]:
    """
    The source views of each view, best first.

    One after the other the view of greatest worth: of its angle to the reference, its relative sharpness (to the
    fourth: a tenth less detail costs a third), the share of the subject in common, the likeness of scale; less for
    standing where a chosen one stands, so that the sources surround the reference and some see each of its sides.
    angle (k, k) degrees, footprints (k,) size of a pixel at the subject, sharp (k,), overlap (k, k).
    """
    scale = np.abs(np.log(footprints[:, None] / footprints[None, :]))
    worth = angle_worth(angle) * np.exp(-((scale / 0.5) ** 2)) * overlap * np.minimum(sharp, 1.0)[None, :] ** 4
    chosen = []
    for i in range(len(angle)):
        left = worth[i].copy()
        left[i] = 0.0
        mine: list[int] = []
        while len(mine) < count and left.max() > 0.01:
            j = int(np.argmax(left))
            mine.append(j)
            left *= 1.0 - np.exp(-((angle[j] / 12.0) ** 2))
            left[j] = 0.0
        chosen.append(mine)
    return chosen


def overlaps(views: list[StereoView], region: Region) -> np.ndarray:
    """(k, k) share of the region that view i frames and view j frames too."""
    z, y, x = np.mgrid[-0.8:0.9:0.4, -0.8:0.9:0.4, -0.8:0.9:0.4].reshape(3, -1)
    unit = np.stack([x, y, z], axis=1)
    points = region.centre + region.axes * unit[np.linalg.norm(unit, axis=1) < 1.0]
    framed = []
    for v in views:
        p = (points @ v.R.T + v.t) @ v.K.T
        at = p[:, :2] / np.maximum(p[:, 2:], 1e-9)
        framed.append((p[:, 2] > 0) & (at > 0).all(axis=1) & (at < np.array(v.grey[0].shape[::-1])).all(axis=1))
    both = np.array(framed, float)
    return (both @ both.T) / np.maximum(both.sum(axis=1), 1.0)[:, None]


def source_images(
    views: list[StereoView], i: int, others: list[int], level: int, planes: list[np.ndarray] | None
) -> Sources:
    """View i's sources at pyramid level `level`; `planes`: the maps (h, w, 3) of all views there, if any."""
    K = views[i].calibration(level)
    M, k, back = [], [], []
    for j in others:
        R = views[j].R @ views[i].R.T
        t = views[j].t - R @ views[i].t
        Kj = views[j].calibration(level)
        M.append(Kj @ R @ np.linalg.inv(K))
        k.append(Kj @ t)
        back.append(np.hstack([K @ R.T @ np.linalg.inv(Kj), (-K @ R.T @ t)[:, None]]))
    images = [views[j].grey[level] for j in others]
    maps = [planes[j] for j in others] if planes is not None else []
    sizes = np.array([a.shape for a in images], np.int64).reshape(-1, 2)
    start = lambda s: np.concatenate([[0], np.cumsum(s.prod(axis=1))])[:-1].astype(np.int64)  # noqa: E731
    return Sources(
        np.concatenate([a.ravel() for a in images]).astype(np.float32),
        start(sizes),
        sizes[:, 1].copy(),
        sizes[:, 0].copy(),
        np.array(M, np.float32),
        np.array(k, np.float32),
        np.array(back, np.float32),
        np.concatenate([a.reshape(-1, 3) for a in maps]) if maps else np.zeros((0, 3), np.float32),
    )

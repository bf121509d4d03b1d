"""Where the photos see the irises: rims found in pictures laid onto the irises' own planes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.geometry.iris import iris_circle
from avatarbuild.geometry.triangulation import triangulate
from avatarbuild.landmarks import IRISES
from avatarbuild.sfm.metric import Placed

MOST_TURNED = 40.0  # degrees of yaw up to which an iris's rim is looked for
MOST_PHOTOS = 12
_LEAST_SHOWN = 0.6  # share of the angles at which the rim must show
_WINDOW, _RADIUS = 160, 40.0  # pixels of the window on the iris's plane, and of an iris in it
_LEAST_PIXELS = 7.0  # radius of an iris in a photo, to be measured
_ROBUST = 0.003  # radians


@dataclass(frozen=True)
class Photos:
    """
    What is asked of the photos: `placed` those with a camera; of all the capture's photos landmarks (k, 478, 3) pixels,
    trusted (k,) bool, yaw (k,) degrees, sharpness (k,), and picture(i) -> (h, w, 3) uint8 sRGB.
    """

    placed: Placed
    landmarks: np.ndarray
    trusted: np.ndarray
    yaw: np.ndarray
    sharpness: np.ndarray
    picture: Callable[[int], np.ndarray]


@dataclass(frozen=True)
class IrisSightings:
    """
    r rims seen: eye (r,) 0 left, 1 right; photo (r,) placed; centre (r, 3) of the camera; direction (r, 3) unit, to the
    iris's middle; radius (r,) mm, as large as the rim is on the iris's plane; points (2, 3) the middles triangulated,
    NaN where fewer than two photos show one.
    """

    eye: np.ndarray
    photo: np.ndarray
    centre: np.ndarray
    direction: np.ndarray
    radius: np.ndarray
    points: np.ndarray


def chosen(photos: Photos) -> np.ndarray:
    """(j,) placed photos to look for irises in: trusted ones, evenly over yaw, the sharpest of each share."""
    yaw = photos.yaw[photos.placed.index]
    fit = np.flatnonzero(photos.trusted[photos.placed.index] & (np.abs(yaw) <= MOST_TURNED))
    if len(fit) <= MOST_PHOTOS:
        return fit
    share = np.array_split(fit[np.argsort(yaw[fit], kind="stable")], MOST_PHOTOS)
    sharpness = photos.sharpness[photos.placed.index]
    return np.array([part[np.argmax(np.nan_to_num(sharpness[part]))] for part in share])


def iris_sightings(photos: Photos, ahead: np.ndarray, radius: float) -> IrisSightings:
    """Rims of `radius` mm, within a fifth, on planes across `ahead` (3,), the direction that the face looks in."""
    placed = photos.placed
    use = chosen(photos)
    points = np.full((2, 3), np.nan)
    if len(use) >= 2:
        middles = [iris.start for iris in IRISES]
        directions = [placed.rays(int(p), photos.landmarks[placed.index[p], middles, :2]) for p in use]
        d = np.stack(directions, axis=1)
        points, _ = triangulate(placed.centres[use], d, np.ones(d.shape[:2]), _ROBUST)
    found: list[tuple[int, int, np.ndarray, float]] = []
    for p in use:
        picture = cv2.cvtColor(photos.picture(int(placed.index[p])), cv2.COLOR_RGB2GRAY)
        for eye in range(2):
            seen = _rim(photos, int(p), picture, points[eye], ahead, radius)
            if seen is not None:
                found.append((eye, int(p), *seen))
    of_eye = np.array([f[0] for f in found], int)
    photo = np.array([f[1] for f in found], int)
    centre = placed.centres[photo].reshape(-1, 3)
    direction = np.array([f[2] for f in found]).reshape(-1, 3)
    for k in range(2):
        own = np.flatnonzero(of_eye == k)
        if len(own) >= 2:
            points[k] = triangulate(centre[own], direction[own][None], np.ones((1, len(own))), _ROBUST)[0][0]
    return IrisSightings(of_eye, photo, centre, direction, np.array([f[3] for f in found]), points)


def plane_axes(ahead: np.ndarray) -> np.ndarray:
    """(2, 3) unit: to the right and down as somebody sees it who stands before a plane that faces `ahead`."""
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    return np.stack([right, -np.cross(ahead, right)])


def on_plane(
    picture: np.ndarray, placed: Placed, p: int, point: np.ndarray, axes: np.ndarray, size: int, step: float
) -> np.ndarray:
    """(size, size[, 3]) picture laid onto the plane through `point` with `axes` (2, 3); `step` mm a pixel."""
    return sample(picture, placed, p, point + plane_grid(size, step) @ axes)


def plane_grid(size: int, step: float) -> np.ndarray:
    """(size, size, 2) mm of the pixels' centres from the middle of a window."""
    along = (np.arange(size) + 0.5 - size / 2) * step
    return np.stack(np.meshgrid(along, along), axis=-1)


def sample(picture: np.ndarray, placed: Placed, p: int, points: np.ndarray) -> np.ndarray:
    """(a, b[, 3]) colours of the picture at points (a, b, 3) of the world."""
    # OpenCV counts from the first pixel's centre
    x, y = (project(placed, p, points.reshape(-1, 3)) - 0.5).astype(np.float32).T.reshape(2, *points.shape[:2])
    return cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def project(placed: Placed, p: int, points: np.ndarray) -> np.ndarray:
    """(n, 2) pixels of points (n, 3) in placed photo number p."""
    return np.asarray(placed.cameras[p].img_from_cam(points @ placed.rotation[p].T + placed.translation[p]))


def _rim(
    photos: Photos, p: int, grey: np.ndarray, point: np.ndarray, ahead: np.ndarray, radius: float
) -> tuple[np.ndarray, float] | None:
    """Direction to the iris's middle and its radius in mm; None where no rim shows."""
    placed = photos.placed
    if not np.isfinite(point).all():
        return None
    distance = float(np.linalg.norm(point - placed.centres[p]))
    if placed.cameras[p].mean_focal_length() * radius / distance < _LEAST_PIXELS:
        return None
    axes, step = plane_axes(ahead), radius / _RADIUS
    window = on_plane(grey, placed, p, point, axes, _WINDOW, step)
    middle, size, shown = iris_circle(window, np.full(2, _WINDOW / 2), _RADIUS)
    if shown < _LEAST_SHOWN:
        return None
    towards = point + (middle - _WINDOW / 2) * step @ axes - placed.centres[p]
    return towards / np.linalg.norm(towards), size * step

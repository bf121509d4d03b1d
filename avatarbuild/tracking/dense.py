"""
Where the frame shows each point of the skin: dense optical flow from the head as it is drawn to the frame.

A drawn head that is off by more than the footprint of equation (6) is out of that energy's reach; patches searched over
the pyramid find it [DIS; Kroeger et al. 2016]. What the flow there and back does not agree on is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.geometry.meshes import face_normals
from avatarbuild.geometry.mipmap import Mipmap, sample_texture
from avatarbuild.geometry.raster import rasterise
from avatarbuild.tracking.frames import Frame
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.rig import Places

LEVEL = 1  # of the pyramid, that the flow is computed at where nothing else is said
_FLAT = 3.0  # pixels: the spread of the mean that is taken off both pictures
_GREY = 40.0  # grey levels of a standard deviation
_FAINT = 0.01  # of the logarithm: fainter texture stays faint
_AGREE = 1.0  # pixels at that level: flow there and back
_PATCH, _STRIDE = 8, 4  # pixels: of the flow's patches, and from one to the next; every third finds no more
_CELL = 5  # one target for so many pixels square
_FACING = 0.35
_WINDOW = 0.2  # of the face's width, about: within it flow says whether something hides the face
_LEAST_TRIED = 0.2  # of that window
_WAY = 24.0  # pixels at that level: no face moves farther between what is drawn and what is seen


@dataclass(frozen=True)
class Targets:
    """
    places of p points of the skin, their pictures (p, 2) pixels in a frame, and their share of those looked for; cover
    (h, w) in 0..1: that share about each pixel of the crop, whose corner (2,) lies in the frame and whose pixels are
    `scale` wide; density: how many were looked for on a square millimetre of skin.
    """

    places: Places
    pictures: np.ndarray
    share: float
    cover: np.ndarray
    corner: np.ndarray
    scale: float
    density: float

    def covered(self, pixels: np.ndarray) -> np.ndarray:
        """(q,) the share about points (q, 2) of the frame; 1 beyond the face."""
        x, y = np.asarray((pixels - self.corner) / self.scale - 0.5, np.float32).T.copy()
        shares = cv2.remap(self.cover, x[:, None], y[:, None], cv2.INTER_NEAREST, borderValue=1.0)
        return np.asarray(shares, np.float64).ravel()


def targets(
    frame: Frame,
    posed: np.ndarray,
    triangles: np.ndarray,
    region: np.ndarray,
    texture: tuple[Mipmap, np.ndarray, np.ndarray],
    lens: Lens,
    R: np.ndarray,
    t: np.ndarray,
    level: int = LEVEL,
) -> Targets:
    """
    posed (n, 3) in the head frame; triangles (m, 3) of the skin, region (m,) bool those that have a texture: the
    logarithm of its grey as a mipmap with uv (u, 2) and uv_triangles (m, 3).
    """
    scale = float(1 << level)
    seen = frame.pyramid[level]
    h, w = seen.shape
    camera = posed @ R.T + t
    pixels = (lens.project(camera)[0] - frame.corner) / scale
    raster = rasterise(pixels, camera[:, 2], triangles, (w, h))
    mipmap, uv, uv_triangles = texture
    drawn = sample_texture(mipmap, raster, pixels, camera[:, 2], triangles, uv, uv_triangles)[..., 0]
    middle = camera[triangles].mean(axis=1)
    facing = -np.einsum("ij,ij->i", face_normals(camera, triangles), middle) / np.linalg.norm(middle, axis=1)
    on = np.append(region & (facing > _FACING), False)[raster.triangle]
    density = float(lens.focal / max(np.median(middle[region, 2]), 1.0) / (scale * _CELL)) ** 2
    if on.sum() < 400:
        nothing = np.ones((h, w), np.float32)
        return Targets(
            Places(np.zeros(0, np.int64), np.zeros((0, 3))),
            np.zeros((0, 2)),
            0.0,
            nothing,
            frame.corner,
            scale,
            density,
        )
    there, apart = np.zeros((h, w, 2), np.float32), np.full((h, w), np.inf, np.float32)
    window = _face_window(on)
    there[window], apart[window] = flow_there_and_back(
        levelled(drawn[window], on[window]), levelled(seen[window], on[window])
    )
    inner = cv2.erode(on.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    good = inner & (apart < _AGREE) & (np.linalg.norm(there, axis=2) < _WAY)
    cells = np.zeros_like(good)
    cells[_CELL // 2 :: _CELL, _CELL // 2 :: _CELL] = True
    row, column = np.nonzero(good & cells)
    # the barycentric point of a pixel is where its centre meets the surface
    at = np.stack([column, row], axis=1) + there[row, column].astype(np.float64) + 0.5
    places = Places(raster.triangle[row, column].astype(np.int64), raster.barycentric[row, column].astype(np.float64))
    share = len(row) / max(int((inner & cells).sum()), 1)
    return Targets(places, at * scale + frame.corner, share, _about(good, inner), frame.corner, scale, density)


def _face_window(on: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of a picture that hold the face, `on`, with a patch's width about it."""
    (top, bottom), (left, right) = (np.flatnonzero(on.any(axis=axis))[[0, -1]] for axis in (1, 0))
    rows = slice(max(int(top) - _PATCH, 0), int(bottom) + 1 + _PATCH)
    return rows, slice(max(int(left) - _PATCH, 0), int(right) + 1 + _PATCH)


def _about(good: np.ndarray, tried: np.ndarray) -> np.ndarray:
    """(h, w) float32 the share of the tried pixels that are good in a window about each; 1 where few were tried."""
    side = 2 * int(_WINDOW * np.sqrt(tried.sum()) / 2) + 1
    sums = [
        cv2.boxFilter(mask.astype(np.float32), -1, (side, side), borderType=cv2.BORDER_CONSTANT)
        for mask in (good, tried)
    ]
    return np.where(sums[1] > _LEAST_TRIED, sums[0] / np.maximum(sums[1], _LEAST_TRIED), 1).astype(np.float32)


def levelled(picture: np.ndarray, on: np.ndarray) -> np.ndarray:
    """uint8 of the picture on the face, flat beyond it: less its local mean there, over its local spread."""
    inside = np.maximum(cv2.GaussianBlur(on.astype(np.float32), (0, 0), _FLAT), 1e-3)
    value = np.where(on, picture, 0).astype(np.float32)
    detail = np.where(on, picture - cv2.GaussianBlur(value, (0, 0), _FLAT) / inside, 0).astype(np.float32)
    spread = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), _FLAT) / inside)
    return np.clip(128 + _GREY * detail / (spread + _FAINT), 0, 255).astype(np.uint8)


def flow_there_and_back(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 2) pixels from a to b, both (h, w) uint8, and (h, w) how far there and back ends from the start."""
    there, back = flow(a, b), flow(b, a)
    i, j = np.mgrid[0 : a.shape[0], 0 : a.shape[1]].astype(np.float32)
    to_x, to_y = j + there[..., 0], i + there[..., 1]
    returned = cv2.remap(back, to_x, to_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e3, 1e3))
    return there, np.linalg.norm(there + returned, axis=2)


def flow(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(h, w, 2) float32 pixels from a to b, both (h, w) uint8."""
    engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    engine.setFinestScale(0)
    engine.setPatchStride(_STRIDE)
    return np.asarray(engine.calc(a, b, np.zeros((*a.shape, 2), np.float32)))

"""
What the body does in the pictures, where the camera in a hand sways and the body leans: a patch of one frame, from
below the chin down over neck and collar, is found again in every other, first by its place, then with size and roll.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.tracking.lens import Lens

SIDE = 240  # pixels of a frame's longer side as the body is looked for in it
_BLUR = 2.0  # of these: stripes and cloth's threads are all alike, collars are not
_TOP, _DOWN, _ACROSS = 0.1, 1.2, 1.2  # the patch below the chin and to both sides, of the way from chin to nose bridge
_LEAST, _FEWEST = 0.5, 8  # of that way, and pixels: less of a body says nothing
_REACH = 0.45  # of that way: how far bodies and cameras go
_STEPS, _SETTLED = 12, 0.005  # Gauss-Newton, until it moves by so many pixels
_ALIKE = 0.7  # correlation from which the patch counts as found
_MOST = np.array([0.15, 0.25])  # of logarithmic size, radians of roll


@dataclass(frozen=True)
class Motion:
    """x' = R x + t of the body in camera axes since the patch's own frame: R (3, 3), t (3,) mm."""

    R: np.ndarray
    t: np.ndarray

    def of(self, R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where it takes a pose."""
        return self.R @ R, self.R @ t + self.t

    def undone(self, R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What it takes to a pose."""
        return self.R.T @ R, self.R.T @ (t - self.t)


STILL = Motion(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Patch:
    """
    picture (h, w) float32 of a whole frame by `whole`; rows, columns: the patch in it; scale: its pixels for one of
    the frame's; depth mm of the patch, seen through `lens`.
    """

    picture: np.ndarray
    rows: slice
    columns: slice
    scale: float
    reach: int
    depth: float
    lens: Lens

    def find(self, picture: np.ndarray) -> Motion | None:
        """
        The motion of the body in another frame's picture, None where the patch is not found there.

        min over shift d, size s, roll a of  sum |g I(c + d + s R(a) x) - P(x)|, both less their means, by reweighted
        Gauss-Newton from the shift that correlates best; depth is `depth` / s.
        """
        if picture.shape != self.picture.shape:
            return None
        P = self.picture[self.rows, self.columns]
        dy, dx = np.gradient(P)
        middle = np.array([self.columns.start + (P.shape[1] - 1) / 2, self.rows.start + (P.shape[0] - 1) / 2])
        y, x = (
            np.mgrid[: P.shape[0], : P.shape[1]]
            - middle[::-1, None, None]
            + [[[self.rows.start]], [[self.columns.start]]]
        )
        J = np.stack([dx, dy, dx * x + dy * y, dy * x - dx * y], axis=-1).reshape(-1, 4)
        J -= J.mean(axis=0)
        wanted = (P - P.mean()).ravel().astype(np.float64)
        found = np.r_[self._shift(picture, P), 0, 0]
        for _ in range(_STEPS):
            shown = self._shown(picture, middle + found[:2], found[2], found[3], x, y)
            gain = (shown @ wanted) / max(shown @ shown, 1e-9)
            off = gain * shown - wanted
            worth = 1 / np.maximum(np.abs(off), np.median(np.abs(off)) + 1e-6)
            step = np.linalg.solve((J * worth[:, None]).T @ J + 1e-6 * np.eye(4), (J * worth[:, None]).T @ off)
            found -= step
            if np.abs(step[:2]).max() < _SETTLED or (np.abs(found[2:]) > _MOST).any():
                break
        shown = self._shown(picture, middle + found[:2], found[2], found[3], x, y)
        alike = (shown @ wanted) / max(np.linalg.norm(shown) * np.linalg.norm(wanted), 1e-9)
        if alike < _ALIKE or (np.abs(found[2:]) > _MOST).any():
            return None
        R = cv2.Rodrigues(np.array([0, 0, found[3]]))[0]
        return Motion(R, self._point(middle + found[:2], found[2]) - R @ self._point(middle, 0.0))

    def _shift(self, picture: np.ndarray, P: np.ndarray) -> np.ndarray:
        """(2,) x, y pixels at which the patch P correlates best with the picture."""
        m = self.reach
        wide = cv2.copyMakeBorder(picture, m, m, m, m, cv2.BORDER_REPLICATE)
        part = wide[self.rows.start : self.rows.stop + 2 * m, self.columns.start : self.columns.stop + 2 * m]
        return np.array(cv2.minMaxLoc(cv2.matchTemplate(part, P, cv2.TM_CCOEFF_NORMED))[3], float) - m

    @staticmethod
    def _shown(
        picture: np.ndarray, at: np.ndarray, size: float, roll: float, x: np.ndarray, y: np.ndarray
    ) -> np.ndarray:
        """(p,) the picture at the patch's pixels x, y about its middle, moved, less the mean."""
        c, s = np.exp(size) * np.cos(roll), np.exp(size) * np.sin(roll)
        u, v = (c * x - s * y + at[0]).astype(np.float32), (s * x + c * y + at[1]).astype(np.float32)
        shown = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel().astype(np.float64)
        return np.asarray(shown - shown.mean())

    def _point(self, at: np.ndarray, size: float) -> np.ndarray:
        """(3,) mm in camera axes of a place in the picture, on what is exp(size) times as large as in the patch."""
        z = self.depth / np.exp(size)
        pixel = (at + 0.5) / self.scale - np.array(self.lens.size) / 2
        return np.array([*(pixel * z / self.lens.focal), z])


def whole(rgb: np.ndarray) -> np.ndarray:
    """(h, w) float32 grey of a whole frame (H, W, 3) uint8, the longer side SIDE, blurred."""
    scale = SIDE / max(rgb.shape[:2])
    small = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), _BLUR)


def patch(picture: np.ndarray, chin: np.ndarray, bridge: np.ndarray, depth: float, lens: Lens) -> Patch | None:
    """The patch below the chin (2,) of a frame by `whole`, bridge (2,) the nose's, frame pixels; None: too little."""
    h, w = picture.shape
    scale = max(h, w) / max(lens.size)
    way = float(np.linalg.norm(chin - bridge)) * scale
    x, y = chin * scale
    rows = slice(max(round(y + _TOP * way), 0), min(round(y + _DOWN * way), h))
    columns = slice(max(round(x - _ACROSS * way), 0), min(round(x + _ACROSS * way), w))
    high, wide = rows.stop - rows.start, columns.stop - columns.start
    if high < max(_LEAST * way, _FEWEST) or wide < max(2 * _LEAST * way, _FEWEST):
        return None
    return Patch(picture, rows, columns, scale, max(1, round(_REACH * way)), depth, lens)

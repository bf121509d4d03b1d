"""
Shape from shading: displacements d along the view rays that explain the light on a frame (equations 11-13).

  p = p0 + d v,   v = p0 / |p0|                                                                              (11)
  n = (n0 + Ex d_x + Ey d_y) / |…|,   Ex = v x p0_y / |p0_x x p0_y|,   Ey = p0_x x v / |p0_x x p0_y|          (12)
  min_d  |D B (s(n) - s)/s|^2 + b |B (s(n) - s)/s|^2 + m1 |d|^2 + m2 |D d|^2 + m3 |L d|^2                      (13)

with s the light that the frame shows (its grey over albedo and exposure), and D, L the differences per
millimetre. Against the paper:
- s(n) is the light of shading/light.py, times 1 - k H d, H d = d - G d with a Gaussian G: hollows are dark. A furrow
  sees less of the room than the skin about it, which under soft light from the front is all that shows it; without
  the term its dark line is taken for a slope.
- Residuals are shares of the light; b, a weak term on the light itself, stands where the paper has none (the albedo is
  freed of what all frames have in common, so that it can be trusted); B, a Gaussian, is the light's way through the
  skin, which blurs what wrinkles show. n0 are the smooth mesh's own normals, p0_x and p0_y lie in its tangent plane.
Gauss–Newton; each step by conjugate gradients, preconditioned by the energy with constant coefficients, which the
cosine transform inverts, so that no matrix is built and nothing is factored.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.fft

from avatarbuild.shading.light import Field, Light
from avatarbuild.shading.surface import Drawn
from avatarbuild.solvers.sparse import conjugate_gradients
from avatarbuild.tracking.lens import Lens

_DARK = 0.25  # of the mean light: below it, errors count absolutely
_OUTLIER = 1.5  # of the logarithm of light: what is off by more is shadow or hair, not relief
_NOISE = 0.05  # of the logarithm of light: what pores and the picture's noise make
_MARK = 0.5  # mm about a mark's border that go with it
_RIM = 5  # pixels of the face's border that are no evidence
_STEEP = 0.15
_OPEN = 0.3, 1.3  # what is believed of 1 - k H d
_TOLERANCE = 1e-2  # of conjugate gradients
_TINY = 1e-9


@dataclass(frozen=True)
class ReliefWeights:
    """
    light     b, 1/mm^2;  small m1, slope m2, bend m3, lengths in mm
    scatter   mm: standard deviation of B
    hollow    k, 1/mm;  reach  mm: standard deviation of G
    sharp     slope at which the two smoothness terms turn from squares to l1 (iteratively reweighted); 0: squares
    apart     mm that frame and albedo may lie apart: what a mark's border shows then is no light
    rounds    of Gauss–Newton;  steps of conjugate gradients in each
    """

    light: float
    small: float
    slope: float
    bend: float
    scatter: float = 0.8
    hollow: float = 0.0
    reach: float = 1.2
    sharp: float = 0.0
    apart: float = 0.0
    rounds: int = 3
    steps: int = 40


MEDIUM = ReliefWeights(light=30.0, small=0.01, slope=1.0, bend=1.0, scatter=0.0, hollow=0.1, reach=4.0)
"""For the refinement of shapes: what a mesh of a few millimetres' spacing can follow; scattered light is finer. How
bright a place is counts more than how its brightness changes: what the albedo gets wrong all frames have in common."""
FINE = ReliefWeights(light=0.3, small=0.005, slope=0.1, bend=0.1, hollow=1.0, apart=0.1)
"""For detail maps."""


@dataclass(frozen=True)
class Relief:
    """d (h, w) mm along the rays, normal (h, w, 3) unit in camera axes, sure (h, w) in 0..1."""

    d: np.ndarray
    normal: np.ndarray
    sure: np.ndarray


def light_seen(drawn: Drawn, grey: np.ndarray, gain: float, more: np.ndarray) -> np.ndarray:
    """(h, w) s = c / (g e^(tone + more)): the light that the aligned picture c shows on the skin."""
    return np.maximum(grey / (gain * np.exp(drawn.tone + more)), 1e-3)


def relief(drawn: Drawn, seen: np.ndarray, light: Light, lens: Lens, w: ReliefWeights) -> Relief:
    """The displacements under which the drawn head shows the light `seen` (h, w)."""
    on = drawn.on.astype(np.float64)
    seen = np.where(drawn.on, seen, 1.0).astype(np.float64)
    ways = _Ways.of(drawn, lens)
    field = light.field(drawn)
    off = np.log(seen / field.shade(drawn.normal))
    inner = cv2.erode(drawn.on.astype(np.uint8), np.ones((_RIM, _RIM), np.uint8))
    sure = inner / (1 + (off / _OUTLIER) ** 2)
    if w.apart:
        square = np.gradient(drawn.tone, axis=0) ** 2 + np.gradient(drawn.tone, axis=1) ** 2
        steep = cv2.GaussianBlur(square, (0, 0), max(_MARK / ways.pixel, 0.3)) / ways.pixel**2
        sure = sure / (1 + (w.apart / _NOISE) ** 2 * steep)
    share = 1 / np.maximum(seen, _DARK) * on
    beside_x, beside_y = np.zeros_like(on), np.zeros_like(on)
    beside_x[:, :-1] = np.minimum(sure[:, 1:], sure[:, :-1])
    beside_y[:-1] = np.minimum(sure[1:], sure[:-1])
    h2 = ways.pixel**2
    waves = _waves(on.shape) / h2
    held = _scattered(on, w.scatter / ways.pixel)
    hollow = _Hollow.of(on, w.reach / ways.pixel)
    d = np.zeros_like(on)
    tight = bent = np.ones_like(on)

    def data(e: np.ndarray) -> np.ndarray:
        return (_dx_t(beside_x * _dx(e)) + _dy_t(beside_y * _dy(e))) / h2 + w.light * sure * e

    for turn in range(w.rounds):
        along_x, along_y, bare = ways.slopes(d, field)
        open_ = np.clip(1 - w.hollow * hollow(d), *_OPEN) if w.hollow else np.ones_like(on)
        along_x, along_y, light_now, darker = along_x * open_, along_y * open_, bare * open_, w.hollow * bare
        # the blur goes over shares of the light: dark pixels must not hang on what their bright neighbours change
        error = (_scattered(light_now * on, w.scatter / ways.pixel) - held * seen) * share

        def change(
            x: np.ndarray, ax: np.ndarray = along_x, ay: np.ndarray = along_y, k: np.ndarray = darker
        ) -> np.ndarray:
            lit = ax * _dx(x) + ay * _dy(x)
            if w.hollow:
                lit -= k * hollow(x)
            return _scattered(lit * share, w.scatter / ways.pixel)

        def change_t(
            e: np.ndarray, ax: np.ndarray = along_x, ay: np.ndarray = along_y, k: np.ndarray = darker
        ) -> np.ndarray:
            spread = _scattered(e, w.scatter / ways.pixel) * share
            out = _dx_t(ax * spread) + _dy_t(ay * spread)
            if w.hollow:
                out -= hollow(k * spread)
            return out

        if w.sharp > 0 and turn:
            tight = 1 / np.sqrt(1 + (_dx(d) ** 2 + _dy(d) ** 2) / h2 / w.sharp**2)
            bent = 1 / np.sqrt(1 + (_laplace(d) / h2) ** 2 / w.sharp**2)

        def smooth(x: np.ndarray, tight: np.ndarray = tight, bent: np.ndarray = bent) -> np.ndarray:
            slopes = w.slope * (_dx_t(tight * _dx(x)) + _dy_t(tight * _dy(x))) / h2
            return w.small * x + slopes + w.bend * _laplace(bent * _laplace(x)) / h2**2

        weight = sure * share**2 / max(sure.sum(), _TINY)
        strength = h2 / 2 * float(np.sum(weight * (along_x**2 + along_y**2))) * waves
        strength = strength + float(np.sum(weight * darker**2)) * (1 - np.exp(-(w.reach**2) * waves / 2)) ** 2
        filtered = strength * (waves + w.light) * np.exp(-(w.scatter**2) * waves)
        inverse = 1 / (w.small + w.slope * tight.mean() * waves + w.bend * bent.mean() * waves**2 + filtered)

        def normal_equations(x: np.ndarray, change=change, change_t=change_t, smooth=smooth) -> np.ndarray:
            return change_t(data(change(x))) + smooth(x)

        def precondition(r: np.ndarray, inverse: np.ndarray = inverse) -> np.ndarray:
            return np.asarray(scipy.fft.idctn(scipy.fft.dctn(r, norm="ortho") * inverse, norm="ortho"))

        d = conjugate_gradients(
            normal_equations, change_t(data(change(d) - error)), d, precondition, w.steps, _TOLERANCE
        )
    return Relief(d, ways.normals(d).astype(np.float32), sure)


@dataclass(frozen=True)
class _Ways:
    """How normals turn with d: normal, Ex, Ey (h, w, 3) of equation (12); pixel, mm."""

    normal: np.ndarray
    Ex: np.ndarray
    Ey: np.ndarray
    pixel: float

    @staticmethod
    def of(drawn: Drawn, lens: Lens) -> _Ways:
        point, normal = drawn.point.astype(np.float64), drawn.normal.astype(np.float64)
        ray = point / np.maximum(np.linalg.norm(point, axis=-1, keepdims=True), _TINY)
        step = point[..., 2] * drawn.factor / lens.focal
        into = (normal * ray).sum(axis=-1, keepdims=True)
        into = np.where(into > -_STEEP, -_STEEP, into)
        along = []
        for k in (0, 1):
            beside = np.zeros_like(point)
            beside[..., k] = step
            along.append(beside - ray * ((normal * beside).sum(axis=-1, keepdims=True) / into))
        cross = np.cross(along[0], along[1])
        area = np.maximum(np.linalg.norm(cross, axis=-1, keepdims=True), _TINY)
        side = np.sign((cross * normal).sum(axis=-1, keepdims=True)) / area
        pixel = float(np.median(step[drawn.on])) if drawn.on.any() else 1.0
        return _Ways(normal, side * np.cross(ray, along[1]), side * np.cross(along[0], ray), pixel)

    def turned(self, d: np.ndarray) -> np.ndarray:
        return np.asarray(self.normal + self.Ex * _dx(d)[..., None] + self.Ey * _dy(d)[..., None])

    def normals(self, d: np.ndarray) -> np.ndarray:
        n = self.turned(d)
        return n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), _TINY)

    def slopes(self, d: np.ndarray, field: Field) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """ds/dd_x, ds/dd_y and s, all (h, w)."""
        m = self.turned(d)
        length = np.maximum(np.linalg.norm(m, axis=-1, keepdims=True), _TINY)
        n = m / length
        s, g = field.change(n)
        g = (g - n * (g * n).sum(axis=-1, keepdims=True)) / length
        return (g * self.Ex).sum(axis=-1), (g * self.Ey).sum(axis=-1), s


@dataclass(frozen=True)
class _Hollow:
    """H d = d - S G S d within the mask `on` (h, w); S = diag(share), so that H d = 0 for a constant far from borders
    and H is symmetric; sd of G in pixels."""

    on: np.ndarray
    share: np.ndarray
    sd: float

    @staticmethod
    def of(on: np.ndarray, sd: float) -> _Hollow:
        return _Hollow(on, on / np.sqrt(np.maximum(_scattered(on, sd), 1e-3)), sd)

    def __call__(self, d: np.ndarray) -> np.ndarray:
        return np.asarray(self.on * d - self.share * _scattered(d * self.share, self.sd))


def _scattered(image: np.ndarray, sd: float) -> np.ndarray:
    if sd < 0.2:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sd, borderType=cv2.BORDER_CONSTANT))


def _waves(shape: tuple[int, int]) -> np.ndarray:
    """(h, w) eigenvalues of -L with free borders, whose eigenvectors are cosines."""
    rows, columns = (2 - 2 * np.cos(np.pi * np.arange(side) / side) for side in shape)
    return rows[:, None] + columns[None]


def _dx(a: np.ndarray) -> np.ndarray:
    out = np.zeros_like(a)
    out[:, :-1] = a[:, 1:] - a[:, :-1]
    return out


def _dy(a: np.ndarray) -> np.ndarray:
    out = np.zeros_like(a)
    out[:-1] = a[1:] - a[:-1]
    return out


def _dx_t(a: np.ndarray) -> np.ndarray:
    out = np.zeros_like(a)
    out[:, :-1] -= a[:, :-1]
    out[:, 1:] += a[:, :-1]
    return out


def _dy_t(a: np.ndarray) -> np.ndarray:
    out = np.zeros_like(a)
    out[:-1] -= a[:-1]
    out[1:] += a[:-1]
    return out


def _laplace(a: np.ndarray) -> np.ndarray:
    return -(_dx_t(_dx(a)) + _dy_t(_dy(a)))

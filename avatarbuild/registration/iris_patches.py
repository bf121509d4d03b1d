"""The eyes in a photo, laid onto the irises' planes: the iris's rim, and the colours of iris and white."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.formats.colour import decode_srgb
from avatarbuild.geometry.iris import iris_circle
from avatarbuild.registration.eye_shape import EyeShape
from avatarbuild.registration.eyes import Eyeballs
from avatarbuild.registration.iris_sightings import Photos, on_plane, plane_axes, plane_grid
from avatarbuild.registration.lids import seen_line
from avatarbuild.template import Template

SIZE, RADIUS = 256, 64.0  # pixels of the window, and of an iris in it
MOST_TURNED = 30.0  # degrees between the gaze and the camera
TRIES = 4
_SPREAD = (0.8, 1.25)  # of the expected radius, of an iris that is looked for
_LEAST_SHOWN = 0.35  # share of the angles at which the rim must show
_LID_SHADE, _LID_EDGE = (
    1.3,
    0.5,
)  # mm below the upper lid that it shades; mm off the rims that lashes and wet edges take
_LEAST_PIXELS = 400  # of iris and of white, for colours to be trusted
_WHITE_REACH = 10.5  # mm from the iris's middle up to which the white is looked at
_RIM_BLUR, _PUPIL_BLUR = 0.45, 0.35  # mm of the iris at its rims that are mixed with what is beside it
_VEIL, _MOST_VEIL = 0.5, 0.5  # of the pupil's light, which mirrors more than the iris around it; of the stroma's light
_PUPIL = (1.0, 3.6)  # mm, between which a pupil's radius lies


@dataclass(frozen=True)
class IrisPatch:
    """
    One eye in one photo. window (SIZE, SIZE, 3) linear, on the iris's plane, `step` mm a pixel; circle (3,): middle and
    radius of the rim in it, pixels; stroma, white (SIZE, SIZE) bool: pixels of the iris without pupil, highlights and
    shade, and of the sclera; photo: of the capture; eye: 0 left, 1 right.
    """

    window: np.ndarray
    step: float
    circle: np.ndarray
    stroma: np.ndarray
    white: np.ndarray
    veil: np.ndarray
    photo: int
    eye: int


def frontal_photos(photos: Photos, eyes: Eyeballs) -> list[int]:
    """Placed photos that look the eyes in the face, best first: near the gaze, and sharp; at most TRIES."""
    placed = photos.placed
    towards = placed.centres - eyes.centres.mean(axis=0)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    gaze = eyes.gaze.sum(axis=0)
    angle = np.degrees(np.arccos(np.clip(towards @ gaze / np.linalg.norm(gaze), -1, 1)))
    usable = photos.trusted[placed.index] & (angle <= MOST_TURNED)
    sharp = np.nan_to_num(photos.sharpness[placed.index])
    usual = np.median(sharp[usable]) if usable.any() else 1.0
    # a photo half as sharp as usual is as bad as one ten degrees further aside
    badness = angle + 20.0 * np.maximum(1 - sharp / max(usual, 1e-12), 0)
    return [int(p) for p in np.argsort(badness, kind="stable") if usable[p]][:TRIES]


def iris_patch(
    photos: Photos, p: int, eye: int, eyes: Eyeballs, skin: np.ndarray, template: Template, shape: EyeShape
) -> IrisPatch | None:
    """
    The eye in placed photo `p`: Hough's transform finds the iris's circle on its plane, an ellipse in the photo, the
    largest of those that are nearly as sure as the surest; the steepest points of its rim refine it. None where no
    iris shows, or too little of it.
    """
    placed = photos.placed
    size = eyes.radius[eye] / shape.radius
    gaze = eyes.gaze_to(eye, placed.centres[p])
    middle = eyes.centres[eye] + shape.limbus_depth * size * gaze
    step = shape.limbus_radius / RADIUS
    axes = plane_axes(gaze)
    picture = photos.picture(int(placed.index[p]))
    seen = on_plane(picture, placed, p, middle, axes, SIZE, step)
    circle = find_circle(cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY))
    if circle is None:
        return None
    opening = _opening(placed.centres[p], skin, template, eye, middle, gaze, axes, step)
    linear = decode_srgb(seen)
    stroma, white, veil = _zones(linear, circle, opening, step)
    if min(stroma.sum(), white.sum()) < _LEAST_PIXELS:
        return None
    return IrisPatch(linear, step, circle, stroma, white, veil, int(placed.index[p]), eye)


def find_circle(grey: np.ndarray) -> np.ndarray | None:
    """(3,) middle (first pixel's centre at 0.5) and radius of the iris in a window (SIZE, SIZE) uint8, None: no rim."""
    soft = cv2.GaussianBlur(grey, (0, 0), 2.0)
    low, high = (round(RADIUS * f) for f in _SPREAD)
    found = cv2.HoughCircles(soft, cv2.HOUGH_GRADIENT_ALT, 1.5, 4, param1=60, param2=0.3, minRadius=low, maxRadius=high)
    expected = np.array([SIZE / 2, SIZE / 2, RADIUS])
    candidates = [expected]
    if found is not None:
        circles = found.reshape(-1, found.shape[-1])[:8, :3].astype(np.float64)
        circles[:, :2] += 0.5  # OpenCV counts from the first pixel's centre
        near = circles[np.linalg.norm(circles[:, :2] - SIZE / 2, axis=1) < 0.4 * RADIUS]
        # Hough's list runs from the surest to the least sure
        candidates = [*near[:3][np.argsort(-near[:3, 2], kind="stable")], expected]
    for x, y, r in candidates:
        centre, radius, shown = iris_circle(grey, np.array([x, y]), float(r))
        if shown >= _LEAST_SHOWN and _SPREAD[0] <= radius / RADIUS <= _SPREAD[1]:
            return np.array([centre[0], centre[1], radius])
    return None


def _opening(
    camera: np.ndarray,
    skin: np.ndarray,
    template: Template,
    eye: int,
    middle: np.ndarray,
    gaze: np.ndarray,
    axes: np.ndarray,
    step: float,
) -> np.ndarray:
    """(SIZE, SIZE) bool: what the registered lids leave free, less their edges and the upper lid's shade."""
    side = ("left", "right")[eye]
    upper, lower = (skin[seen_line(template, f"lid_{half}_{side}")] for half in ("upper", "lower"))
    outline = np.concatenate([upper, lower[::-1]])
    ray = outline - camera
    on = camera + ray * (((middle - camera) @ gaze) / (ray @ gaze))[:, None]
    pixels = (on - middle) @ axes.T / step + SIZE / 2
    whole = np.zeros((SIZE, SIZE), np.uint8)
    cv2.fillPoly(whole, [np.round((pixels - 0.5) * 16).astype(np.int32)], 1, cv2.LINE_8, 4)
    edge = 2 * round(_LID_EDGE / step) + 1
    mask = cv2.erode(whole, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (edge, edge)), borderValue=0)
    shade = round(_LID_SHADE / step)
    free = mask > 0
    free[shade:] &= mask[:-shade] > 0
    free[:shade] = False
    return free


def _zones(
    linear: np.ndarray, circle: np.ndarray, opening: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the stroma and where the white shows, both (SIZE, SIZE) bool, and the veil (3,)."""
    place = plane_grid(SIZE, 1.0) + SIZE / 2
    distance = np.hypot(*(place - circle[:2]).transpose(2, 0, 1)) * step
    rim = circle[2] * step
    light = linear.mean(axis=2)
    ring = opening & (distance < rim - _RIM_BLUR)
    pupil = _pupil(light, distance, ring, rim)
    stroma = ring & (distance > pupil + _PUPIL_BLUR)
    veil, nothing = np.zeros(3), np.zeros_like(opening)
    if not stroma.any():
        return nothing, nothing, veil
    usual = np.median(light[stroma])
    spread = 1.4826 * np.median(np.abs(light[stroma] - usual))
    bright = (light > usual + 4 * spread + 0.01) & ring
    stroma &= cv2.dilate(bright.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    hole = opening & (distance < max(pupil - _PUPIL_BLUR, 0.4))
    if hole.any() and stroma.any():
        # a small blurred pupil is no veil
        most = _MOST_VEIL * np.median(linear[stroma], axis=0)
        veil = np.minimum(_VEIL * np.quantile(linear[hole], 0.1, axis=0), most)
    white = opening & (distance > rim + 0.9) & (distance < _WHITE_REACH)
    if white.any():
        # lashes, veins and corners are darker than the white, highlights brighter; skin is redder
        low, high = np.quantile(light[white], [0.4, 0.93])
        white &= (light >= low) & (light <= high)
        blue = linear[..., 2] / np.maximum(linear[..., 0], 1e-4)
        white &= blue >= np.quantile(blue[white], 0.5)
    return stroma, white, veil


def _pupil(light: np.ndarray, distance: np.ndarray, ring: np.ndarray, rim: float) -> float:
    """mm: where the light rises most from the middle outwards, by medians over rings."""
    edges = np.arange(0.4, rim - 0.8, 0.2)
    at = np.digitize(distance[ring], edges)
    value = light[ring]
    level = np.array([np.median(value[at == k]) if (at == k).sum() > 8 else np.nan for k in range(1, len(edges))])
    middle = (edges[1:] + edges[:-1]) / 2
    rise = level[2:] - level[:-2]
    radius = middle[1:-1]
    fit = np.isfinite(rise) & (radius >= _PUPIL[0]) & (radius <= _PUPIL[1])
    if not fit.any():
        return 1.9
    return float(radius[fit][np.argmax(rise[fit])])

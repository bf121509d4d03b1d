"""How a phone is held and what it makes of the light: sweep, lens, exposure, blur, noise, JPEG with EXIF."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from avatarbuild.formats.colour import encode_srgb
from avatarbuild.parallel import in_order
from avatarbuild.simulation.rendering import Camera

_FILM_DIAGONAL = 43.2666  # mm, of 36 x 24
_FOCAL_35MM = 26
_STRIP = 256  # rows that are developed at a time


@dataclass(frozen=True)
class Shot:
    """
    One photo to take: where from, and what goes wrong.

    camera; yaw, pitch of the position about the head, degrees (positive: from the subject's left, from above);
    exposure: factor on linear light; balance (3,): factors of red, green, blue; blur (2,): motion of the image, px;
    orientation: EXIF 1, 3, 6 or 8.
    """

    camera: Camera
    yaw: float
    pitch: float
    exposure: float
    balance: np.ndarray
    blur: np.ndarray
    orientation: int


def phone_lens(rng: np.random.Generator, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """K (3, 3) with pixel centres at +0.5 and dist (5,): a 26 mm equivalent, within 0.7 % of what EXIF says."""
    focal = _FOCAL_35MM / _FILM_DIAGONAL * np.hypot(*size) * (1 + 0.003 * np.clip(rng.standard_normal(), -2.3, 2.3))
    middle = np.array(size) / 2 + 0.003 * np.array(size) * rng.uniform(-1, 1, 2)
    K = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])
    dist = np.array([0.07, -0.17, 0, 0, 0.095]) * rng.uniform(0.7, 1.15)
    dist[2:4] = rng.normal(0, 1e-4, 2)
    return K, dist


def sweep(rng: np.random.Generator, count: int, size: tuple[int, int], *, orientations: bool = True) -> list[Shot]:
    """A hand-held semicircle of `count` photos: three in five level from the subject's right to left, then back from
    above, then from below; distances 36–45 cm, a few degrees of roll, slow drift of exposure and white balance."""
    K, dist = phone_lens(rng, size)
    level = max(round(count * 0.62), 1)
    above = round((count - level) * 0.62)
    below = count - level - above
    yaws = [np.linspace(-85, 85, level), np.linspace(62, -62, above), np.linspace(-50, 50, below)]
    pitches = [np.zeros(level), np.full(above, 20.0), np.full(below, -20.0)]
    yaw, pitch = np.concatenate(yaws), np.concatenate(pitches)
    jitter = min(1.0, 30 / count)
    yaw = np.clip(yaw + 3.0 * jitter * rng.standard_normal(count), -88, 88)
    pitch = pitch + 2.6 * rng.standard_normal(count)
    exposure = np.exp(_drift(rng, count, 0.05) + 0.035 * rng.standard_normal(count))
    balance = np.exp(np.stack([_drift(rng, count, 0.012), np.zeros(count), _drift(rng, count, 0.016)], axis=1))
    blurred = set(rng.choice(count, count // 12, replace=False).tolist())
    shots = []
    for i in range(count):
        distance = rng.uniform(360, 450)
        direction = _direction(yaw[i], pitch[i])
        target = np.array([0.0, -28.0, -38.0]) + rng.normal(0, [7, 9, 7])
        R = look_at(direction * distance + target, target + rng.normal(0, 6, 3), np.radians(rng.normal(0, 2.4)))
        t = -R @ (direction * distance + target)
        angle = rng.uniform(0, np.pi)
        length = rng.uniform(0.0015, 0.0024) * size[1] if i in blurred else 0.0
        turned = (1, 1, 1, 6, 1, 1, 8, 1, 1, 3)[int(rng.integers(10))] if orientations else 1
        shots.append(
            Shot(
                Camera(K, dist, R, t, size),
                float(yaw[i]),
                float(pitch[i]),
                float(exposure[i]),
                balance[i],
                length * np.array([np.cos(angle), np.sin(angle)]),
                turned,
            )
        )
    return shots


def look_at(eye: np.ndarray, target: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """(3, 3) R of a camera at `eye` that looks at `target` with the head frame's y upwards, rolled in radians."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * x + s * y, -s * x + c * y, z])


def develop(linear: np.ndarray, shot: Shot, rng: np.random.Generator, *, noise: float = 1.0) -> np.ndarray:
    """(h, w, 3) uint8 sRGB: blur, exposure, white balance, photon and read noise, clipping, sRGB curve."""
    image = linear
    length = float(np.hypot(*shot.blur))
    if length > 0:
        image = cv2.filter2D(image, -1, _line_kernel(shot.blur))
    grain = rng.standard_normal(image.shape, dtype=np.float32)
    strips = [slice(top, top + _STRIP) for top in range(0, len(image), _STRIP)]
    return np.concatenate(list(in_order(lambda rows: _exposed(image[rows], shot, noise * grain[rows]), strips)))


def _exposed(image: np.ndarray, shot: Shot, grain: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8 sRGB of linear light with normal deviates `grain`."""
    image = image * (shot.exposure * shot.balance).astype(np.float32)
    image += grain * np.sqrt(np.maximum(image, 0) * 1.1e-4 + 1.5e-6)
    # Sensors clip softly: the last tenth below white is compressed.
    bright = image > 0.9
    image[bright] = 0.9 + 0.1 * np.tanh((image[bright] - 0.9) / 0.1 * 0.9)
    return encode_srgb(image)


def write_photo(path: Path, rgb: np.ndarray, orientation: int, index: int, *, quality: int = 92) -> None:
    """A JPEG as a phone stores it: pixels as the sensor lay, EXIF with orientation, lens and a fixed made-up time."""
    turns = {1: 0, 6: 1, 3: 2, 8: 3}[orientation]
    stored = np.ascontiguousarray(np.rot90(rgb, turns))
    image = Image.fromarray(stored)
    exif = Image.Exif()
    minute, second = divmod(index * 2, 60)
    when = f"2024:05:04 10:{minute:02d}:{second:02d}"
    exif[0x010F], exif[0x0110], exif[0x0112] = "avatarbuild", "Simulated phone", orientation
    exif[0x0131], exif[0x0132] = "avatarbuild simulate", when
    details = exif.get_ifd(0x8769)
    details[0x829A], details[0x829D], details[0x8827] = 1 / 60, 1.6, 200
    details[0x9003], details[0x9004] = when, when
    details[0x920A], details[0xA405] = 4.2, _FOCAL_35MM
    details[0xA001], details[0xA002], details[0xA003] = 1, stored.shape[1], stored.shape[0]
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=quality, subsampling="4:2:0", exif=exif)
    path.write_bytes(buffer.getvalue())


def _direction(yaw: float, pitch: float) -> np.ndarray:
    y, p = np.radians(yaw), np.radians(pitch)
    return np.array([np.sin(y) * np.cos(p), np.sin(p), np.cos(y) * np.cos(p)])


def _drift(rng: np.random.Generator, count: int, amplitude: float) -> np.ndarray:
    """(count,) a slow sum of three sines."""
    s = np.linspace(0, 2 * np.pi, count)
    return amplitude * sum(np.sin(k * s + rng.uniform(0, 2 * np.pi)) / np.sqrt(k) for k in (1, 2, 3))


def _line_kernel(motion: np.ndarray) -> np.ndarray:
    """A line of length |motion| px, evenly sampled into a small grid that sums to 1."""
    half = int(np.ceil(np.hypot(*motion) / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for s in np.linspace(-0.5, 0.5, 65):
        x, y = half + s * motion
        j, i = int(x), int(y)
        a, b = x - j, y - i
        kernel[i, j] += (1 - a) * (1 - b)
        kernel[i, j + 1] += a * (1 - b)
        kernel[i + 1, j] += (1 - a) * b
        kernel[i + 1, j + 1] += a * b
    return kernel / kernel.sum()

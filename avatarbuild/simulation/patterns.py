"""Procedural pictures for the room: wallpaper, boards, posters, books, boxes, cloth. All (h, w, 3) float32, linear."""

from __future__ import annotations

import colorsys
from itertools import pairwise

import cv2
import numpy as np

from avatarbuild.geometry.smooth_step import smooth_step
from avatarbuild.simulation.noise import cells, fractal, plane

_TILE = 768


class Grain:
    """Tiles of noise made once and cut out at random places: fine (about 3 texels) and coarse (about 60 texels)."""

    def __init__(self, rng: np.random.Generator) -> None:
        points = plane(_TILE, _TILE)
        seeds = rng.integers(1 << 16, size=2)
        self.fine = fractal(points, 5.0, 2, int(seeds[0]))
        self.coarse = fractal(points, 90.0, 3, int(seeds[1]))
        self._rng = rng

    def cut(self, tile: np.ndarray, h: int, w: int) -> np.ndarray:
        """(h, w) of a tile, mirrored where it ends."""
        i, j = self._rng.integers(_TILE, size=2)
        rows, columns = np.arange(i, i + h) % (2 * _TILE), np.arange(j, j + w) % (2 * _TILE)
        rows, columns = np.minimum(rows, 2 * _TILE - 1 - rows), np.minimum(columns, 2 * _TILE - 1 - columns)
        return tile[rows[:, None], columns[None, :]]

    def textured(self, image: np.ndarray, fine: float = 0.05, coarse: float = 0.05) -> np.ndarray:
        """image * exp(noise), the noise's standard deviations given."""
        h, w = image.shape[:2]
        noise = fine * self.cut(self.fine, h, w) + coarse * self.cut(self.coarse, h, w)
        return image * np.exp(noise)[..., None].astype(np.float32)


def colour(rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]) -> np.ndarray:
    """(3,) float32 linear colour of random hue."""
    srgb = colorsys.hsv_to_rgb(rng.random(), rng.uniform(*saturation), rng.uniform(*value))
    return (np.array(srgb) ** 2.2).astype(np.float32)


def _two_tone(mask: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    m = mask[..., None].astype(np.float32)
    return one * (1 - m) + other * m


def wallpaper(rng: np.random.Generator, grain: Grain, h: int, w: int, texel: float) -> np.ndarray:
    """A printed pattern of 60–140 mm repeat in two near tones; `texel` in mm."""
    y, x = np.meshgrid(np.arange(h) * texel, np.arange(w) * texel, indexing="ij")
    repeat = rng.uniform(60, 140)
    wave = 2 * np.pi / repeat
    bend = grain.cut(grain.coarse, h, w) * 2.0
    x, y = x + bend, y + bend[::-1]
    kind = rng.integers(4)
    if kind == 0:
        pattern = smooth_step(np.sin(wave * x + 1.3 * np.sin(wave * y)) * np.sin(wave * y), -0.1, 0.1)
    elif kind == 1:
        pattern = smooth_step(np.cos(2 * wave * x) + 0.35 * np.cos(9 * wave * x), 0.2, 0.35)
        pattern = np.maximum(pattern, smooth_step(np.cos(wave * x) * np.cos(wave * y), 0.86, 0.9))
    elif kind == 2:
        leaf = np.abs(np.sin(wave * (x + y) / 2)) * np.abs(np.sin(wave * (x - y) / 2))
        pattern = smooth_step(np.sin(5 * leaf * np.pi), 0.1, 0.5)
    else:
        row = np.floor(y / repeat * 2)
        u, v = np.mod(x + row * repeat / 2, repeat) / repeat - 0.5, np.mod(y, repeat / 2) / repeat * 2 - 0.5
        pattern = smooth_step(np.hypot(u * 1.6, v), 0.42, 0.38) - smooth_step(np.hypot(u * 1.6, v), 0.25, 0.21)
    ground = colour(rng, (0.05, 0.3), (0.68, 0.86))
    image = _two_tone(pattern, ground, ground * rng.uniform(0.66, 0.8) * (1 + 0.1 * rng.standard_normal(3)))
    return grain.textured(image.astype(np.float32), 0.05, 0.05)


def boards(rng: np.random.Generator, grain: Grain, h: int, w: int, texel: float) -> np.ndarray:
    """Wooden boards about 130 mm wide along the columns."""
    wide = max(int(130 / texel), 4)
    base = np.array([0.25, 0.14, 0.075], np.float32) * rng.uniform(0.7, 1.5)
    streaks = cv2.resize(grain.cut(grain.fine, h, max(w // 24, 2)), (w, h), interpolation=cv2.INTER_CUBIC)
    image = np.ones((h, w, 1), np.float32) * base
    for top in range(0, h, wide):
        cuts = [0, *np.sort(rng.integers(0, w, 2 + w * int(texel + 1) // 1200)), w]
        for left, right in pairwise(cuts):
            image[top : top + wide, left:right] *= np.exp(0.16 * rng.standard_normal() + 0.04 * rng.standard_normal(3))
            image[top : top + wide, max(left - 1, 0) : left + 1] *= 0.35
        image[top : top + 1] *= 0.35
    return grain.textured(image * np.exp(0.22 * streaks)[..., None], 0.05, 0.05)


def plaster(rng: np.random.Generator, grain: Grain, h: int, w: int) -> np.ndarray:
    """A pale rough ceiling."""
    return grain.textured(np.full((h, w, 3), rng.uniform(0.55, 0.7), np.float32), 0.06, 0.08)


def poster(rng: np.random.Generator, grain: Grain, h: int, w: int) -> np.ndarray:
    """A framed picture of one of five kinds."""
    kind = rng.integers(5)
    y, x = np.meshgrid(np.linspace(0, 1, h), np.linspace(0, 1, w), indexing="ij")
    image = np.ones((h, w, 3), np.float32) * colour(rng, (0.1, 0.6), (0.5, 0.95))
    if kind == 0:
        _, label = cells(plane(h, w), w / rng.uniform(6, 14), int(rng.integers(1 << 16)))
        palette = np.stack([colour(rng, (0.3, 0.9), (0.2, 1.0)) for _ in range(24)])
        image = palette[(label * 23.99).astype(int)]
    elif kind == 1:
        image = _two_tone(y, np.array([0.35, 0.5, 0.85], np.float32), np.array([0.95, 0.75, 0.55], np.float32))
        for k in range(5):
            ridge = 0.35 + 0.12 * k + 0.07 * fractal(plane(1, w, 1.0), w / (2.0 + k), 5, int(rng.integers(1 << 16)))[0]
            below = smooth_step(y - ridge[None, :], 0, 2 / h)
            image = _two_tone(below, image, colour(rng, (0.2, 0.6), (0.1, 0.6)))
    elif kind == 2:
        image = np.full((h, w, 3), 0.82, np.float32)
        _write(rng, image, np.array([0.03, 0.03, 0.04], np.float32), max(h // 60, 3))
    elif kind == 3:
        image = np.full((h, w, 3), 0.006, np.float32)
        for _ in range(700):
            i, j, r = rng.integers(h), rng.integers(w), int(rng.integers(1, 3))
            image[i : i + r, j : j + r] = colour(rng, (0, 0.5), (0.3, 1))
    else:
        for _ in range(26):
            centre, radius = (rng.random(2) * [h, w]), rng.uniform(0.03, 0.22) * w
            ring = np.abs(np.hypot(y * h - centre[0], x * w - centre[1]) - radius * 0.7)
            image = _two_tone(
                smooth_step(ring, 0.3 * radius, 0.3 * radius - 2), image, colour(rng, (0.3, 0.9), (0.1, 1))
            )
    image = grain.textured(image.astype(np.float32), 0.05, 0.06)
    edge = max(min(h, w) // 30, 2)
    frame = np.full((h, w, 3), 0.35, np.float32) * rng.uniform(0.1, 1.2)
    frame[edge:-edge, edge:-edge] = image[edge:-edge, edge:-edge]
    return frame


def _write(rng: np.random.Generator, image: np.ndarray, ink: np.ndarray, line: int) -> None:
    """Lines of made-up letters, in place."""
    h, w = image.shape[:2]
    for top in range(2 * line, h - 3 * line, 2 * line):
        j = 2 * line
        while j < w - 3 * line - (rng.integers(w // 3) if rng.random() < 0.2 else 0):
            wide = int(rng.integers(max(line // 2, 1), line + 1))
            if rng.random() > 0.16:
                for _ in range(3):
                    a, b = rng.integers(0, line, 2), rng.integers(0, wide, 2)
                    image[top + a.min() : top + a.max() + 1, j + b[0] : j + b[0] + max(line // 6, 1)] = ink
                    image[top + a[0] : top + a[0] + max(line // 6, 1), j + b.min() : j + b.max() + 1] = ink
            j += wide + max(line // 5, 1)


def bookshelf(rng: np.random.Generator, grain: Grain, h: int, w: int, texel: float, rows: int) -> np.ndarray:
    """The front of a shelf with `rows` rows of books."""
    image = np.ones((h, w, 3), np.float32) * np.array([0.05, 0.03, 0.02], np.float32)
    board = max(int(22 / texel), 2)
    high = h // rows
    for row in range(rows):
        bottom = (row + 1) * high - board
        image[bottom : bottom + board] = np.array([0.16, 0.09, 0.05], np.float32)
        j = board
        while j < w - board:
            wide = min(max(int(rng.uniform(14, 46) / texel), 2), w - board - j)
            top = bottom - int(rng.uniform(0.6, 0.92) * (high - board))
            spine = colour(rng, (0.1, 0.9), (0.12, 0.95))
            book = image[top:bottom, j : j + wide]
            shape = 1 - 0.5 * np.abs(np.linspace(-1, 1, wide)) ** 4
            book[:] = spine * shape[None, :, None].astype(np.float32)
            for _ in range(int(rng.integers(1, 4))):
                at, tall = rng.random() * 0.8, rng.uniform(0.03, 0.16)
                band = slice(int(at * len(book)), int((at + tall) * len(book)) + 1)
                book[band, wide // 6 : wide - wide // 6] = colour(rng, (0, 0.7), (0.1, 1))
            if wide > 10:
                middle = book[len(book) // 3 : 2 * len(book) // 3]
                _write(rng, middle.transpose(1, 0, 2), colour(rng, (0, 0.3), (0.7, 1)), max(wide // 5, 2))
            j += wide + (int(rng.uniform(10, 60) / texel) if rng.random() < 0.08 else 0)
    return grain.textured(image, 0.05, 0.05)


def carton(rng: np.random.Generator, grain: Grain, h: int, w: int) -> np.ndarray:
    """One side of a cardboard or painted box with tape and labels."""
    tone = np.array([0.42, 0.27, 0.14], np.float32) if rng.random() < 0.6 else colour(rng, (0.2, 0.7), (0.4, 0.9))
    image = np.ones((h, w, 3), np.float32) * tone
    image[:, int(w * 0.45) : int(w * 0.55)] *= 0.75
    for _ in range(6):
        i, j = int(rng.random() * h * 0.8), int(rng.random() * w * 0.8)
        tall, wide = int(rng.uniform(0.06, 0.3) * h) + 2, int(rng.uniform(0.08, 0.4) * w) + 2
        label = image[i : i + tall, j : j + wide]
        label[:] = colour(rng, (0, 0.8), (0.2, 0.95))
        if min(label.shape[:2]) > 24:
            _write(rng, label, np.full(3, 0.02, np.float32), max(tall // 9, 2))
    return grain.textured(image, 0.09, 0.08)


def window(h: int, w: int) -> np.ndarray:
    """A bright window with a cross, about four times white."""
    y = np.linspace(1, 0, h)[:, None, None]
    image = (3.0 + 2.0 * y) * np.array([0.92, 1.0, 1.1]) * np.ones((h, w, 1))
    bar = max(w // 40, 2)
    for rows, columns in (
        (slice(h // 2 - bar, h // 2 + bar), slice(None)),
        (slice(None), slice(w // 2 - bar, w // 2 + bar)),
    ):
        image[rows, columns] = 0.5
    image[:bar], image[-bar:], image[:, :bar], image[:, -bar:] = 0.5, 0.5, 0.5, 0.5
    return image.astype(np.float32)


def cloth(rng: np.random.Generator, grain: Grain, h: int, w: int) -> np.ndarray:
    """A knitted or striped cloth; rows run around the body."""
    y, x = np.meshgrid(np.arange(h), np.arange(w), indexing="ij")
    one, other = colour(rng, (0.05, 0.6), (0.25, 0.8)), colour(rng, (0.1, 0.7), (0.2, 0.9))
    period = h / rng.uniform(18, 40)
    kind = rng.integers(3)
    stripes = smooth_step(np.sin(2 * np.pi * y / period), 0.3, 0.6)
    if kind == 1:
        stripes = np.maximum(stripes, smooth_step(np.sin(2 * np.pi * x / period / 2), 0.6, 0.9)) * 0.7
    elif kind == 2:
        stripes = smooth_step(grain.cut(grain.coarse, h, w), 0.2, 0.5) * 0.8
    knit = 0.13 * np.sin(2 * np.pi * y / 6) * np.sin(2 * np.pi * x / 6)
    return grain.textured(_two_tone(stripes, one, other) * (1 + knit[..., None]).astype(np.float32), 0.16, 0.06)

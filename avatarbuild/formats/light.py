"""light.npz of stage albedo: the photos' light, and what the fit of the photos' colours found along with it."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

_NAME = "light.npz"


def write_light(folder: Path, harmonics: np.ndarray, skin_colour: np.ndarray, gains: np.ndarray) -> None:
    """harmonics (9, 3), skin_colour (3,) and gains (k, 3), as `artefacts.Albedo` describes them."""
    with (folder / _NAME).open("wb") as f:
        np.savez(f, harmonics=harmonics, skin_colour=skin_colour, gains=gains)


def read_light(folder: Path) -> dict[str, np.ndarray]:
    """What `write_light` wrote, by name. Raises OSError, KeyError or ValueError where it is missing or damaged."""
    try:
        with np.load(folder / _NAME) as arrays:
            return {name: arrays[name] for name in ("harmonics", "skin_colour", "gains")}
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise ValueError(f"{folder / _NAME} is damaged: {error}") from None

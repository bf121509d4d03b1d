"""FLAME: arrays v_template (v, 3), f (m, 3) and shapedirs (v, 3, k) in metres, in a .npz or a pickle.

The first 300 columns of shapedirs are identity, per standard deviation; the rest are expressions without names,
which are not used. Source: Li, Bolkart, Black, Li, Romero 2017.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from avatarbuild.errors import InputError
from avatarbuild.template_import.foreign import COMPONENTS, ForeignHead, largest_component, millimetres
from avatarbuild.template_import.safe_pickle import dense, read_pickle

KEYS = ("v_template", "f", "shapedirs")
IDENTITY_COLUMNS = 300


def read(source: Path) -> ForeignHead:
    """A FLAME head from `generic_model.pkl`, `flame2023.pkl` or the same arrays in a .npz.

    Raises:
        InputError: arrays are missing or do not fit, or the pickle asks for more than arrays.
    """
    arrays = _read_npz(source) if source.suffix.lower() == ".npz" else _read_pickle(source)
    mean, faces, basis = (dense(arrays[key], f"{source}, {key}") for key in KEYS)
    if mean.ndim != 2 or mean.shape[1] != 3 or basis.ndim != 3 or basis.shape[:2] != mean.shape:
        raise InputError(
            f"{source}: v_template {mean.shape} and shapedirs {basis.shape} do not fit; (v, 3) and (v, 3, k) are needed"
        )
    triangles = faces.astype(np.int64)
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.min() < 0 or triangles.max() >= len(mean):
        raise InputError(f"{source}: f {faces.shape} must hold triangles of the {len(mean)} vertices")
    columns = min(COMPONENTS, IDENTITY_COLUMNS, basis.shape[2])
    scale = millimetres(mean, str(source))
    identity = np.ascontiguousarray(basis[:, :, :columns].transpose(2, 0, 1), np.float64) * scale
    skin = largest_component(len(mean), triangles)
    return ForeignHead("flame", mean.astype(np.float64) * scale, triangles.astype(np.int32), skin, identity)


def _read_npz(source: Path) -> Mapping[str, Any]:
    try:
        with np.load(source, allow_pickle=False) as stored:
            return _checked({key: stored[key] for key in KEYS if key in stored.files}, source)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{source}: not a .npz of plain arrays ({error}); save it without objects") from error


def _read_pickle(source: Path) -> Mapping[str, Any]:
    content = read_pickle(source)
    if not isinstance(content, Mapping):
        raise InputError(
            f"{source}: a pickle of {type(content).__name__}; a dictionary with {', '.join(KEYS)} is needed"
        )
    return _checked(content, source)


def _checked(arrays: Mapping[str, Any], source: Path) -> Mapping[str, Any]:
    missing = [key for key in KEYS if key not in arrays]
    if missing:
        raise InputError(f"{source}: {', '.join(missing)} missing; a FLAME model with {', '.join(KEYS)} is needed")
    return arrays

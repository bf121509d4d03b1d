"""The Basel Face Model: 2017 and 2019 as .h5, in millimetres; 2009 as .mat, in micrometres.

h5:   shape/model/mean (3v,), pcaBasis (3v, k) orthonormal, pcaVariance (k,); shape/representer/cells (3, m).
mat:  shapeMU (3v, 1), shapePC (3v, k) orthonormal, shapeEV (k, 1) standard deviations, tl (m, 3) counted from 1.
Source: Gerig et al. 2018; Paysan et al. 2009.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.io
from scipy.io.matlab import MatReadError

from avatarbuild.errors import InputError
from avatarbuild.template_import.foreign import COMPONENTS, ForeignHead, largest_component, millimetres


def read(source: Path) -> ForeignHead:
    """A Basel head.

    Raises:
        InputError: arrays are missing or do not fit; h5py is not installed.
    """
    reader = _read_mat if source.suffix.lower() == ".mat" else _read_h5
    mean, basis, deviations, triangles = reader(source)
    v = mean.size // 3
    if mean.size % 3 or basis.ndim != 2 or basis.shape[0] != mean.size or len(deviations) < min(basis.shape[1], 1):
        raise InputError(
            f"{source}: mean {mean.shape} and basis {basis.shape} do not fit; (3v,) and (3v, k) are needed"
        )
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.min() < 0 or triangles.max() >= v:
        raise InputError(f"{source}: triangles {triangles.shape} must be corners among the {v} vertices")
    k = min(COMPONENTS, basis.shape[1], len(deviations))
    vertices = mean.reshape(v, 3).astype(np.float64)
    scale = millimetres(vertices, str(source))
    identity = (basis[:, :k].astype(np.float64) * deviations[:k]).T.reshape(k, v, 3) * scale
    skin = largest_component(v, triangles)
    return ForeignHead("bfm", vertices * scale, triangles.astype(np.int32), skin, identity)


def _read_h5(source: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    try:
        import h5py
    except ImportError as error:
        raise InputError(
            f"{source}: reading .h5 needs h5py; install it with pip install 'avatarbuild[import]'"
        ) from error
    try:
        with h5py.File(source, "r") as file:
            shape = file["shape"]
            mean, basis = np.asarray(shape["model/mean"]).ravel(), np.asarray(shape["model/pcaBasis"])
            variance, cells = np.asarray(shape["model/pcaVariance"]).ravel(), np.asarray(shape["representer/cells"])
    except (OSError, KeyError, TypeError) as error:
        raise InputError(f"{source}: not a Basel Face Model ({error}); use model2017-1 or model2019 .h5") from error
    # cells are stored as (3, m)
    triangles = cells.T if cells.ndim == 2 and cells.shape[0] == 3 else cells
    return mean, basis, np.sqrt(np.maximum(variance, 0)), triangles.astype(np.int64)


def _read_mat(source: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    try:
        content = scipy.io.loadmat(source, variable_names=["shapeMU", "shapePC", "shapeEV", "tl"])
    except (OSError, ValueError, NotImplementedError, TypeError, MatReadError) as error:
        raise InputError(f"{source}: not a readable .mat ({error}); use 01_MorphableModel.mat") from error
    missing = [key for key in ("shapeMU", "shapePC", "shapeEV", "tl") if key not in content]
    if missing:
        raise InputError(f"{source}: {', '.join(missing)} missing; use 01_MorphableModel.mat of the 2009 model")
    mean, basis, deviations = content["shapeMU"].ravel(), content["shapePC"], content["shapeEV"].ravel()
    return mean, basis, deviations, content["tl"].astype(np.int64) - 1

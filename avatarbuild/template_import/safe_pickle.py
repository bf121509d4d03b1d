"""Arrays out of a pickle without running what it names.

A pickle is a program that may call anything importable. This reader admits the calls that rebuild numpy arrays and
dtypes; sparse matrices of scipy and arrays of chumpy, which FLAME's files hold, become inert records. Any other name
is refused before it is looked up, and no module is imported on a pickle's behalf.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from avatarbuild.errors import InputError

_SPARSE = ("csc_matrix", "csr_matrix", "csc_array", "csr_array")
_FAILURES = (
    *(pickle.UnpicklingError, EOFError, ValueError, TypeError, AttributeError, KeyError, IndexError),
    *(MemoryError, OverflowError, RecursionError, ImportError),
)


class Record:
    """What stands in for an object of a class that is not loaded: its state and nothing else."""

    kind = ""

    def __init__(self, *arguments: Any) -> None:
        self.state: Any = {}

    def __setstate__(self, state: Any) -> None:
        self.state = state


def read_pickle(path: Path) -> Any:
    """The plain data, numpy arrays and Records of a pickle.

    Raises:
        InputError: no such file, not a pickle, or one that asks for anything else.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); a pickle of arrays is needed") from error
    return loads(data, str(path))


def loads(data: bytes, source: str) -> Any:
    """`read_pickle` of bytes; `source` names them in messages."""
    try:
        return _Reader(io.BytesIO(data), source).load()
    except _FAILURES as error:
        raise InputError(f"{source}: not a readable pickle ({error}); save the arrays as .npz") from error


def dense(value: Any, source: str) -> np.ndarray:
    """The array in a numpy array, a list, a Record of chumpy or of scipy's sparse matrices.

    chumpy's Ch holds its array as `x`; its Select holds `a`, flat indices `idxs` and a `preferred_shape`.

    Raises:
        InputError: no numbers there.
    """
    if isinstance(value, Record):
        state = value.state if isinstance(value.state, dict) else {}
        if value.kind in _SPARSE:
            return _sparse(value.kind, state, source)
        if "x" in state:
            return dense(state["x"], source)
        if "a" in state and "idxs" in state:
            chosen = dense(state["a"], source).ravel()[dense(state["idxs"], source).astype(int)]
            return chosen.reshape(state.get("preferred_shape") or chosen.shape)
        raise InputError(f"{source}: holds a {value.kind} that is no plain array; save the arrays as .npz")
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise InputError(f"{source}: not an array ({error}); save the arrays as .npz") from error
    if array.dtype.kind not in "fiub":
        raise InputError(f"{source}: holds {array.dtype} instead of numbers; save the arrays as .npz")
    return array


def _sparse(kind: str, state: dict, source: str) -> np.ndarray:
    # scipy has stored the shape under both names
    shape = state.get("_shape") or state.get("shape")
    maker = sp.csc_matrix if kind.startswith("csc") else sp.csr_matrix
    try:
        return maker((state["data"], state["indices"], state["indptr"]), shape=shape).toarray()
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{source}: a sparse matrix is incomplete ({error}); save the arrays as .npz") from error


class _Reader(pickle.Unpickler):
    """The unpickler whose names are the table below and no others."""

    def __init__(self, stream: io.BytesIO, source: str) -> None:
        super().__init__(stream, encoding="latin1")  # numpy arrays of Python 2 keep their bytes only in Latin 1
        self.source = source

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ADMITTED:
            return _ADMITTED[module, name]
        if module.startswith("scipy.sparse") and name in _SPARSE:
            return _record(name)
        if module == "chumpy" or module.startswith("chumpy."):
            return _record(name)
        raise InputError(
            f"{self.source}: the pickle asks for {module}.{name}, which arrays do not need; it was not run. "
            "Use the file from the model's own site, or save its arrays as .npz"
        )

    def persistent_load(self, key: Any) -> Any:
        raise InputError(f"{self.source}: the pickle refers to data outside it; save the arrays as .npz")


def _record(name: str) -> type[Record]:
    return type(name, (Record,), {"kind": name})


def _array(_subtype: Any, _shape: Any, _dtype: Any) -> np.ndarray:
    """An empty array; the pickle then sets its shape, type and bytes."""
    return np.ndarray((0,), np.uint8)


def _scalar(dtype: np.dtype, data: Any = b"") -> Any:
    raw = data.encode("latin1") if isinstance(data, str) else data
    return np.frombuffer(raw, dtype, 1)[0]


def _buffer(data: Any, dtype: np.dtype, shape: tuple, order: str) -> np.ndarray:
    """An array of protocol 5."""
    return np.frombuffer(data, dtype).reshape(shape, order="F" if order == "F" else "C")


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """How bytes travel in pickles of protocol 2."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"bytes in {encoding}")
    return text.encode("latin1")


def _bare(kind: Any, _base: Any, _state: Any) -> Any:
    """An instance of a Record; Python 2's way of making any object."""
    if not (isinstance(kind, type) and issubclass(kind, Record)):
        raise pickle.UnpicklingError("an object of another kind than an array")
    return kind()


class _Object:
    """Stands for Python's `object`, which old pickles name as the base of what they rebuild."""


_ADMITTED: dict[tuple[str, str], type | Callable] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): _encode,
    ("copy_reg", "_reconstructor"): _bare,
    ("copyreg", "_reconstructor"): _bare,
    ("__builtin__", "object"): _Object,
    ("builtins", "object"): _Object,
    ("collections", "OrderedDict"): dict,
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _array for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _buffer for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _scalar for core in ("core", "_core")},
}

"""
glTF 2.0 in one binary file (GLB): its JSON tree and binary chunk <-> arrays.

Source: Khronos Group, glTF 2.0 Specification. Everything is little-endian; the same calls give the same bytes.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

_MAGIC, _VERSION, _JSON, _BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_ATTRIBUTES, _INDICES = 34962, 34963  # what a buffer view is for, where the format lets it be said
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_CODES = {np.dtype(name).str: code for code, name in _TYPES.items()}
_PICTURES = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}


class Writer:
    """
    A glTF under construction. `tree` is its JSON, to whose lists `add` appends; arrays and pictures go into the binary
    chunk. Equal bytes for an equal use are stored once.
    """

    def __init__(self, generator: str) -> None:
        self.tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": generator}}
        self._chunk = bytearray()
        self._views: dict[tuple[bytes, str, int | None], int] = {}

    def add(self, kind: str, value: dict[str, Any]) -> int:
        """Appends to a list of the tree ('nodes', 'materials', …); returns the index."""
        values = self.tree.setdefault(kind, [])
        values.append(value)
        return len(values) - 1

    def attribute(self, values: np.ndarray, *, bounds: bool = False) -> int:
        """Accessor of a vertex attribute (n,) or (n, c) float; `bounds` as POSITION needs them."""
        return self._dense(np.asarray(values, "<f4"), "attribute", _ATTRIBUTES, bounds)

    def indices(self, triangles: np.ndarray) -> int:
        """Accessor of (m, 3) vertex numbers, in 16 bit where they fit."""
        return self._dense(_short(np.asarray(triangles).ravel()), "indices", _INDICES, False)

    def keys(self, values: np.ndarray, *, bounds: bool = False) -> int:
        """Accessor of an animation's times (with `bounds`) or of its values, (f,) or (f, c) float."""
        return self._dense(np.asarray(values, "<f4"), "keys", None, bounds)

    def sparse(self, rows: np.ndarray, values: np.ndarray, n: int) -> int:
        """
        Accessor of (n, 3) float that is zero but for `values` (k, 3) at the ascending `rows` (k,), with bounds.

        The format knows no sparse accessor without entries: for k = 0 the first row is said to be zero.
        """
        if len(rows) == 0:
            rows, values = np.zeros(1, int), np.zeros((1, 3))
        assert np.all(np.diff(rows) > 0)
        stored, listed = np.ascontiguousarray(values, "<f4"), _short(rows)
        whole = stored if len(rows) == n else np.vstack([stored, np.zeros((1, 3), "<f4")])
        return self.add(
            "accessors",
            {
                "componentType": _CODES[stored.dtype.str],
                "count": n,
                "type": _KINDS[3],
                **_bounds(whole),
                "sparse": {
                    "count": len(rows),
                    "indices": {"bufferView": self._view(listed, "rows"), "componentType": _CODES[listed.dtype.str]},
                    "values": {"bufferView": self._view(stored, "values")},
                },
            },
        )

    def texture(self, picture: bytes, name: str) -> int:
        """A texture of a PNG or JPEG file's bytes, mip-mapped and clamped at its edges."""
        mime = next(kind for magic, kind in _PICTURES.items() if picture.startswith(magic))
        image = self.add("images", {"name": name, "mimeType": mime, "bufferView": self._view(picture, "picture")})
        if "samplers" not in self.tree:
            # linear, linear between mip levels, clamp to edge
            self.add("samplers", {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071})
        return self.add("textures", {"name": name, "source": image, "sampler": 0})

    def glb(self) -> bytes:
        """The file's bytes."""
        tree = dict(self.tree)
        if self._chunk:
            tree["buffers"] = [{"byteLength": len(self._chunk)}]
        return _file(tree, bytes(self._chunk))

    def _dense(self, values: np.ndarray, use: str, target: int | None, bounds: bool) -> int:
        view = self._view(values, use, target)
        width = 1 if values.ndim == 1 else values.shape[1]
        about = {"bufferView": view, "componentType": _CODES[values.dtype.str], "count": len(values)}
        return self.add("accessors", {**about, "type": _KINDS[width], **(_bounds(values) if bounds else {})})

    def _view(self, data: np.ndarray | bytes, use: str, target: int | None = None) -> int:
        raw = data if isinstance(data, bytes) else np.ascontiguousarray(data).tobytes()
        key = (raw, use, target)
        if key not in self._views:
            self._chunk += bytes(-len(self._chunk) % 4)
            about = {"buffer": 0, "byteOffset": len(self._chunk), "byteLength": len(raw)}
            self._chunk += raw
            self._views[key] = self.add("bufferViews", about if target is None else {**about, "target": target})
        return self._views[key]


@dataclass(frozen=True)
class Gltf:
    """A parsed GLB: its JSON tree and its binary chunk."""

    tree: dict[str, Any]
    chunk: bytes

    def view(self, index: int) -> bytes:
        """The bytes of a buffer view: a picture's file, say."""
        about = self.tree["bufferViews"][index]
        start = about.get("byteOffset", 0)
        return self.chunk[start : start + about["byteLength"]]

    def accessor(self, index: int) -> np.ndarray:
        """(n,) or (n, c) values, sparse entries filled in; normalised integers as they are stored."""
        about = self.tree["accessors"][index]
        kind = np.dtype(_TYPES[about["componentType"]])
        width = next(width for width, name in _KINDS.items() if name == about["type"])
        values = np.zeros((about["count"], width), kind)
        if "bufferView" in about:
            values[:] = self._rows(about, kind, about["count"], width)
        if "sparse" in about:
            entries = about["sparse"]
            numbers = np.dtype(_TYPES[entries["indices"]["componentType"]])
            rows = self._rows(entries["indices"], numbers, entries["count"], 1)[:, 0]
            values[rows] = self._rows(entries["values"], kind, entries["count"], width)
        return values[:, 0] if width == 1 else values

    def named(self, kind: str, name: str) -> dict[str, Any]:
        """The one element of a list of the tree that bears this name."""
        (found,) = [value for value in self.tree[kind] if value.get("name") == name]
        return found

    def _rows(self, where: dict[str, Any], kind: np.dtype, count: int, width: int) -> np.ndarray:
        view = self.tree["bufferViews"][where["bufferView"]]
        start = view.get("byteOffset", 0) + where.get("byteOffset", 0)
        stride = view.get("byteStride", kind.itemsize * width)
        return np.ndarray((count, width), kind, self.chunk, start, (stride, kind.itemsize))


def read_glb(data: bytes) -> Gltf:
    """
    Parses a GLB file whose one buffer is its own binary chunk.

    Raises ValueError for anything else.
    """
    if len(data) < 12 or struct.unpack_from("<II", data) != (_MAGIC, _VERSION):
        raise ValueError("not a binary glTF 2.0 file")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    if at != len(data) or struct.unpack_from("<I", data, 8)[0] != len(data) or _JSON not in chunks:
        raise ValueError("a binary glTF 2.0 file that ends early")
    tree = json.loads(chunks[_JSON])
    if any("uri" in buffer for buffer in tree.get("buffers", [])):
        raise ValueError("a glTF file whose buffers lie in other files")
    return Gltf(tree, chunks.get(_BIN, b""))


def with_picture(glb: Gltf, name: str, picture: bytes) -> bytes:
    """The file's bytes again, the picture `name` replaced by another PNG or JPEG."""
    tree = json.loads(json.dumps(glb.tree))
    image = next(image for image in tree["images"] if image["name"] == name)
    image["mimeType"] = next(kind for magic, kind in _PICTURES.items() if picture.startswith(magic))
    own = image["bufferView"]
    chunk = bytearray()
    for i, view in enumerate(tree["bufferViews"]):
        raw = picture if i == own else glb.view(i)
        chunk += bytes(-len(chunk) % 4)
        view["byteOffset"], view["byteLength"] = len(chunk), len(raw)
        chunk += raw
    tree["buffers"] = [{"byteLength": len(chunk)}]
    return _file(tree, bytes(chunk))


def _file(tree: dict[str, Any], chunk: bytes) -> bytes:
    text = json.dumps(tree, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    chunks = [(_JSON, text + b" " * (-len(text) % 4))]
    if chunk:
        chunks.append((_BIN, chunk + bytes(-len(chunk) % 4)))
    body = b"".join(struct.pack("<II", len(data), kind) + data for kind, data in chunks)
    return struct.pack("<III", _MAGIC, _VERSION, 12 + len(body)) + body


def _short(numbers: np.ndarray) -> np.ndarray:
    # 65535 itself is reserved in 16 bit
    return np.ascontiguousarray(numbers, "<u2" if numbers.max(initial=0) < 65535 else "<u4")


def _bounds(values: np.ndarray) -> dict[str, list[float]]:
    columns = values.reshape(len(values), -1)
    return {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}

"""The one thing that HEIC decoders do not tell: whether the file turns its picture by itself."""

from __future__ import annotations

import struct
from collections.abc import Iterator


def turns_itself(data: bytes) -> bool:
    """
    Whether the primary picture of an HEIC file has an `irot` or `imir` property (ISO/IEC 23008-12, 6.5.10 and 6.5.12).

    Decoders apply these, and an EXIF orientation beside them says the same again; without them EXIF alone tells. False
    for anything that cannot be parsed.
    """
    try:
        meta = next(body for kind, body in _boxes(data) if kind == b"meta")[4:]
        parts = dict(_boxes(meta))
        properties = dict(_boxes(parts[b"iprp"]))
        kinds = [kind for kind, _ in _boxes(properties[b"ipco"])]
        used = _associations(properties[b"ipma"])[_primary(parts[b"pitm"])]
        return any(kinds[i - 1] in (b"irot", b"imir") for i in used if 0 < i <= len(kinds))
    except (KeyError, StopIteration, struct.error):
        return False


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """(kind, body) of consecutive ISO base media boxes."""
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        head = 8
        if size == 1:
            (size,), head = struct.unpack_from(">Q", data, at + 8), 16
        if size == 0:
            size = len(data) - at
        if size < head:
            return
        yield kind, data[at + head : at + size]
        at += size


def _primary(pitm: bytes) -> int:
    """The primary item's number."""
    return int(struct.unpack_from(">H" if pitm[0] == 0 else ">I", pitm, 4)[0])


def _associations(ipma: bytes) -> dict[int, list[int]]:
    """Item number -> 1-based numbers of its properties."""
    version, wide = ipma[0], ipma[3] & 1
    (items,) = struct.unpack_from(">I", ipma, 4)
    at, found = 8, {}
    for _ in range(items):
        (item,) = struct.unpack_from(">H" if version == 0 else ">I", ipma, at)
        at += 2 if version == 0 else 4
        n = ipma[at]
        numbers = struct.unpack_from(f">{n}{'H' if wide else 'B'}", ipma, at + 1)
        found[item] = [v & (0x7FFF if wide else 0x7F) for v in numbers]
        at += 1 + n * (2 if wide else 1)
    return found

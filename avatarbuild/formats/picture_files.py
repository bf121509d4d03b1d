"""The outer structure of JPEG and PNG files: whether a copy is whole, and where a PNG keeps its EXIF block."""

from __future__ import annotations

import re
from collections.abc import Iterator

# a marker inside JPEG's entropy-coded data: not a stuffed 0xFF00, a restart or a fill byte
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")


def is_whole(data: bytes, kind: str | None) -> bool:
    """
    Whether a file of Pillow's format `kind` reaches the end of its first picture; True for formats not looked into.

    Decoders fill what is missing with grey, or take the zeros after an interrupted copy for pixels.
    """
    if kind in ("JPEG", "MPO"):
        return _jpeg_is_whole(data)
    if kind == "PNG":
        return any(name == b"IEND" for name, _ in _png_chunks(data))
    return True


def png_exif(data: bytes) -> bytes:
    """The EXIF block of a PNG file wherever it stands; Pillow would decode the whole picture to look behind it."""
    return next((body for name, body in _png_chunks(data) if name == b"eXIf"), b"")


def _jpeg_is_whole(data: bytes) -> bool:
    """Walks segments and scans to the first end-of-image marker; thumbnails lie inside segments."""
    at = 2
    while 0 <= at < len(data) - 1:
        if data[at] != 0xFF:
            return False
        kind = data[at + 1]
        if kind == 0xD9:
            return True
        if kind == 0xFF:
            at += 1
            continue
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if kind == 0xDA:
            found = _MARKER.search(data, at)
            if found is None:
                return False
            at = found.start()
    return False


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """(name, body) of the chunks that are complete; picture data without its body."""
    at = 8
    while at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        name = data[at + 4 : at + 8]
        if at + 12 + size > len(data):
            return
        yield name, b"" if name == b"IDAT" else data[at + 8 : at + 8 + size]
        at += size + 12

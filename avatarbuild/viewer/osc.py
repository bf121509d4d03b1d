"""
Blendshapes out of OSC packets: VMC's messages, and plain ones whose address ends in a shape's name.

    /VMC/Ext/Blend/Val  "JawOpen" 0.4        one shape; the next /VMC/Ext/Blend/Apply shows all that came before
    /anything/jawOpen   0.4                  one shape, shown at once
    /VMC/Ext/Bone/Pos   "Head" x y z qx qy qz qw    the head's turn, in Unity's left-handed axes

Sources: OpenSoundControl 1.0 (M. Wright, 2002); the Virtual Motion Capture protocol's specification. Packets come from
anywhere on this machine: what is malformed is passed over, numbers are held within 0 … 1.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from avatarbuild.template import ARKIT_NAMES

_BUNDLE = b"#bundle\0"
_DEPTH = 8  # bundles inside bundles
_SHAPES = {name.lower(): name for name in ARKIT_NAMES}
_VALUE, _APPLY, _BONE = "/VMC/Ext/Blend/Val", "/VMC/Ext/Blend/Apply", "/VMC/Ext/Bone/Pos"
_SIZES = {"i": ">i", "f": ">f", "h": ">q", "d": ">d", "t": ">q"}
_CONSTANTS = {"T": True, "F": False, "N": None, "I": math.inf}


@dataclass
class State:
    """What has been heard: weights by name, the head's turn x, y, z, w in the avatar's axes; `waiting` for Apply."""

    weights: dict[str, float] = field(default_factory=dict)
    head: tuple[float, float, float, float] | None = None
    waiting: dict[str, float] = field(default_factory=dict)

    def hear(self, packet: bytes) -> bool:
        """Takes a UDP packet in; True where there is something new to show."""
        news = False
        for address, values in messages(packet):
            if address == _VALUE and len(values) >= 2 and isinstance(values[0], str):
                name = _SHAPES.get(values[0].lower())
                if name and _number(values[1]):
                    self.waiting[name] = min(max(float(values[1]), 0.0), 1.0)
            elif address == _APPLY:
                self.weights.update(self.waiting)
                self.waiting.clear()
                news = True
            elif address == _BONE and len(values) >= 8 and values[0] == "Head" and all(map(_number, values[4:8])):
                x, y, z, w = (float(v) for v in values[4:8])
                if math.hypot(x, y, z, w) > 1e-6:
                    self.head = (x, -y, -z, w)  # x is mirrored between Unity's axes and ours
                    news = True
            elif values and _number(values[0]) and (name := _SHAPES.get(address.rsplit("/", 1)[-1].lower())):
                self.weights[name] = min(max(float(values[0]), 0.0), 1.0)
                news = True
        return news


def messages(packet: bytes, depth: int = 0) -> Iterator[tuple[str, list[Any]]]:
    """(address, values) of every message of a packet, those of bundles in their order; malformed ones are left out."""
    if packet.startswith(_BUNDLE):
        at = 16  # after the time tag
        while depth < _DEPTH and at + 4 <= len(packet):
            (size,) = struct.unpack_from(">i", packet, at)
            if size < 0 or at + 4 + size > len(packet):
                return
            yield from messages(packet[at + 4 : at + 4 + size], depth + 1)
            at += 4 + size
        return
    try:
        address, at = _text(packet, 0)
        kinds, at = _text(packet, at)
        if not address.startswith("/") or not kinds.startswith(","):
            return
        values = []
        for kind in kinds[1:]:
            value, at = _value(packet, at, kind)
            values.append(value)
    except (ValueError, struct.error):
        return
    yield address, values


def _text(packet: bytes, at: int) -> tuple[str, int]:
    end = packet.index(b"\0", at)
    return packet[at:end].decode("utf-8"), end + 4 - end % 4


def _value(packet: bytes, at: int, kind: str) -> tuple[Any, int]:
    if kind in _SIZES:
        (value,) = struct.unpack_from(_SIZES[kind], packet, at)
        return value, at + struct.calcsize(_SIZES[kind])
    if kind in ("s", "S"):
        return _text(packet, at)
    if kind in _CONSTANTS:
        return _CONSTANTS[kind], at
    raise ValueError(f"OSC type {kind!r} is not read")


def _number(value: Any) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool) and math.isfinite(value)

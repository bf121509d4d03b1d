"""Two arches of fourteen teeth, from tables of crown sizes and a catenary dental arch.

Mouth frame: origin at the midpoint between the upper central incisors' edges, x to the subject's left, y up, z forward;
the teeth bite (lower incisors 2 mm behind and 2 mm above the upper edges). Crown sizes: means of the dental anatomy
books (Wheeler's tables); arches: a catenary fits human arches closely (MacConaill and Scher 1949).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from .part import Floats, Half, Ints, Part, fan_triangles, grid_triangles, join_halves, reflect, signed_areas

ArchName = Literal["upper", "lower"]
NAMES = (
    "central_incisor",
    "lateral_incisor",
    "canine",
    "first_premolar",
    "second_premolar",
    "first_molar",
    "second_molar",
)
WIDTH = {"upper": 58.0, "lower": 53.0}  # mm between the buccal cusp lines at the back ends of the arches
DEPTH = {"upper": 42.7, "lower": 42.5}  # mm from the incisal edges to the back ends
OVERBITE = 2.0  # mm
OVERJET = 2.0  # mm

# mesiodistal width, crown height, labiolingual thickness, torque (degrees, crown forward), cusp height above the rim
# at the sides, elevation of the edge or cusps over the incisors' (the curve of Spee), all in mm but the torque
_CROWNS: dict[str, tuple[tuple[float, ...], ...]] = {
    "upper": (
        (8.5, 10.4, 6.8, 16.0, 0.15, 0.0),
        (6.7, 9.2, 5.9, 15.0, 0.3, 0.5),
        (7.6, 10.0, 7.6, 7.0, 1.6, -0.2),
        (7.0, 8.5, 8.8, 3.0, 1.7, -0.1),
        (6.8, 8.2, 8.8, 2.0, 1.5, -0.1),
        (10.2, 7.5, 10.6, 0.0, 1.3, 0.1),
        (9.6, 7.2, 10.6, -3.0, 1.2, 0.9),
    ),
    "lower": (
        (5.2, 8.9, 5.8, 8.0, 0.1, 0.0),
        (5.8, 9.2, 6.2, 8.0, 0.2, 0.1),
        (6.9, 10.4, 7.4, 3.0, 1.6, 0.2),
        (7.0, 8.6, 7.4, -3.0, 1.6, -0.6),
        (7.1, 8.2, 7.8, -6.0, 1.4, -0.8),
        (11.0, 7.5, 9.8, -10.0, 1.2, -0.7),
        (10.5, 7.2, 9.6, -12.0, 1.2, 0.1),
    ),
}
_TIP = (2.0, 4.0, 7.0, 4.0, 3.0, 3.0, 3.0)  # degrees by which the root leans to the back of the arch
_KNOTS = np.array([-0.3, 0.1, 0.42, 0.7, 0.9, 1.0])  # height in the crown: 0 at its neck, 1 at the rim
# half width over its largest, then the labial and the lingual surface over the thickness, before and behind the edge
_ANTERIOR = np.array(
    [
        [0.60, 0.78, 0.92, 1.0, 0.985, 0.93],
        [0.28, 0.40, 0.40, 0.29, 0.16, 0.07],
        [-0.45, -0.54, -0.42, -0.23, -0.14, -0.08],
    ]
)
_POSTERIOR = np.array(
    [
        [0.62, 0.82, 0.95, 1.0, 0.92, 0.76],
        [0.08, 0.17, 0.19, 0.14, 0.06, -0.03],
        [-0.70, -0.81, -0.85, -0.82, -0.76, -0.68],
    ]
)
_CONTACT = 0.3  # depth of the contact with the next tooth, over the crown height
_EDGE = 0.25  # mm by which the rounded edge of the front teeth stands over their rim
_SEGMENTS = 12
_CURVATURE = 3.93  # half width over the catenary's parameter
_GAP = 0.998  # width of a crown over its place in the arch
_UV_SCALE = 1 / 100.0  # texture per mm
_UV_MARGIN = 0.006


@dataclass(frozen=True)
class Crown:
    """One tooth of the subject's left side: its sizes in mm, and its frame: origin at the edge on the arch line,
    columns of `axes` (3, 3): along the arch to the back, outwards, towards the root."""

    name: str
    width: float
    height: float
    thickness: float
    cusp: float
    origin: Floats
    axes: Floats
    tip: float

    @property
    def anterior(self) -> bool:
        return self.name in NAMES[:3]

    def section(self, t: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Half width, labial and lingual offset (mm) and superellipse exponent at crown heights t (any shape)."""
        table = _ANTERIOR if self.anterior else _POSTERIOR
        half, labial, lingual = (np.interp(t, _KNOTS, row) for row in table)
        squareness = np.interp(t, [0.0, 0.6], [2.1, 2.6 if self.anterior else 2.9])
        return half * self.width / 2, labial * self.thickness, lingual * self.thickness, squareness

    def surface(self, along: Floats, t: Floats, labial: bool) -> Floats:
        """Outward offset (mm) of the crown's labial or lingual surface at `along` -1..1 of its half width."""
        _, front, back, power = self.section(t)
        bow = 0.5 * (front - back) * (1 - np.abs(along) ** power) ** (1 / power)
        return np.asarray(0.5 * (front + back) + (bow if labial else -bow))

    def place(self, along: Floats, outwards: Floats, t: Floats) -> Floats:
        """Points (..., 3) in the mouth frame at `along` and `outwards` mm and crown height t (1 edge, 0 neck)."""
        rootward = (1.0 - t) * self.height
        along = along + (rootward - _CONTACT * self.height) * np.tan(np.radians(self.tip))
        local = np.stack(np.broadcast_arrays(along, outwards, rootward), -1)
        return np.asarray(self.origin + local @ self.axes.T)


def arch_curve(arch: ArchName, width: float, depth: float) -> tuple[Floats, Floats]:
    """The left half of the arch line, densely: arclength (k,) and points (k, 2) (x, z) in mm,
    z = -depth (cosh(c x / w) - 1) / (cosh c - 1), w half the width, from the midline to the back end."""
    x = np.linspace(0.0, width / 2, 4001)
    z = -depth * (np.cosh(_CURVATURE * 2 * x / width) - 1) / (np.cosh(_CURVATURE) - 1)
    front = 0.0 if arch == "upper" else -OVERJET - 0.07 * _CROWNS["lower"][0][2]
    points = np.stack([x, z + front], 1)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]), points


def crowns(arch: ArchName, width: float | None = None, depth: float | None = None) -> tuple[Crown, ...]:
    """The seven left crowns, their widths scaled by one number so that they fill the arch line."""
    curve_width, curve_depth = width or WIDTH[arch], depth or DEPTH[arch]
    arclength, points = arch_curve(arch, curve_width, curve_depth)
    table = np.array(_CROWNS[arch])
    ends = np.concatenate([[0.0], np.cumsum(table[:, 0])]) * (arclength[-1] / table[:, 0].sum())
    up = 1.0 if arch == "upper" else -1.0
    made = []
    for k, (_, height, thickness, torque, cusp, elevation) in enumerate(_CROWNS[arch]):
        first, last = (np.array([np.interp(s, arclength, points[:, c]) for c in range(2)]) for s in ends[k : k + 2])
        chord = last - first
        along = np.array([chord[0], 0.0, chord[1]]) / np.linalg.norm(chord)
        outwards = np.array([-along[2], 0.0, along[0]])
        angle = np.radians(torque)
        root = np.array([0.0, up, 0.0]) * np.cos(angle) - outwards * np.sin(angle)
        middle = np.array([np.interp(ends[k : k + 2].mean(), arclength, points[:, c]) for c in range(2)])
        y = (OVERBITE if arch == "lower" else 0.0) + elevation + up * _EDGE * (k < 3)
        axes = np.stack([along, outwards * np.cos(angle) + np.array([0.0, up, 0.0]) * np.sin(angle), root], 1)
        made.append(
            Crown(
                NAMES[k],
                float(np.linalg.norm(chord)) * _GAP,
                height,
                thickness,
                cusp,
                np.array([middle[0], y, middle[1]]),
                axes,
                _TIP[k],
            )
        )
    return tuple(made)


def teeth(arch: ArchName, width: float | None = None, depth: float | None = None) -> Part:
    """Fourteen teeth of one arch in occlusion; 1190 vertices, 2184 triangles, in 14 components open below the gums.

    width, depth (mm): of the arch line through incisal edges and buccal cusps. Groups: each tooth as NAME_left and
    NAME_right, `edge` (incisal edges and cusps), `neck` (open border inside the gums). Field `height`: 0 at the neck,
    1 at the rim.
    """
    lower = arch == "lower"
    half = join_halves([_tooth(crown, k, lower) for k, crown in enumerate(crowns(arch, width, depth))])
    return reflect(f"teeth_{arch}", half)


def _tooth(crown: Crown, row: int, lower: bool) -> Half:
    """A crown as rings from inside the gum to the rim, then one ring and a vertex that close the top."""
    # the ring starts and ends in the middle of the lingual side, where the texture's seam is
    turn = -np.pi / 2 + 2 * np.pi * np.arange(_SEGMENTS) / _SEGMENTS
    cosine, sine = np.cos(turn)[None], np.sin(turn)[None]
    t = _KNOTS[:, None]
    half, labial, lingual, power = (a for a in crown.section(t))
    across = np.sign(cosine) * np.abs(cosine) ** (2 / power)
    through = np.sign(sine) * np.abs(sine) ** (2 / power)
    along = half * across
    outwards = 0.5 * (labial + lingual) + 0.5 * (labial - lingual) * through
    height = t - _relief(crown, across, through) * np.clip((t - 0.45) / 0.55, 0, 1) ** 2 / crown.height
    wall = crown.place(along, outwards, height)
    inset, sunk = (0.55, -_EDGE) if crown.anterior else (0.55, 1.2)
    middle = outwards[-1].mean()
    top_relief = _relief(crown, across[-1] * inset, through[-1] * (0.2 if crown.anterior else inset))
    top = crown.place(
        along[-1] * inset, middle + (outwards[-1] - middle) * inset, 1 - (top_relief + sunk) / crown.height
    )
    centre = 0.0 if crown.anterior else sunk + 0.4
    apex = crown.place(
        np.zeros(1), np.array([middle]), np.array([1 - (centre + (sunk if crown.anterior else 0)) / crown.height])
    )
    vertices = np.concatenate([wall.reshape(-1, 3), top, apex])

    rows, columns = wall.shape[:2]
    ids = np.arange((rows + 1) * columns, dtype=np.int32).reshape(rows + 1, columns)
    closed = np.concatenate([ids, ids[:, :1]], 1)
    last = len(vertices) - 1
    pieces = [grid_triangles(closed[:rows]), grid_triangles(closed[rows - 1 :]), fan_triangles(closed[-1], last)]

    wall_uv, wall_size = _unrolled(wall)
    cap = np.stack([along[-1], outwards[-1]], 1)
    cap_uv = np.concatenate([cap, np.stack([along[-1] * inset, middle + (outwards[-1] - middle) * inset], 1)])
    cap_uv = np.concatenate([cap_uv, [[0.0, middle]]])
    corner = np.array([0.5 + 2 * _UV_MARGIN, _UV_MARGIN + row * (1 - _UV_MARGIN) / 7])
    wall_ids = np.arange(rows * (columns + 1), dtype=np.int32).reshape(rows, columns + 1)
    start = wall_ids.size
    rim = np.append(np.arange(columns), 0).astype(np.int32) + np.int32(start)
    cap_pieces = [
        grid_triangles(np.stack([rim, rim + np.int32(columns)])),
        fan_triangles(rim + np.int32(columns), start + 2 * columns),
    ]
    wall_pieces = grid_triangles(wall_ids)
    if lower:
        # roots point down: the frame is left-handed, so every triangle turns round
        pieces = [p[:, ::-1] for p in pieces]
        cap_pieces = [p[:, ::-1] for p in cap_pieces]
        wall_pieces = wall_pieces[:, ::-1]
    wall_uv = _upright(wall_uv, wall_pieces, 0)
    cap_all = np.concatenate([np.zeros((start, 2)), cap_uv])
    cap_uv = _upright(cap_all, np.concatenate(cap_pieces), start)[start:]
    cap_uv = cap_uv - cap_uv.min(0)
    uv = np.concatenate(
        [corner + wall_uv * _UV_SCALE, corner + [wall_size * _UV_SCALE + _UV_MARGIN, 0.0] + cap_uv * _UV_SCALE]
    )
    fields = np.concatenate([np.broadcast_to(t, wall.shape[:2]).ravel(), np.ones(columns + 1)])
    groups = {
        crown.name: np.arange(len(vertices)),
        "edge": np.concatenate([ids[-2:].ravel(), [last]]),
        "neck": ids[0],
    }
    return Half(
        vertices,
        np.concatenate(pieces),
        uv,
        np.concatenate([wall_pieces, *cap_pieces]),
        {k: np.asarray(v, np.int32) for k, v in groups.items()},
        {},
        {"height": fields},
    )


def _relief(crown: Crown, across: Floats, through: Floats) -> Floats:
    """Depth (mm) of the rim below the edge or cusp tips, at normalised positions in -1..1 along and through it."""
    if crown.name == "canine":
        return np.asarray(crown.cusp * np.abs(across) ** 1.2 * np.where(across > 0, 1.15, 0.85))
    if crown.anterior:
        # the far corner of an incisor is rounder than the near one
        return np.asarray(crown.cusp * across**2 + np.where(across > 0, 0.9, 0.35) * across**4)
    cusps = 2.0 if "molar" in crown.name and "premolar" not in crown.name else 1.0
    side = 0.5 - 0.5 * np.cos(np.pi * (cusps * across + (cusps - 1)))
    if cusps == 1.0:
        side = np.abs(across) ** 1.5
    return np.asarray(crown.cusp * np.clip(side, 0, 1) + 0.5 * (through < 0) * -through)


def _unrolled(wall: Floats) -> tuple[Floats, float]:
    """A straight strip (rows, columns + 1) -> (.., 2) mm for a closed wall: mean segment and row lengths."""
    closed = np.concatenate([wall, wall[:, :1]], 1)
    step = np.linalg.norm(np.diff(closed, axis=1), axis=2).mean(0)
    rise = np.linalg.norm(np.diff(wall, axis=0), axis=2).mean(1)
    u, v = np.concatenate([[0.0], np.cumsum(step)]), np.concatenate([[0.0], np.cumsum(rise)])
    return np.stack(np.meshgrid(u, v), -1).reshape(-1, 2), float(u[-1])


def _upright(uv: Floats, uv_triangles: Ints, start: int) -> Floats:
    """The chart, turned over in u if its triangles run clockwise."""
    if signed_areas(uv, uv_triangles).sum() > 0:
        return uv
    turned = uv.copy()
    turned[start:, 0] = uv[start:, 0].min() + uv[start:, 0].max() - uv[start:, 0]
    return turned

"""Gum ridges that hold the two arches of teeth, with the palate above and the floor of the mouth below.

Every station along an arch has one cross-section, from the vestibule over the labial margin, between the teeth, over
the lingual margin and down to the lingual base; from there chains run to the midline and close the horseshoe.
"""

from __future__ import annotations

import numpy as np

from .part import Floats, Half, Ints, Part, grid_triangles, join_parts, reflect, signed_areas
from .teeth import ArchName, Crown, crowns

_SIDES = {True: (0.44, 0.05), False: (0.38, 0.08)}  # labial?: crown height of the gum between teeth and at mid-tooth
_VESTIBULE = ((12.0, 0.3), (7.5, 0.4), (3.8, 0.8))  # mm rootward of the neck, mm outside the crown's neck
_LOW_VESTIBULE = ((6.6, -2.2), (5.0, -0.9), (3.2, 0.3))  # drawn up and in below: chins are narrow for the root
_ROLL = (1.3, 0.65)  # the rounded edge of the gum: mm rootward of the margin, mm outside the crown
_LIP = 0.12  # mm outside the crown at the margin
_LINGUAL = {"upper": (3.0, 1.2), "lower": (6.0, 0.8)}  # lingual base: mm rootward of the neck, mm inside the crown
_CREST = 5  # the row between the teeth, where the texture is cut
_CHAIN = 4  # steps from the lingual base to the midline
_BACK = 4.5  # mm of ridge behind the last molar
# (share of the way from front to back, y mm) of the midline of palate and floor
_MIDLINE = {
    "upper": ((0.0, 0.3, 0.65, 1.0), (14.0, 18.5, 20.5, 18.0)),
    "lower": ((0.0, 0.3, 1.0), (-13.0, -15.0, -15.0)),
}
_UV_SCALE = 1 / 152.0
_UV_MARGIN = 0.006


def gums(
    upper: tuple[float | None, float | None] = (None, None), lower: tuple[float | None, float | None] = (None, None)
) -> Part:
    """Upper and lower gums in the mouth frame, around `teeth(arch, width, depth)` with the same (width, depth).

    Two open surfaces, upper vertices first. Groups: `upper` (with the palate) and `lower` (with the floor; follows
    the jaw), `palate`, `floor`, `margin_upper`, `margin_lower`. Field `mucosa`: 0 at the margin, 1 in the vestibule.
    """
    top = _ridge("upper", crowns("upper", *upper), 0.0)
    bottom = _ridge("lower", crowns("lower", *lower), 0.5)
    return join_parts("gums", [reflect("upper", top), reflect("lower", bottom)])


def _stations(count: int) -> list[tuple[int, float]]:
    """(tooth, position -1..1 along it) from the back end to the midline; positions over 1 lie behind the arch."""
    places = [(count - 1, 2.0), (count - 1, 1.0)]
    for k in reversed(range(count)):
        within = (0.6, 0.0, -0.6) if k < 5 else (0.0,)
        places += [(k, p) for p in within] + [(k, -1.0)]
    return places


def _section(crown: Crown, along: float, arch: ArchName, vestibule: tuple[tuple[float, float], ...]) -> Floats:
    """The nine points (9, 3) of one cross-section on one crown."""
    behind = along > 1.0
    inside = np.array(min(abs(along), 0.93) * np.sign(along))
    reach = crown.width / 2
    rows = []

    def at(t: float, outwards: float) -> None:
        half = float(crown.section(np.array(t))[0])
        shift = reach + _BACK if behind else along * (reach if abs(along) == 1 else half)
        rows.append(crown.place(np.array(shift), np.array(outwards), np.array(t)))

    def margin(labial: bool) -> float:
        between, middle = _SIDES[labial]
        if behind:
            return 0.0
        if crown.name == "second_molar" and along == 1.0:
            return 0.2
        return float(middle + (between - middle) * abs(along) ** 2.6)

    shrink = 0.55 if behind else 1.0
    neck = [float(crown.surface(np.array(0.0), np.array(0.0), side)) * shrink for side in (True, False)]
    swell = 0.25 * np.cos(np.pi * min(abs(along), 1.0))
    for mm, out in vestibule:
        at(-mm / crown.height, neck[0] + out + swell * (mm < 10))
    for labial in (True, False):
        t, sign = margin(labial), 1.0 if labial else -1.0
        edge = float(crown.surface(inside, np.array(t), labial)) * shrink
        roll = (t - _ROLL[0] / crown.height, edge + sign * _ROLL[1])
        lip = (t, edge + sign * _LIP)
        if labial:
            at(*roll)
            at(*lip)
            middle = 0.5 * (crown.section(np.array(0.3))[1] + crown.section(np.array(0.3))[2])
            at(0.5 * (margin(True) + margin(False)) + 0.03, float(middle))
        else:
            at(*lip)
            at(*roll)
    mm, out = _LINGUAL[arch]
    at(-mm / crown.height, neck[1] - out)
    return np.stack(rows)


def _ridge(arch: ArchName, row: tuple[Crown, ...], corner: float) -> Half:
    """The left half of one gum with its palate or floor; `corner` is the texture's v of its lower edge."""
    full = _surface(arch, row, _VESTIBULE if arch == "upper" else _LOW_VESTIBULE)
    stations, columns = full.shape[:2]
    ids = np.arange(stations * columns, dtype=np.int32).reshape(stations, columns)
    # at the front end of the midline only this diagonal avoids three points in a line
    triangles = grid_triangles(ids)
    # both vestibules have the texture of the same depth
    outer, inner, uv = _texture(_surface(arch, row, _VESTIBULE), corner)
    uv_triangles = _match(ids, triangles, outer, inner)
    if _volume_sign(full, triangles) * (1 if arch == "upper" else -1) > 0:
        triangles, uv_triangles = triangles[:, ::-1], uv_triangles[:, ::-1]
    uv = _turned(uv, uv_triangles, outer, inner)
    name = "palate" if arch == "upper" else "floor"
    groups = {arch: ids.ravel(), name: ids[:, 8:].ravel(), f"margin_{arch}": ids[:, [4, 6]].ravel()}
    mucosa = np.concatenate([[1.0, 0.75, 0.35, 0.06, 0.0, 0.0, 0.0, 0.06, 0.3], np.full(_CHAIN, 0.45)])
    return Half(full.reshape(-1, 3), triangles, uv, uv_triangles, groups, {}, {"mucosa": np.tile(mucosa, stations)})


def _surface(arch: ArchName, row: tuple[Crown, ...], vestibule: tuple[tuple[float, float], ...]) -> Floats:
    """The grid (stations, 13, 3) of the left half: cross-sections and chains."""
    sections = []
    for k, along in _stations(len(row)):
        here = _section(row[k], along, arch, vestibule)
        if along == -1.0 and k > 0:
            here = 0.5 * (here + _section(row[k - 1], 1.0, arch, vestibule))
        elif along == 1.0 and k + 1 < len(row):
            continue
        sections.append(here)
    grid = np.stack(sections)
    grid[-1, :, 0] = 0.0
    for rows, passes in (((0, 1, 8), 4), ((2,), 1)):
        for _ in range(passes):
            grid[:, rows] = _smoothed(grid[:, rows])
    return np.concatenate([grid, _chain(grid[:, 8], arch)], 1)


def _smoothed(rows: Floats) -> Floats:
    """One binomial pass along the stations; the midline's neighbour is its own reflection, the back end stays."""
    beyond = rows[-2:-1] * np.array([-1.0, 1.0, 1.0])
    extended = np.concatenate([rows, beyond])
    result = rows.copy()
    result[1:] = 0.25 * extended[:-2] + 0.5 * extended[1:-1] + 0.25 * extended[2:]
    return result


def _chain(base: Floats, arch: ArchName) -> Floats:
    """Chains (stations, 4, 3) from the lingual base to the midline, where both sides meet."""
    lengths = np.linalg.norm(np.diff(base, axis=0), axis=1)
    along = 1.0 - np.concatenate([[0.0], np.cumsum(lengths)]) / lengths.sum()
    front, back = base[-1, 2], base[0, 2]
    share = 0.5 * along + 0.5 * (base[:, 2] - front) / (back - front)
    start = front - 6.0
    middle = np.stack([np.zeros(len(base)), np.interp(share, *_MIDLINE[arch]), start + share * (back - start)], 1)
    f = np.arange(1, _CHAIN + 1)[None, :, None] / _CHAIN
    chain = base[:, None] + (middle - base)[:, None] * f
    chain[..., 1] = base[:, None, 1] + (middle - base)[:, None, 1] * np.sin(0.5 * np.pi * f[..., 0])
    chain[-1, :, 0] = 0.0
    chain[:, -1, 0] = 0.0
    return np.asarray(chain)


def _texture(full: Floats, corner: float) -> tuple[Ints, Ints, Floats]:
    """Two charts, cut at the crest: labial band as a straight strip, the rest laid flat outwards from the midline."""
    stations = len(full)
    band, rest = full[:, : _CREST + 1], full[:, _CREST:][:, ::-1]
    rise = np.linalg.norm(np.diff(band, axis=1), axis=2).mean(0)
    run = np.linalg.norm(np.diff(_smoothed(_smoothed(full[:, 2])), axis=0), axis=1)[::-1].cumsum()[::-1]
    u = np.concatenate([run, [0.0]])
    v = np.concatenate([[0.0], np.cumsum(rise)])
    strip = np.stack([np.repeat(u[:, None], len(v), 1), np.repeat(v[None], stations, 0)], -1)
    steps = np.linalg.norm(np.diff(rest, axis=1), axis=2)
    reach = np.concatenate([np.zeros((stations, 1)), np.cumsum(steps, 1)], 1)
    away = (full[:, 8] - full[:, -1])[:, [0, 2]]
    away = away / np.linalg.norm(away, axis=1, keepdims=True)
    away[-1] = [0.0, 1.0]
    spine = np.linalg.norm(np.diff(full[:, -1], axis=0), axis=1)
    origin = np.stack([np.zeros(stations), np.concatenate([[0.0], np.cumsum(spine)])], 1)
    flat = origin[:, None] + reach[..., None] * away[:, None]
    flat[..., 1] -= flat[..., 1].min()
    low = corner + _UV_MARGIN
    strip = np.array([0.5, low]) + strip * _UV_SCALE
    flat = np.array([0.5, low + v[-1] * _UV_SCALE + _UV_MARGIN]) + flat * _UV_SCALE
    outer = np.arange(band.shape[0] * band.shape[1], dtype=np.int32).reshape(stations, -1)
    inner = (np.arange(flat.shape[0] * flat.shape[1]).reshape(stations, -1) + outer.size).astype(np.int32)
    return outer, inner[:, ::-1], np.concatenate([strip.reshape(-1, 2), flat.reshape(-1, 2)])


def _match(ids: Ints, triangles: Ints, outer: Ints, inner: Ints) -> Ints:
    """Texture triangles for the grid's triangles: the labial chart up to the crest, the inner chart behind it."""
    columns = ids.shape[1]
    station, column = np.divmod(triangles, columns)
    labial = column.max(1, keepdims=True) <= _CREST
    first = outer[station, np.minimum(column, _CREST)]
    second = inner[station, np.maximum(column - _CREST, 0)]
    return np.where(labial, first, second).astype(np.int32)


def _volume_sign(full: Floats, triangles: Ints) -> float:
    """Sign of the mean upward normal of the chains: the palate's outside looks down, the floor's looks up."""
    v = full.reshape(-1, 3)
    a, b, c = (v[triangles[:, k]] for k in range(3))
    chained = (triangles % full.shape[1] >= 8).all(1)
    return float(np.sign(np.cross(b - a, c - a)[chained, 1].sum()))


def _turned(uv: Floats, uv_triangles: Ints, outer: Ints, inner: Ints) -> Floats:
    """Every chart, turned upside down within its own band if its triangles run clockwise."""
    uv = uv.copy()
    for chart in (outer, inner):
        chosen = np.isin(uv_triangles[:, 0], chart)
        if signed_areas(uv, uv_triangles[chosen]).sum() < 0:
            v = uv[chart.ravel(), 1]
            uv[chart.ravel(), 1] = v.min() + v.max() - v
    return uv

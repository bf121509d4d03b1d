"""Everything put together: skin, eyeballs, teeth, gums and tongue with one identity space and 52 expressions."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import charts
import depth
import expressions
import landmarks
import lids
import lips
import nostrils
import numpy as np
import parts
import placement
import regions
import scipy.sparse as sp
import sketch
import wall
from cage import HEAD, MOUTH, NECK, SOCKET_LEFT, Cage
from identity import FLIP
from scipy.spatial import cKDTree
from subdivide import Fine

from avatarbuild import landmarks as detector
from avatarbuild.template import EyeRotation, Part, Template

GAZE = {"Up": ((-1.0, 0.0, 0.0), 22.0), "Down": ((1.0, 0.0, 0.0), 24.0), "Out": ((0.0, 1.0, 0.0), 28.0)}
GAZE["In"] = ((0.0, -1.0, 0.0), 28.0)
OFFSET_FLOOR = 0.01  # mm: smaller corrections than this are not stored


def vertex_weights(cage: Cage, fine: Fine) -> tuple[np.ndarray, np.ndarray]:
    """(c,) weights of the principal components and (c,) of the alignment: area, mostly of the face; guides almost 0."""
    neutral = cage.neutral
    points = fine.matrix @ neutral[: cage.skin]
    a, b, c = (points[fine.triangles[:, k]] for k in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    area = np.zeros(len(neutral))
    area[: cage.skin] = np.abs(fine.matrix).T @ sum(
        np.bincount(fine.triangles[:, k], third, len(points)) for k in range(3)
    )
    down = neutral[: cage.skin, 1].max() - neutral[:, 1]
    face = _smooth(-10, 60, neutral[:, 2]) * (1 - _smooth(220, 260, down)) * (0.35 + 0.65 * _smooth(30, 75, down))
    weights = area * (0.08 + 0.92 * face) + 1e-3
    return weights / weights.mean(), area * face * (neutral[:, 2] > 40)


def _smooth(a: float, b: float, x: np.ndarray) -> np.ndarray:
    t = np.clip((x - a) / (b - a), 0, 1)
    return t * t * (3 - 2 * t)


def assemble(recipe: SimpleNamespace, version: str, say: Callable[[str], None]) -> Template:
    """The template from source, cage, fine mesh, mean and components (on the cage) and the expression names."""
    cage, fine, names = recipe.cage, recipe.fine, recipe.names
    labels = cage.labels[fine.face]
    skin, eyes = _skin(recipe, labels, say)
    say("lids and lips fitted")
    small = _inner_parts(recipe, skin, eyes)
    subdivision, cage_mean, cage_identity, cage_expressions = _cage(recipe, skin, small)
    say(f"{subdivision.shape[1]} cage rows for {subdivision.shape[0]} vertices")
    mean = subdivision @ cage_mean
    identity = _apply(subdivision, cage_identity)
    posed = _apply(subdivision, cage_expressions)
    triangles, ranges, mirror = _join(fine.triangles, skin.mirror, small)
    uv, uv_triangles = _texture(skin.mean, fine.triangles, labels, small)
    say("texture layout")
    n = len(mean)
    masks = {name: np.pad(mask, (0, n - len(mask))) for name, mask in skin.regions.items()}
    first = {
        "name": "head",
        "version": version,
        "mean": mean,
        "triangles": triangles,
        "parts": ranges,
        "uv": uv,
        "uv_triangles": uv_triangles,
        "identity": identity,
        "sigma": np.sqrt((identity**2).sum(axis=2).mean(axis=1)),
        "expressions": posed,
        "expression_names": names,
        "regions": masks,
        "symmetry": mirror,
        "contours": skin.contours,
        "eye_centres": eyes[0],
        "eye_centre_basis": eyes[1],
        "eye_rotations": _gaze(),
        "chart_distance": charts.border_distance(uv, uv_triangles),
        "quads": cage.quads.astype(np.int32),
        "subdivision": subdivision,
        "cage_mean": cage_mean,
        "cage_identity": cage_identity,
        "cage_expressions": cage_expressions,
    }
    first |= _landmarks(first, small, say)
    # last, so that texture and landmarks are the rim's
    cage_mean[: cage.skin] += nostrils.hollowed(cage_mean[: cage.skin], cage)
    return Template(**first | {"mean": subdivision @ cage_mean, "cage_mean": cage_mean})


def _apply(s: sp.csr_matrix, deltas: np.ndarray) -> np.ndarray:
    k, c, _ = deltas.shape
    return np.ascontiguousarray((s @ deltas.transpose(1, 0, 2).reshape(c, -1)).reshape(-1, k, 3).transpose(1, 0, 2))


def _skin(recipe: SimpleNamespace, labels: np.ndarray, say: Callable[[str], None]):
    """The fine skin with lids on the eyes and sealed lips, about the eyes' midpoint; and the eyes' centres."""
    cage, fine = recipe.cage, recipe.fine
    s, rows = fine.matrix, cage.skin
    mean = s @ recipe.mean[:rows]
    walled = wall.held(recipe.mean, recipe.components, cage, fine)[:, :rows]
    components = _apply(s, walled)
    gap, mirror = cKDTree(mean).query(mean * FLIP)
    assert gap.max() < 1e-6
    parity = np.sign(np.einsum("kcx,kcx->k", components[:, mirror] * FLIP, components))

    left = lids.lid_band(mean, fine.triangles, labels == SOCKET_LEFT)
    fix, fixes, centre, basis = lids.fit_identity(mean, components, left)
    mean = mean + fix + fix[mirror] * FLIP
    components = components + fixes + parity[:, None, None] * fixes[:, mirror] * FLIP
    eyes = np.stack([centre, centre * FLIP]), np.stack([basis, parity[:, None] * basis * FLIP], axis=1)
    say(f"eye centres {np.round(centre, 2)}")

    mouth = lips.lip_band(mean, fine.triangles, labels == MOUTH)
    mean = lips.seal(mean, mouth, lips.PRESS)
    components = np.stack([lips.seal(component, mouth) for component in components])
    origin = eyes[0].mean(axis=0)
    mean = mean - origin
    eyes = (eyes[0] - origin, eyes[1])

    right = lids.LidBand(left.ring[mirror], mirror[left.contact], left.column[mirror], left.spread)
    masks = regions.regions(mean, fine.triangles, labels, [left, right], mouth, eyes[0], mirror)
    lines = regions.contours(mean, [left, right], mouth, masks["brows"], eyes[0])
    units, posed = _expressions(recipe, origin, mean, left, mouth, eyes[0][0], mirror, (components, eyes[1][:, 0]))
    cages = (recipe.mean[:rows] - origin, walled, units)
    fields = {"mean": mean, "identity": components, "expressions": posed, "cages": cages, "mirror": mirror}
    return SimpleNamespace(**fields, origin=origin, regions=masks, contours=lines), eyes


def _expressions(recipe, origin, mean, left, mouth, centre, mirror, people) -> tuple[np.ndarray, np.ndarray]:
    """(e, c, 3) cleaned on the cage, and (e, n, 3) with lids and lips refitted on the fine skin."""
    cage, names = recipe.cage, recipe.names
    units = expressions.face_units(recipe.source, cage.matrix, cage.mirror, names)[:, : cage.skin]
    neck = np.zeros(cage.skin)
    neck[cage.quads[cage.labels == NECK]] = 1
    hard = neck.copy()
    average = expressions.neighbour_mean(cage.quads, cage.skin)
    for _ in range(8):
        neck = np.maximum(hard, average @ neck)
    rim = np.zeros(cage.skin, bool)
    rim[np.intersect1d(cage.quads[cage.labels == MOUTH], cage.quads[cage.labels == HEAD])] = True
    for _ in range(4):
        rim |= (average @ rim.astype(float)) > 0
    units = expressions.clean(units, names, cage.quads, neck, rim)
    units = _deepened(recipe, units, origin)
    posed = _apply(recipe.fine.matrix, units)
    change = np.zeros_like(posed)
    for i, name in enumerate(names):
        if np.abs(posed[i, left.contact]).max() > 0.02:
            fitted = (mean, posed[i], left, centre)
            if name == "eyeBlinkLeft":
                shape = lids.close_lids(*fitted, *people)
            else:
                shape = lids.fit_expression(*fitted, gaze_direction(name))
            change[i] = shape - posed[i]
    for i, name in enumerate(names):
        posed[i] += change[i] + change[names.index(expressions.other_side(name))][mirror] * FLIP
    for i, name in enumerate(names):
        if name in lips.SEALED:
            posed[i] = lips.seal(posed[i], mouth)
    jaw, close = names.index("jawOpen"), names.index("mouthClose")
    posed[close] = lips.seal(posed[jaw] + posed[close], mouth) - posed[jaw]
    return units, posed


def _incisors(recipe: SimpleNamespace, origin: np.ndarray) -> np.ndarray:
    """(3,) where the middle of the upper incisors' edge lies in the mean head."""
    guide = recipe.mean[recipe.cage.guides["helper-upper-teeth"]] - origin
    return np.array([0, guide[:, 1].min(), guide[:, 2].max()]) + placement.INCISORS


def _deepened(recipe: SimpleNamespace, units: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(e, c, 3) expressions on the cage whose lips keep to the teeth; see `depth`."""
    cage, names = recipe.cage, recipe.names
    vertices, place = recipe.mean[: cage.skin] - origin, _incisors(recipe, origin)
    upper, lower, gums = parts.teeth("upper"), parts.teeth("lower"), parts.gums()
    corners = np.concatenate([part.vertices for part in (upper, lower, gums)]) + place
    starts = np.cumsum([0, len(upper.vertices), len(lower.vertices)])
    faces = np.concatenate([part.triangles + k for part, k in zip((upper, lower, gums), starts, strict=True)])
    teeth = depth.arch(corners, faces, upper.vertices + place)
    about, mirror = depth.rings(vertices, cage), cage.mirror[: cage.skin]
    out = units.copy()
    for name in depth.SLIDING:
        i, j = names.index(f"{name}Left"), names.index(f"{name}Right")
        out[i] = depth.slide(vertices, units[i], units[j], about, teeth)
        out[j] = out[i][mirror] * FLIP
    i = names.index("mouthRollLower")
    rolled = depth.roll(vertices, units[i], units[names.index("mouthRollUpper")], about)
    out[i] = (rolled + rolled[mirror] * FLIP) / 2
    return out


def _inner_parts(recipe: SimpleNamespace, skin: SimpleNamespace, eyes) -> list[SimpleNamespace]:
    """The eyeballs and what is in the mouth: name, generator's part, vertices in the head frame, its frames as
    (rows, frame), and its own deltas (e, k, 3) or None."""
    cage, names = recipe.cage, recipe.names
    units = expressions.face_units(recipe.source, cage.matrix, cage.mirror, names)
    frames = {}
    for name, rows in cage.guides.items():
        motion = units[:, rows] * (name != "helper-upper-teeth")
        frames[name] = placement.guided_frame(recipe.mean[rows] - skin.origin, recipe.components[:, rows], motion)
    upper, lower = frames["helper-upper-teeth"], frames["helper-lower-teeth"]
    incisors = _incisors(recipe, skin.origin)
    ball, gums, tongue = parts.eyeball(), parts.gums(), parts.tongue()
    everything = slice(None)
    found = []
    for k, name in enumerate(("eye_left", "eye_right")):
        frame = placement.shifted_frame(eyes[0][k], eyes[1][:, k], len(names))
        found.append((name, ball, eyes[0][k], [(everything, frame)], None))
    found.append(("teeth_upper", parts.teeth("upper"), incisors, [(everything, upper)], None))
    found.append(("teeth_lower", parts.teeth("lower"), incisors, [(everything, lower)], None))
    halves = [(gums.groups["upper"], upper), (gums.groups["lower"], lower)]
    found.append(("gums", gums, incisors, halves, None))
    own = np.zeros((len(names), len(tongue.vertices), 3))
    for name, delta in tongue.deltas.items():
        own[names.index(name)] = delta
    found.append(("tongue", tongue, incisors, [(everything, lower)], own))
    keys = ("name", "part", "vertices", "frames", "own")
    return [
        SimpleNamespace(**dict(zip(keys, (name, part, part.vertices + place, held, deltas), strict=True)))
        for name, part, place, held, deltas in found
    ]


def _cage(recipe: SimpleNamespace, skin: SimpleNamespace, small: list[SimpleNamespace]):
    """subdivision (n, c) and the cage's mean (c, 3), identity (p, c, 3) and expressions (e, c, 3).

    Cage rows: the skin's cage; offsets of the skin vertices that lids and lips correct; the parts' control points; the
    tongue's own offsets.
    """
    s = recipe.fine.matrix
    cages = [np.asarray(values) for values in skin.cages]
    wanted = (skin.mean, skin.identity, skin.expressions)
    rest = [
        w[None] - _apply(s, c[None]) if w.ndim == 2 else w - _apply(s, c) for w, c in zip(wanted, cages, strict=True)
    ]
    rest[0] = rest[0][0]
    size = np.max([np.abs(r).reshape(-1, s.shape[0], 3).max(axis=(0, 2)) for r in rest], axis=0)
    offset = np.flatnonzero(size > OFFSET_FLOOR)
    columns = [cages[0], rest[0][offset]], [cages[1], rest[1][:, offset]], [cages[2], rest[2][:, offset]]
    pick = sp.csr_matrix((np.ones(len(offset)), (offset, np.arange(len(offset)))), shape=(s.shape[0], len(offset)))
    width = s.shape[1] + len(offset)
    pieces: list[tuple] = [(0, 0, sp.hstack([s, pick]))]
    row, placed = s.shape[0], {}
    p = len(cages[1])
    for item in small:
        for rows, frame in item.frames:
            if id(frame) not in placed:
                placed[id(frame)] = width
                width += 4
                for column, values in zip(columns, (frame.points, frame.identity, frame.expressions), strict=True):
                    column.append(values)
            ids = np.arange(len(item.vertices))[rows]
            pieces.append((row + ids, placed[id(frame)], frame.weights(item.vertices[ids])))
        if item.own is not None:
            k = len(item.vertices)
            pieces.append((row + np.arange(k), width, np.eye(k)))
            width += k
            for column, values in zip(columns, (np.zeros((k, 3)), np.zeros((p, k, 3)), item.own), strict=True):
                column.append(values)
        row += len(item.vertices)
    matrix = placement.gather(pieces, row, width)
    return matrix, np.concatenate(columns[0]), np.concatenate(columns[1], 1), np.concatenate(columns[2], 1)


def _join(skin_triangles: np.ndarray, skin_mirror: np.ndarray, small: list[SimpleNamespace]):
    """All triangles (m, 3), part name -> Part, and the mirror vertex of each vertex (n,)."""
    v, t = len(skin_mirror), len(skin_triangles)
    triangles, mirror = [skin_triangles], [skin_mirror]
    ranges = {"skin": Part(slice(0, v), slice(0, t))}
    for item in small:
        k, m = len(item.vertices), len(item.part.triangles)
        triangles.append(item.part.triangles + v)
        ranges[item.name] = Part(slice(v, v + k), slice(t, t + m))
        v, t = v + k, t + m
    for item in small:
        twin = {"eye_left": "eye_right", "eye_right": "eye_left"}.get(item.name, item.name)
        mirror.append(item.part.mirror + ranges[twin].vertices.start)
    return np.concatenate(triangles).astype(np.int32), ranges, np.concatenate(mirror).astype(np.int32)


def _texture(mean: np.ndarray, triangles: np.ndarray, labels: np.ndarray, small: list[SimpleNamespace]):
    """uv (u, 2) and uv_triangles (m, 3) of skin and parts in one map."""
    uv, faces, bags = charts.skin_charts(mean, triangles, labels)
    flat = {name: (points, chart) for name, (points, chart, _) in bags.items()}
    flat |= {item.name: (item.part.uv, item.part.uv_triangles) for item in small}
    places = charts.pack(uv, faces[(faces >= 0).all(axis=1)], list(flat))
    whole, start, stack = faces.copy(), len(uv), [uv]
    for name, (points, chart) in flat.items():
        corner, side = places[name]
        stack.append(corner + side * points)
        if name in bags:
            whole[bags[name][2]] = chart + start
        else:
            whole = np.concatenate([whole, chart + start])
        start += len(points)
    return np.clip(np.concatenate(stack), 0, 1), whole.astype(np.int32)


def _landmarks(fields: dict, small: list[SimpleNamespace], say: Callable[[str], None]) -> dict[str, np.ndarray]:
    """The landmark fields of a template that has all others in `fields`."""
    plain = SimpleNamespace(**fields)
    plain.neutral = lambda a: plain.mean + (a @ plain.identity.reshape(len(a), -1)).reshape(-1, 3)
    points = landmarks.find(plain, sketch.paint(plain), detector.mirror())
    say(f"landmarks: {np.isfinite(points[:468, 0]).sum()} of 468 seen")
    balls = {item.name: item.part.points for item in small if item.name.startswith("eye")}
    triangles, barycentric = landmarks.anchor(plain, points, balls, plain.contours)
    sliding = np.zeros(478, bool)
    sliding[list(landmarks.OVAL)] = True
    return {
        "landmark_triangles": triangles,
        "landmark_barycentric": barycentric,
        "landmark_sliding": sliding,
        "landmarks68": np.array(landmarks.POINTS68, np.int32),
        "feature_edges": landmarks.strain_edges(triangles, plain.triangles, barycentric),
    }


def gaze_direction(name: str) -> tuple[float, float, float]:
    """Where the left eye looks at weight 1 of a shape: ahead, but for its own eyeLook shapes."""
    way = name.removeprefix("eyeLook").removesuffix("Left")
    if way not in GAZE or name != f"eyeLook{way}Left":
        return lids.AHEAD
    axis, degrees = GAZE[way]
    turned = np.cos(np.radians(degrees)) * np.array(lids.AHEAD) + np.sin(np.radians(degrees)) * np.cross(
        axis, lids.AHEAD
    )
    return tuple(turned.tolist())


def _gaze() -> dict[str, EyeRotation]:
    """eyeLook shape -> rotation; the right eye mirrors the left one."""
    found = {}
    for way, (axis, degrees) in GAZE.items():
        found[f"eyeLook{way}Left"] = EyeRotation("left", np.array(axis), degrees)
        found[f"eyeLook{way}Right"] = EyeRotation("right", np.array(axis) * [1, -1, -1], degrees)
    return found

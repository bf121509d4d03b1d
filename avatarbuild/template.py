"""The head template: a linear morphable head with the 52 ARKit expressions, eyeballs, teeth, gums and tongue.

x(a, w) = mean + sum_k a_k identity_k + sum_j w_j expression_j, then each eyeball turned about its own centre.

Everything is in the head frame in millimetres: x to the subject's left, y up, z out of the face, origin midway
between the eyeball centres of the mean. Sizes: n vertices of all parts together (skin first), m triangles, p identity
components, e = 52 expressions, c vertices of the cage.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from avatarbuild.errors import InputError
from avatarbuild.geometry.rotations import rotation

ARKIT_NAMES: tuple[str, ...] = (
    *("eyeBlinkLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft", "eyeSquintLeft"),
    *("eyeWideLeft", "eyeBlinkRight", "eyeLookDownRight", "eyeLookInRight", "eyeLookOutRight", "eyeLookUpRight"),
    *("eyeSquintRight", "eyeWideRight", "jawForward", "jawLeft", "jawRight", "jawOpen", "mouthClose", "mouthFunnel"),
    *("mouthPucker", "mouthLeft", "mouthRight", "mouthSmileLeft", "mouthSmileRight", "mouthFrownLeft"),
    *("mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight", "mouthStretchLeft", "mouthStretchRight"),
    *("mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "mouthPressLeft", "mouthPressRight"),
    *("mouthLowerDownLeft", "mouthLowerDownRight", "mouthUpperUpLeft", "mouthUpperUpRight", "browDownLeft"),
    *("browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "cheekPuff", "cheekSquintLeft"),
    *("cheekSquintRight", "noseSneerLeft", "noseSneerRight", "tongueOut"),
)
EYE_PARTS = ("eye_left", "eye_right")
MOUTH_PARTS = ("teeth_upper", "teeth_lower", "gums", "tongue")
PART_NAMES = ("skin", *EYE_PARTS, *MOUTH_PARTS)
REGION_NAMES = ("face", "lips", "lids", "nose", "brows", "ears", "scalp", "neck", "sockets", "mouth")
CONTOUR_NAMES = (
    *("lips_outer_upper", "lips_outer_lower", "lips_inner_upper", "lips_inner_lower"),
    *("lid_upper_left", "lid_lower_left", "lid_upper_right", "lid_lower_right", "brow_left", "brow_right"),
)
COMBINATION_LIMITS = (("mouthClose", "jawOpen"),)  # the first's weight never exceeds the second's
PIVOT = np.array([0.0, -95.0, -55.0])  # mm: about where a head turns on its neck


def expression_weights(**named: float) -> np.ndarray:
    """(52,) weights in ARKit's order, 0 but for the named; a name without its side stands for left and right."""
    w = np.zeros(len(ARKIT_NAMES))
    for name, value in named.items():
        for full in (name,) if name in ARKIT_NAMES else (f"{name}Left", f"{name}Right"):
            w[ARKIT_NAMES.index(full)] = value
    return w


class Part(NamedTuple):
    """A connected piece of the template: its vertices and its triangles, each a contiguous range."""

    vertices: slice
    triangles: slice


class EyeRotation(NamedTuple):
    """How an eyeLook shape turns an eyeball: about `axis` (3,) unit, right-handed, by `degrees` at weight 1."""

    eye: str  # "left" or "right"
    axis: np.ndarray
    degrees: float


class Refined(NamedTuple):
    """A finer mesh: vertices = matrix @ coarse vertices; matrix (n', n), triangles (m', 3), uv (u', 2)."""

    matrix: sp.csr_matrix
    triangles: np.ndarray
    uv: np.ndarray
    uv_triangles: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Template:
    """A head template; the module docstring gives the model, units and letters."""

    name: str
    version: str
    mean: np.ndarray
    """(n, 3) float mm"""
    triangles: np.ndarray
    """(m, 3) int32, counter-clockwise from outside"""
    parts: dict[str, Part]
    """PART_NAMES in this order as far as the model has them; "skin" always, and first"""
    uv: np.ndarray
    """(u, 2) float in [0, 1], origin bottom left"""
    uv_triangles: np.ndarray
    """(m, 3) int32 into uv"""
    identity: np.ndarray
    """(p, n, 3) float mm per standard deviation"""
    sigma: np.ndarray
    """(p,) float mm: root mean square vertex motion of one standard deviation"""
    expressions: np.ndarray
    """(e, n, 3) float mm at weight 1; zero on the eyeballs"""
    expression_names: tuple[str, ...]
    """ARKIT_NAMES"""
    regions: dict[str, np.ndarray]
    """REGION_NAMES -> (n,) bool"""
    symmetry: np.ndarray
    """(n,) int32: the vertex on the other side"""
    landmark_triangles: np.ndarray
    """(478,) int32"""
    landmark_barycentric: np.ndarray
    """(478, 3) float"""
    landmark_sliding: np.ndarray
    """(478,) bool: the silhouette of jaw and forehead, which wanders over the skin with the view"""
    landmarks68: np.ndarray
    """(68,) int32 into the 478"""
    feature_edges: np.ndarray
    """(>= 44, 2) int32 vertex pairs along which skin strains; stage details has its own: details.edges"""
    contours: dict[str, np.ndarray]
    """CONTOUR_NAMES -> polyline of int32 vertices, from the subject's right to left"""
    eye_centres: np.ndarray
    """(2, 3) float mm: rotation centres of the mean's left and right eyeball"""
    eye_centre_basis: np.ndarray
    """(p, 2, 3) float mm per standard deviation"""
    eye_rotations: dict[str, EyeRotation]
    """eyeLook name -> EyeRotation"""
    chart_distance: np.ndarray
    """(1024, 1024) float32 texels of this map, row 0 on top: distance to the chart's border, 0 outside the charts"""
    quads: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), np.int32))
    """(q, 4) int32: quads of the cage's skin"""
    subdivision: sp.csr_matrix | None = None
    """(n, c): mean = subdivision @ cage_mean and likewise for identity and expressions; None: no cage"""
    cage_mean: np.ndarray | None = None
    """(c, 3); the cage's vertices, then offsets and lattice points that `subdivision` adds in"""
    cage_identity: np.ndarray | None = None
    """(p, c, 3)"""
    cage_expressions: np.ndarray | None = None
    """(e, c, 3)"""

    def __post_init__(self) -> None:
        _validate(self)

    @property
    def vertex_count(self) -> int:
        """n"""
        return len(self.mean)

    @cached_property
    def expression_index(self) -> dict[str, int]:
        """Name -> row of `expressions`."""
        return {name: i for i, name in enumerate(self.expression_names)}

    @cached_property
    def _expression_matrix(self) -> sp.csc_matrix:
        # Most shapes move a fraction of the head, so that a sparse product beats a dense one severalfold.
        return sp.csc_matrix(self.expressions.reshape(len(self.expressions), -1).T)

    def neutral(self, coefficients: np.ndarray | None = None) -> np.ndarray:
        """(n, 3) = mean + sum_k a_k identity_k; `coefficients` (<= p,) in standard deviations, None: the mean."""
        if coefficients is None:
            return self.mean.copy()
        a = np.asarray(coefficients, np.float64)
        if self.subdivision is not None and self.cage_mean is not None and self.cage_identity is not None:
            # the cage is half the size, and this sum is bound by memory
            cage = self.cage_identity[: len(a)].reshape(len(a), self.cage_mean.size)
            return self.subdivision @ (self.cage_mean + (a @ cage).reshape(-1, 3))
        return self.mean + (a @ self.identity[: len(a)].reshape(len(a), self.mean.size)).reshape(-1, 3)

    def eye_positions(self, coefficients: np.ndarray | None = None) -> np.ndarray:
        """(2, 3) rotation centres of the left and right eyeball at an identity."""
        if coefficients is None:
            return self.eye_centres.copy()
        a = np.asarray(coefficients, np.float64)
        return self.eye_centres + np.tensordot(a, self.eye_centre_basis[: len(a)], 1)

    def eye_rotation_matrices(self, weights: np.ndarray) -> np.ndarray:
        """(2, 3, 3): R_s = exp([sum_j w_j degrees_j axis_j]_x), left then right."""
        turns = np.zeros((2, 3))
        for name, eye in self.eye_rotations.items():
            side = 0 if eye.eye == "left" else 1
            turns[side] += np.radians(eye.degrees) * weights[self.expression_index[name]] * eye.axis
        return np.stack([rotation(turn) for turn in turns])

    def allowed(self, weights: np.ndarray) -> np.ndarray:
        """Weights (e,) after the combination rules: COMBINATION_LIMITS, such as mouthClose <= jawOpen."""
        w = np.array(weights, np.float64)
        for limited, limit in COMBINATION_LIMITS:
            if limited in self.expression_index and limit in self.expression_index:
                i, j = self.expression_index[limited], self.expression_index[limit]
                w[i] = min(w[i], w[j])
        return w

    def evaluate(self, coefficients: np.ndarray | None, weights: np.ndarray, *, turn_eyes: bool = True) -> np.ndarray:
        """(n, 3): the posed head at identity `coefficients` (<= p,) and expression `weights` (e,)."""
        neutral = self.neutral(coefficients)
        return self.pose(neutral, weights, self.eye_positions(coefficients) if turn_eyes else None)

    def pose(self, neutral: np.ndarray, weights: np.ndarray, eye_positions: np.ndarray | None = None) -> np.ndarray:
        """(n, 3) = neutral (n, 3) + sum_j w_j expression_j; eyeballs turned about `eye_positions` (2, 3) if given."""
        w = np.asarray(weights, np.float64)
        posed = neutral + (self._expression_matrix @ w).reshape(-1, 3)
        if eye_positions is not None and self.eye_rotations:
            self.turn_eyes(posed, w, eye_positions)
        return posed

    def turn_eyes(self, vertices: np.ndarray, weights: np.ndarray, centres: np.ndarray) -> None:
        """Turn the eyeballs of vertices (n, 3) about centres (2, 3) by weights (e,), in place: R_s (x - c_s) + c_s."""
        for name, centre, turn in zip(EYE_PARTS, centres, self.eye_rotation_matrices(weights), strict=True):
            if name in self.parts:
                ball = self.parts[name].vertices
                vertices[ball] = (vertices[ball] - centre) @ turn.T + centre

    def part_uv(self, part: str) -> np.ndarray:
        """(u, 2) the texture coordinates, the part's own box stretched over the whole square; others clipped."""
        used = self.uv[np.unique(self.uv_triangles[self.parts[part].triangles])]
        low, high = used.min(axis=0), used.max(axis=0)
        return np.clip((self.uv - low) / np.maximum(high - low, 1e-12), 0, 1)

    def landmarks(self, vertices: np.ndarray) -> np.ndarray:
        """(478, 3) landmark points on posed `vertices` (n, 3)."""
        corners = vertices[self.triangles[self.landmark_triangles]]
        return np.einsum("ij,ijk->ik", self.landmark_barycentric, corners)

    def subdivide(self, levels: int) -> Refined:
        """Loop subdivision of the triangles, `levels` times; UVs by edge midpoints. Level 0 is the template itself.

        Vertex positions of any pose follow as matrix @ evaluate(...). Source: Loop 1987.
        """
        refined = Refined(sp.identity(self.vertex_count, format="csr"), self.triangles, self.uv, self.uv_triangles)
        for _ in range(levels):
            step, triangles = _loop_step(refined.triangles, refined.matrix.shape[0], smooth=True)
            uv_step, uv_triangles = _loop_step(refined.uv_triangles, len(refined.uv), smooth=False)
            refined = Refined((step @ refined.matrix).tocsr(), triangles, uv_step @ refined.uv, uv_triangles)
        return refined

    def save(self, path: Path) -> None:
        """Write the template as one npz; deltas in half precision, on the cage where there is one."""
        from_cage = self.subdivision is not None
        arrays: dict[str, np.ndarray] = {}
        for key in _PLAIN:
            arrays[key] = _compact(key, getattr(self, key))
        arrays["mean"] = np.asarray(self.cage_mean if from_cage else self.mean, np.float32)
        arrays["identity"] = _half(self.cage_identity if from_cage else self.identity)
        arrays["expressions"] = _half(self.cage_expressions if from_cage else self.expressions)
        if self.subdivision is not None:
            s = self.subdivision.tocsr()
            arrays["subdivision_data"] = s.data.astype(np.float32)
            arrays["subdivision_indices"] = s.indices.astype(np.int32)
            arrays["subdivision_indptr"] = s.indptr.astype(np.int32)
        arrays["name"] = np.array(self.name)
        arrays["version"] = np.array(self.version)
        arrays["expression_names"] = np.array(self.expression_names)
        arrays["part_names"] = np.array(list(self.parts))
        arrays["part_ranges"] = np.array(
            [[p.vertices.start, p.vertices.stop, p.triangles.start, p.triangles.stop] for p in self.parts.values()]
        )
        for key, region in self.regions.items():
            arrays[f"region/{key}"] = np.packbits(region)
        for key, line in self.contours.items():
            arrays[f"contour/{key}"] = line.astype(np.int32)
        arrays["rotation_names"] = np.array(list(self.eye_rotations), dtype=np.str_)
        arrays["rotation_eyes"] = np.array([r.eye for r in self.eye_rotations.values()], dtype=np.str_)
        arrays["rotations"] = np.array([[*r.axis, r.degrees] for r in self.eye_rotations.values()]).reshape(-1, 4)
        _write_npz(path, arrays)

    @staticmethod
    def load(path: Path | None = None) -> Template:
        """Read a template file, by default the shipped head.

        Raises:
            InputError: no such file, not a template, or an array in it does not fit the others.
        """
        file = template_folder() / "head.npz" if path is None else Path(path)
        if not file.is_file():
            raise InputError(f"template {file}: no such file; name a .npz made by `avatarbuild template import`")
        try:
            with np.load(file, allow_pickle=False) as stored:
                arrays = {key: stored[key] for key in stored.files}
        except (ValueError, OSError, zipfile.BadZipFile) as error:
            raise InputError(f"template {file}: not a template file ({error}); import the model again") from error
        try:
            return _from_arrays(arrays)
        except KeyError as error:
            raise InputError(f"template {file}: {error.args[0]} is missing; import the model again") from error
        except InputError as error:
            raise InputError(f"template {file}: {error}") from error


_PLAIN = (
    *("triangles", "uv", "uv_triangles", "sigma", "symmetry", "landmark_triangles", "landmark_barycentric"),
    *("landmark_sliding", "landmarks68", "feature_edges", "eye_centres", "eye_centre_basis", "chart_distance", "quads"),
)
_DISTANCE_STEP = 0.25  # texels: the stored resolution of chart_distance, which saturates at 63.75


def template_folder() -> Path:
    """The folder of the shipped head: inside the installed package, or templates/head of a checkout."""
    package = Path(__file__).resolve().parent
    for folder in (package / "templates" / "head", package.parent / "templates" / "head"):
        if (folder / "head.npz").is_file():
            return folder
    raise InputError(
        "the shipped head (templates/head/head.npz) is not there; reinstall avatarbuild, or run "
        "templates/head/build.py in a checkout"
    )


def _from_arrays(arrays: dict[str, np.ndarray]) -> Template:
    mean = arrays["mean"].astype(np.float64)
    identity = arrays["identity"].astype(np.float64)
    expressions = arrays["expressions"].astype(np.float64)
    cage: dict = {}
    if "subdivision_data" in arrays:
        indptr = arrays["subdivision_indptr"]
        s = sp.csr_matrix(
            (arrays["subdivision_data"].astype(np.float64), arrays["subdivision_indices"], indptr),
            shape=(len(indptr) - 1, len(mean)),
        )
        cage = {"subdivision": s, "cage_mean": mean, "cage_identity": identity, "cage_expressions": expressions}
        mean, identity, expressions = s @ mean, _refine(s, identity), _refine(s, expressions)
    ranges = arrays["part_ranges"].tolist()
    plain = {key: arrays[key] for key in _PLAIN}
    plain["chart_distance"] = arrays["chart_distance"].astype(np.float32) * np.float32(_DISTANCE_STEP)
    for key in ("uv", "sigma", "landmark_barycentric", "eye_centres", "eye_centre_basis"):
        plain[key] = arrays[key].astype(np.float64)
    return Template(
        name=str(arrays["name"].item()),
        version=str(arrays["version"].item()),
        mean=mean,
        identity=identity,
        expressions=expressions,
        expression_names=tuple(arrays["expression_names"].tolist()),
        parts={
            name: Part(slice(v0, v1), slice(t0, t1))
            for name, (v0, v1, t0, t1) in zip(arrays["part_names"].tolist(), ranges, strict=True)
        },
        regions={
            key.split("/")[1]: np.unpackbits(value, count=len(mean)).astype(bool)
            for key, value in arrays.items()
            if key.startswith("region/")
        },
        contours={key.split("/")[1]: value for key, value in arrays.items() if key.startswith("contour/")},
        eye_rotations={
            name: EyeRotation(eye, row[:3], float(row[3]))
            for name, eye, row in zip(
                arrays["rotation_names"].tolist(), arrays["rotation_eyes"].tolist(), arrays["rotations"], strict=True
            )
        },
        **plain,
        **cage,
    )


def _refine(s: sp.csr_matrix, deltas: np.ndarray) -> np.ndarray:
    """(k, n, 3) = S applied to each of (k, c, 3)."""
    k, c, _ = deltas.shape
    return np.ascontiguousarray((s @ deltas.transpose(1, 0, 2).reshape(c, -1)).reshape(-1, k, 3).transpose(1, 0, 2))


def _half(deltas: np.ndarray | None) -> np.ndarray:
    return np.asarray(deltas).astype(np.float16)


def _compact(key: str, value: np.ndarray) -> np.ndarray:
    if key == "chart_distance":
        return np.clip(np.round(value / _DISTANCE_STEP), 0, 255).astype(np.uint8)
    if value.dtype == bool:
        return value
    return value.astype(np.float32 if value.dtype.kind == "f" else np.int32)


def _write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """np.savez_compressed with a fixed date in the archive, so that the same arrays give the same bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for key in sorted(arrays):
            entry = zipfile.ZipInfo(f"{key}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            with archive.open(entry, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.ascontiguousarray(arrays[key]), allow_pickle=False)


def _loop_step(triangles: np.ndarray, n: int, *, smooth: bool) -> tuple[sp.csr_matrix, np.ndarray]:
    """One Loop subdivision: (n + edges, n) matrix and (4 m, 3) triangles; `smooth` False keeps midpoints only."""
    t = triangles.astype(np.int64)
    half = np.stack([t, np.roll(t, -1, axis=1)], axis=2).reshape(-1, 2)
    opposite = np.roll(t, -2, axis=1).reshape(-1)
    edges, edge_of = np.unique(np.sort(half, axis=1), axis=0, return_inverse=True)
    edge_of = edge_of.reshape(-1)
    count = np.bincount(edge_of, minlength=len(edges))
    k = len(edges)
    inner = (count == 2) & smooth
    end_weight = np.where(inner, 3 / 8, 1 / 2)
    rows = np.concatenate([np.arange(k), np.arange(k), edge_of[inner[edge_of]]])
    columns = np.concatenate([edges[:, 0], edges[:, 1], opposite[inner[edge_of]]])
    data = np.concatenate([end_weight, end_weight, np.full(int(inner[edge_of].sum()), 1 / 8)])
    edge_rows = sp.csr_matrix((data, (rows, columns)), shape=(k, n))
    if smooth:
        border = edges[count != 2]
        on_border = np.zeros(n, bool)
        on_border[border] = True
        ring = edges[~(on_border[edges[:, 0]] & on_border[edges[:, 1]]) | (count == 2)]
        pairs = np.concatenate([ring, ring[:, ::-1]])
        pairs = pairs[~on_border[pairs[:, 0]]]
        valence = np.bincount(pairs[:, 0], minlength=n)
        v = np.maximum(valence, 3)
        beta = (5 / 8 - (3 / 8 + np.cos(2 * np.pi / v) / 4) ** 2) / v
        own = np.where(on_border, 3 / 4, 1 - valence * beta)
        own[(valence == 0) & ~on_border] = 1
        along = np.concatenate([border, border[:, ::-1]])
        corner = np.bincount(along[:, 0], minlength=n) > 2 if len(along) else np.zeros(n, bool)
        own[corner] = 1
        along = along[~corner[along[:, 0]]]
        vertex_rows = sp.csr_matrix(
            (
                np.concatenate([own, beta[pairs[:, 0]], np.full(len(along), 1 / 8)]),
                (
                    np.concatenate([np.arange(n), pairs[:, 0], along[:, 0]]),
                    np.concatenate([np.arange(n), pairs[:, 1], along[:, 1]]),
                ),
            ),
            shape=(n, n),
        )
    else:
        vertex_rows = sp.identity(n, format="csr")
    middle = n + edge_of.reshape(-1, 3)
    a, b, c = t.T
    ab, bc, ca = middle.T
    finer = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return sp.vstack([vertex_rows, edge_rows]).tocsr(), finer.astype(np.int32)


def _validate(t: Template) -> None:
    """Raise InputError naming the first array whose shape, range or name does not fit."""
    n, p, m = len(t.mean), len(t.identity), len(t.triangles)
    e, u = len(t.expression_names), len(t.uv)
    shapes = {
        "mean": (n, 3),
        "triangles": (m, 3),
        "uv": (u, 2),
        "uv_triangles": (m, 3),
        "identity": (p, n, 3),
        "sigma": (p,),
        "expressions": (e, n, 3),
        "symmetry": (n,),
        "landmark_triangles": (478,),
        "landmark_barycentric": (478, 3),
        "landmark_sliding": (478,),
        "landmarks68": (68,),
        "feature_edges": (len(t.feature_edges), 2),
        "eye_centres": (2, 3),
        "eye_centre_basis": (p, 2, 3),
        "chart_distance": (1024, 1024),
        "quads": (len(t.quads), 4),
    }
    for key, shape in shapes.items():
        found = np.shape(getattr(t, key))
        if found != shape:
            raise InputError(f"{key} has shape {found}, {shape} is needed; check the model it came from")
    if tuple(t.expression_names) != ARKIT_NAMES:
        wrong = next((a for a, b in zip(t.expression_names, ARKIT_NAMES, strict=False) if a != b), "too few names")
        raise InputError(f"expression_names must be the 52 ARKit names in ARKit's order; found {wrong!r} out of place")
    limits = {
        "triangles": n,
        "uv_triangles": u,
        "symmetry": n,
        "landmark_triangles": m,
        "landmarks68": 478,
        "feature_edges": n,
        "quads": n if t.subdivision is None else t.subdivision.shape[1],
    }
    for key, limit in limits.items():
        value = getattr(t, key)
        if value.size and (value.min() < 0 or value.max() >= limit):
            raise InputError(f"{key} holds indices outside 0..{limit - 1}; check the model it came from")
    for key in ("mean", "uv", "identity", "expressions", "landmark_barycentric", "eye_centres", "eye_centre_basis"):
        if not np.isfinite(getattr(t, key)).all():
            raise InputError(f"{key} holds values that are not finite; check the model it came from")
    if next(iter(t.parts), None) != "skin":
        raise InputError(f"parts must begin with 'skin'; found {list(t.parts)}")
    for key, part in t.parts.items():
        if part.vertices.stop > n or part.triangles.stop > m:
            raise InputError(f"part {key!r} reaches beyond the {n} vertices or {m} triangles; check the importer")
    for kind, found_keys, needed in (
        ("region", t.regions, REGION_NAMES),
        ("contour", t.contours, CONTOUR_NAMES),
    ):
        for key in needed:
            if key not in found_keys:
                raise InputError(f"{kind} {key!r} is missing; {', '.join(needed)} are needed")
    for key, region in t.regions.items():
        if region.shape != (n,) or region.dtype != bool:
            raise InputError(f"region {key!r} must be a ({n},) bool mask; found {region.shape} {region.dtype}")
    for key, line in t.contours.items():
        if line.ndim != 1 or len(line) < 2 or line.min() < 0 or line.max() >= n:
            raise InputError(f"contour {key!r} must list two or more vertices below {n}")
    if not np.allclose(t.landmark_barycentric.sum(axis=1), 1, atol=1e-3):
        raise InputError("landmark_barycentric must sum to 1 in each row; check the landmark file")
    if t.uv.size and (t.uv.min() < -1e-6 or t.uv.max() > 1 + 1e-6):
        raise InputError("uv must lie in [0, 1]; tiles beyond it cannot be baked into one texture")
    for key in t.eye_rotations:
        if key not in ARKIT_NAMES:
            raise InputError(f"eye rotation {key!r} is no ARKit name")
    if t.subdivision is not None and (t.cage_mean is None or t.cage_identity is None or t.cage_expressions is None):
        raise InputError("a template with a subdivision matrix needs cage_mean, cage_identity and cage_expressions")

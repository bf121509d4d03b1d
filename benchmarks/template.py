"""Every figure of the head template: fit, texture map, lids, landmarks, speed, rebuild.

    python benchmarks/template.py [fit] [uv] [blink] [lids] [indices] [landmarks] [mouth [--spread 0.875]] [corners]
        [speed] [rebuild --wheel PATH]

Without names all but `rebuild` run. `fit` needs AVATARBUILD_BENCHMARK, the folder that holds truth_b.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import igl
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "templates" / "head")]

import sketch  # noqa: E402
from parts import eyeball_radius  # noqa: E402
from scoring import benchmark  # noqa: E402

from avatarbuild.template import ARKIT_NAMES, EYE_PARTS, Template, template_folder  # noqa: E402
from avatarbuild.template import expression_weights as weights  # noqa: E402

HEADS, SEED = 100, 77
SPREADS = (1.0, 0.875, 1.25)  # of the heads: people's, the simulator's, and that of the source's targets as sampled
DAMPING = 0.0128  # of the identity fit: mm^2 of mean square distance that a squared standard deviation is worth, x 100
PROPORTIONS = {
    "face, height to width": ((168, 152), (234, 454)),
    "nose, width to height": ((129, 358), (168, 2)),
    "pupils' distance to face's width": ((468, 473), (234, 454)),
    "pupils' distance to face's height": ((468, 473), (168, 152)),
}
PUBLISHED = {
    "face, height to width": {"Gordon": (6.3,), "Wai": (7.5, 7.6, 7.8), "KC": (9.4, 9.2)},
    "nose, width to height": {"Wai": (9.2, 10.8, 9.7), "KC": (10.2, 10.6)},
    "pupils' distance to face's width": {"Gordon": (5.4,)},
    "pupils' distance to face's height": {"Gordon": (7.3,)},
}


def random_heads(template: Template, count: int = HEADS) -> np.ndarray:
    """(count, p) coefficients, standard normal."""
    return np.random.default_rng(SEED).standard_normal((count, len(template.identity)))


def fit(template: Template) -> None:
    """Distance of the true neutral's visible face to the template under identity and similarity, point to surface."""
    folder = benchmark("truth_b")
    if folder is None:
        print("fit: set AVATARBUILD_BENCHMARK to the folder that holds truth_b")
        return
    with np.load(folder / "mesh.npz") as truth:
        points, faces, marks = truth["neutral"].astype(float), truth["tri"], truth["lm68"]
    with np.load(folder / "visibility.npz") as seen:
        visible = seen["photo_count"] > 0
    target = points[marks]
    nose = target[30]
    face = np.zeros(len(points), bool)
    face[: len(visible)] = visible[: len(points)]
    face &= np.linalg.norm(points - nose, axis=1) < 95
    corners = points[faces]
    third = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 6
    area = sum(np.bincount(faces[:, k], third, len(points)) for k in range(3))[face]
    for count in (0, 50, len(template.identity)):
        distance = fit_identity(template, points[face], target, count, area)
        order = np.argsort(distance)
        cumulative = np.cumsum(area[order]) / area.sum()
        median, p90 = (distance[order][np.searchsorted(cumulative, q)] for q in (0.5, 0.9))
        mean = np.average(distance, weights=area)
        print(f"fit: {count:3d} components  mean {mean:.3f}  median {median:.3f}  p90 {p90:.3f} mm")


def fit_identity(
    template: Template, cloud: np.ndarray, marks: np.ndarray, count: int, area: np.ndarray, rounds: int = 25
) -> np.ndarray:
    """(k,) distances of the cloud (k, 3) to the fitted head: argmin over similarity and a of point-to-plane distances
    + landmarks + damping |a|^2, closest points renewed each round."""
    skin = template.triangles[template.parts["skin"].triangles].astype(np.int64)
    outer = ~(template.regions["mouth"] | template.regions["sockets"])[skin].any(axis=1)
    skin = skin[outer]
    own = template.landmarks(template.mean)[template.landmarks68]
    scale, r, t = similarity(own[17:], marks[17:])
    a = np.zeros(count)
    share = area / area.sum()
    for _ in range(rounds):
        head = template.neutral(a)
        placed = scale * head @ r.T + t
        square, row, closest = igl.point_mesh_squared_distance(cloud, placed, skin)[:3]
        corners = skin[row]
        bary = igl.barycentric_coordinates(closest, *(np.ascontiguousarray(placed[corners[:, k]]) for k in range(3)))
        normal = np.cross(placed[corners[:, 1]] - placed[corners[:, 0]], placed[corners[:, 2]] - placed[corners[:, 0]])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        # far away pairs are wrong pairs: Cauchy weights
        root = np.sqrt(share / (1 + square / 9.0))
        offset = closest - t
        columns = [np.cross(offset, normal), normal, (offset * normal).sum(axis=1)[:, None]]
        if count:
            basis = np.einsum("cj,kcjx->kcx", bary, template.identity[:count][:, corners])
            columns.append(np.einsum("kcx,cx->ck", scale * basis @ r.T, normal))
        system = np.concatenate(columns, axis=1) * root[:, None]
        side = root * ((cloud - closest) * normal).sum(axis=1)
        damp = np.zeros((count, system.shape[1]))
        damp[:, 7:] = np.eye(count) * np.sqrt(DAMPING / 100)
        x = np.linalg.lstsq(np.concatenate([system, damp]), np.concatenate([side, -np.sqrt(DAMPING / 100) * a]))[0]
        r = rotation(x[:3]) @ r
        t = t + x[3:6]
        scale *= 1 + x[6]
        a = a + x[7:]
    placed = scale * template.neutral(a) @ r.T + t
    return np.sqrt(igl.point_mesh_squared_distance(cloud, placed, skin)[0])


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """argmin sum |s R x + t - y|^2. Source: Umeyama 1991."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    r = u @ sign @ vt
    scale = float((d * np.diag(sign)).sum() / (a * a).sum())
    return scale, r, target.mean(axis=0) - scale * r @ source.mean(axis=0)


def rotation(turn: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.Rodrigues(turn.astype(float))[0]


def uv(template: Template) -> None:
    """Texels per millimetre of the skin's chart at 4096, flips, overlapping texels of the whole map."""
    from avatarbuild.geometry.raster import rasterise

    t, ut = template.triangles, template.uv_triangles
    corners, flat = template.mean[t], template.uv[ut] * 4096
    e, f = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    signed = (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]) / 2
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    face = template.regions["face"][t].all(axis=1)
    density = np.sqrt(np.abs(signed) / np.maximum(area, 1e-12))
    order = np.argsort(density[face])
    cumulative = np.cumsum(area[face][order]) / area[face].sum()
    figures = [density[face][order][np.searchsorted(cumulative, q)] for q in (0.05, 0.5, 0.95)]
    print("uv: face px/mm at 4096 at 5, 50, 95 %:", " ".join(f"{figure:.2f}" for figure in figures))
    print(f"uv: flipped triangles {int((signed <= 0).sum())} of {len(signed)}")
    print(f"uv: overlapping pixels at 4096: {overlap(template.uv * 4096, ut, 4096)}")
    drawn = rasterise(template.uv * 4096, np.ones(len(template.uv)), ut, (4096, 4096)).triangle
    print(f"uv: map covered {(drawn >= 0).mean():.3f}")


def overlap(pixels: np.ndarray, triangles: np.ndarray, size: int) -> int:
    """Pixels whose centre lies strictly inside more than one triangle."""
    import numba

    @numba.njit
    def count(p: np.ndarray, faces: np.ndarray, n: int) -> np.ndarray:
        hits = np.zeros((n, n), np.uint8)
        for i in range(len(faces)):
            a, b, c = p[faces[i, 0]], p[faces[i, 1]], p[faces[i, 2]]
            double = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            if abs(double) < 1e-12:
                continue
            x0, x1 = int(min(a[0], b[0], c[0])), int(max(a[0], b[0], c[0])) + 1
            y0, y1 = int(min(a[1], b[1], c[1])), int(max(a[1], b[1], c[1])) + 1
            for y in range(max(y0, 0), min(y1, n)):
                for x in range(max(x0, 0), min(x1, n)):
                    u, v = x + 0.5, y + 0.5
                    w0 = ((b[0] - u) * (c[1] - v) - (b[1] - v) * (c[0] - u)) / double
                    w1 = ((c[0] - u) * (a[1] - v) - (c[1] - v) * (a[0] - u)) / double
                    if w0 > 1e-7 and w1 > 1e-7 and 1 - w0 - w1 > 1e-7:
                        hits[y, x] += 1
        return hits

    return int((count(pixels, triangles.astype(np.int64), size) > 1).sum())


def indices(template: Template, count: int = 300) -> None:
    """
    How much the proportions of faces vary among random heads, in percent of their means, and among people.

    Sources, each group that was told apart (PUBLISHED): Gordon et al. 2014, 2012 anthropometric survey of U.S. Army
    personnel, 6068 men and women (bizygomatic breadth 139.7 ± 7.3, menton-sellion length 119.5 ± 7.9, interpupillary
    breadth 63.3 ± 3.65 mm, correlations 0.46, 0.52, 0.31, as others have computed them from its public tables: a
    ratio's variance is c_1^2 + c_2^2 - 2 r c_1 c_2 of the relative deviations c). Wai et al. 2015, Nasofacial
    anthropometric study among university students of three races in Malaysia, 200. KC et al., Nasal parameters and
    facial index in medical undergraduates, Journal of Lumbini Medical College, 156 men and women.
    """
    own = {}
    for spread in SPREADS:
        marks = np.stack([template.landmarks(template.neutral(spread * a)) for a in random_heads(template, count)])
        for name, (one, two) in PROPORTIONS.items():
            part, whole = (np.linalg.norm(marks[:, pair[0]] - marks[:, pair[1]], axis=1) for pair in (one, two))
            own[name, spread] = 100 * np.std(part / whole) / np.mean(part / whole)
        found = (f"{name} {own[name, spread]:.1f} %" for name in PROPORTIONS)
        print(f"indices, spread {spread}: {'; '.join(found)}")
    factors = []
    for name, studies in PUBLISHED.items():
        told = "; ".join(f"{study} {', '.join(str(value) for value in values)} %" for study, values in studies.items())
        factors.append(np.mean([np.mean(values) for values in studies.values()]) / own[name, 1.0])
        print(f"indices, people: {name}: {told}; their mean is {factors[-1]:.2f} of the heads' at spread 1")
    print(f"indices, people: mean of the {len(factors)}: {np.mean(factors):.2f}")


def visible_eye(template: Template, vertices: np.ndarray, centre: np.ndarray, width: int = 900) -> int:
    """Pixels of either eyeball in a frontal picture `width` pixels over 110 mm."""
    view = sketch.View(size=(width, width // 2), height=55.0, centre=tuple(centre), distance=1200.0)
    seen, _, _ = sketch.look(vertices, template.triangles, view)
    balls = [template.parts[name].triangles for name in EYE_PARTS]
    return int(sum(((seen.triangle >= b.start) & (seen.triangle < b.stop)).sum() for b in balls))


def blink(template: Template) -> None:
    """Visible eyeball pixels when the lids close."""
    table = {amount: [] for amount in (0.0, 0.5, 0.75, 0.9, 1.0)}
    for a in random_heads(template):
        neutral, eyes = template.neutral(a), template.eye_positions(a)
        for amount, found in table.items():
            posed = template.pose(neutral, weights(eyeBlink=amount), eyes)
            found.append(visible_eye(template, posed, eyes.mean(axis=0)))
    for amount, found in table.items():
        print(
            f"blink {amount:4.2f}: eyeball pixels mean {np.mean(found):8.1f}, most {max(found)}, heads with any "
            f"{int((np.array(found) > 0).sum())} of {len(found)}"
        )


def lids(template: Template) -> None:
    """Gap at the contact line and poke-through of the lids' outer skin, against the eyeball with its cornea."""
    import lids as builder

    skin = template.parts["skin"]
    tri = template.triangles[skin.triangles]
    mean = template.mean[skin.vertices]
    sockets = template.regions["sockets"][skin.vertices]
    left = sockets[tri].all(axis=1) & (mean[tri][..., 0].mean(axis=1) > 0)
    band = builder.lid_band(mean, tri, left)
    heads = random_heads(template)
    for amount in (0.0, 0.25, 0.5, 0.75, 1.0):
        gaps, pokes = [], []
        for a in heads:
            eyes = template.eye_positions(a)
            posed = template.pose(template.neutral(a), weights(eyeBlink=amount), eyes)[skin.vertices]
            for side, points in ((0, posed), (1, posed[template.symmetry[skin.vertices]])):
                offset = points - eyes[side]
                r = np.linalg.norm(offset, axis=1)
                clear = r - eyeball_radius(np.arccos(np.clip(offset[:, 2] / r, -1, 1)))
                gaps.append(clear[band.contact])
                outer = (band.ring >= builder.CREST - 1) & (band.ring < builder.FREE) & (offset[:, 2] > 0)
                pokes.append(np.maximum(0, -clear[outer]))
        gap, poke = np.concatenate(gaps), np.concatenate(pokes)
        print(
            f"lids, blink {amount:4.2f}: contact line off the eyeball, 99 % |d| {np.percentile(np.abs(gap), 99):.3f} "
            f"(1 % {np.percentile(gap, 1):+.2f}, 99 % {np.percentile(gap, 99):+.2f}); poke-through 99 % "
            f"{np.percentile(poke, 99):.3f}, most {poke.max():.2f} mm"
        )


def landmarks(template: Template, picture: Path | None = None) -> None:
    """The detector on renderings of random heads against the mapped points, in outer eye distances.

    At SPREADS. Sliding points stand for the outline of the face and wander over the skin with the view, so that no
    point of the skin is theirs: they are measured both from the mapped point and, as a fit uses them, from the nearest
    point of the curve through the mapped ones.
    """
    for spread in SPREADS:
        points, curves = _landmark_errors(template, spread, picture if spread == 1.0 else None)
        fixed = ~template.landmark_sliding
        inner = template.landmarks68[17:]
        slid = np.where(template.landmark_sliding, curves, points)
        print(
            f"landmarks, spread {spread}: {len(points)} of {HEADS} heads found; visible points, mean error "
            f"{100 * np.nanmean(points):.2f} % of the outer eye distance (median {100 * np.nanmedian(points):.2f}); "
            f"the outline measured across itself {100 * np.nanmean(slid):.2f} %; without it "
            f"{100 * np.nanmean(points[:, fixed]):.2f} %; the 51 inner {100 * np.nanmean(points[:, inner]):.2f} %; "
            f"irises {100 * np.nanmean(points[:, 468:]):.2f} %"
        )
        each = 100 * np.nanmean(points, axis=0)
        print("landmarks: worst fixed", ", ".join(f"{i} {each[i]:.1f}" for i in np.argsort(-each * fixed)[:10]))


def _landmark_errors(template: Template, spread: float, picture: Path | None) -> tuple[np.ndarray, np.ndarray]:
    """(heads, 478) distances from the mapped points and from the outline's curve, NaN where hidden."""
    import cv2
    from landmarks import OVAL

    from avatarbuild.landmarks import find_faces

    colours = sketch.paint(template)
    rng = np.random.default_rng(SEED)
    errors, curves, shown = [], [], []
    for i, a in enumerate(spread * random_heads(template)):
        view = sketch.View(yaw=rng.uniform(-45, 45), pitch=rng.uniform(-8, 8), size=(512, 560))
        vertices = template.neutral(a)
        image = sketch.draw(vertices, template.triangles, colours, view)
        faces = find_faces(image)
        if not faces:
            continue
        points = template.landmarks(vertices)
        k, r, t = sketch.pinhole(view)
        camera = points @ r.T + t
        pixels = camera[:, :2] / camera[:, 2:] * k[0, 0] + k[:2, 2]
        seen, _, _ = sketch.look(vertices, template.triangles, view)
        depth = seen.depth[np.clip(pixels[:, 1].astype(int), 0, 559), np.clip(pixels[:, 0].astype(int), 0, 511)]
        front = camera[:, 2] < depth + 4
        found = faces[0].points[:, :2]
        outer = np.linalg.norm(points[33] - points[263]) * k[0, 0] / camera[[33, 263], 2].mean()
        errors.append(np.where(front, np.linalg.norm(found - pixels, axis=1) / outer, np.nan))
        ring = pixels[list(OVAL)]
        curves.append(np.where(front, _to_polygon(found, ring) / outer, np.nan))
        if picture is not None and i < 8:
            for (x, y), (u, v), ok in zip(found, pixels, front, strict=True):
                if ok:
                    cv2.circle(image, (round(x * 16), round(y * 16)), 24, (0, 200, 0), -1, cv2.LINE_AA, 4)
                    cv2.circle(image, (round(u * 16), round(v * 16)), 24, (220, 0, 0), -1, cv2.LINE_AA, 4)
            shown.append(image)
    if picture is not None:
        cv2.imwrite(str(picture), sketch.sheet(shown, 4)[..., ::-1])
    return np.array(errors), np.array(curves)


def _to_polygon(points: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """(k,) distances of points (k, 2) from a closed polygon (l, 2)."""
    start, along = ring, np.roll(ring, -1, axis=0) - ring
    offset = points[:, None] - start
    share = np.clip((offset * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12), 0, 1)
    return np.linalg.norm(offset - share[..., None] * along, axis=2).min(axis=1)


def mouth(template: Template, spread: float = 1.0) -> None:
    """How far teeth, gums and tongue, and the mouth's inside, stand before lips and cheeks, seen from outside; random
    heads of `spread` times the components' standard deviations."""
    import scipy.sparse as sp

    from avatarbuild.energies.tooth_cover import mouth_of

    skin = template.triangles[template.parts["skin"].triangles].astype(np.int64)
    count = template.parts["skin"].vertices.stop
    edges = np.concatenate([skin[:, [0, 1]], skin[:, [1, 2]], skin[:, [2, 0]]])
    graph = sp.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count)).tocsr()
    graph = ((graph + graph.T) > 0).astype(float).tocsr()
    teeth = np.concatenate(
        [template.triangles[template.parts[name].triangles] for name in ("teeth_upper", "teeth_lower")]
    )
    inner = np.concatenate([template.triangles[template.parts[name].triangles] for name in ("gums", "tongue")])
    regions = template.regions
    cover = {
        name: mouth_of(template.mean, skin, graph, regions["mouth"], regions["face"], part)
        for name, part in (("teeth", teeth), ("gums and tongue", inner))
    }
    poses = {"neutral": weights()}
    for name in ARKIT_NAMES:
        poses[name] = weights(**{name: 1.0})
    poses["mouthClose"] = weights(mouthClose=1.0, jawOpen=1.0)
    poses["tongueOut"] = weights(tongueOut=1.0, jawOpen=0.5)
    poses["smile, jaw a little open"] = weights(mouthSmile=0.8, jawOpen=0.3)
    poses["teeth bared"] = weights(mouthUpperUp=1.0, mouthLowerDown=1.0)
    poses["both presses"] = weights(mouthPress=1.0)
    poses["pucker and funnel"] = weights(mouthPucker=0.5, mouthFunnel=0.5)
    heads = [template.neutral(spread * a) for a in random_heads(template)]
    found = {}
    for pose, w in poses.items():
        posed = [template.pose(head, w) for head in heads]
        found[pose] = {name: np.array([m.teeth_out(head).max() for head in posed]) for name, m in cover.items()}
        found[pose]["inside"] = np.array([cover["teeth"].bag_out(head).max() for head in posed])
    for kind in ("teeth", "gums and tongue", "inside"):
        table = {pose: row[kind] for pose, row in found.items()}
        every = np.concatenate([row for pose, row in table.items() if pose != "tongueOut"])
        print(
            f"mouth, {kind} before the skin: {100 * (every > 0.1).mean():.2f} % of {len(every)} posed heads by more "
            f"than 0.1 mm, {100 * (every > 1).mean():.1f} % by more than 1 mm, most {every.max():.1f} mm"
        )
        worst = sorted(table, key=lambda pose: -(table[pose] > 0.5).mean())[:8]
        print("mouth, heads with more than 0.5 mm:", "; ".join(f"{p} {int((table[p] > 0.5).sum())}" for p in worst))


def corners(template: Template) -> None:
    """How the mouth's left corner's distance from the dental arch changes on its way: the mean head, and 24 others."""
    import depth

    names = ("teeth_upper", "teeth_lower", "gums")
    faces = np.concatenate([template.triangles[template.parts[name].triangles] for name in names])
    corner = template.contours["lips_inner_upper"][-1:]
    heads = [template.mean, *(template.neutral(a) for a in random_heads(template, 24))]
    arches = [depth.arch(head, faces, head[template.parts["teeth_upper"].vertices]) for head in heads]
    rest = [teeth.distance(head[corner])[0][0] for teeth, head in zip(arches, heads, strict=True)]
    for name in (*depth.SLIDING, "mouthLeft", "mouthRight", "mouthPucker", "mouthFunnel"):
        table = []
        for amount in (0.25, 0.5, 0.75, 1.0):
            w = weights(**{name: amount})
            table.append(
                [
                    teeth.distance(template.pose(head, w)[corner])[0][0] - start
                    for teeth, head, start in zip(arches, heads, rest, strict=True)
                ]
            )
        change = np.array(table)
        print(
            f"corners, {name:13s}: mean head {' '.join(f'{c:+.1f}' for c in change[:, 0])} mm at 0.25, 0.5, 0.75, 1; "
            f"24 heads at 1 {change[-1, 1:].mean():+.1f} ± {change[-1, 1:].std():.1f}"
        )


def speed(template: Template) -> None:
    """Milliseconds of one evaluation, the fastest of many (others use the machine too)."""
    rng = np.random.default_rng(0)
    a, w = rng.standard_normal(len(template.identity)), rng.random(52)
    neutral, eyes = template.neutral(a), template.eye_positions(a)
    for name, run in (
        ("52 expressions on a given identity", lambda: template.pose(neutral, w, eyes)),
        ("identity and 52 expressions", lambda: template.evaluate(a, w)),
    ):
        run()
        times = []
        for _ in range(60):
            start = time.perf_counter()
            run()
            times.append(time.perf_counter() - start)
        print(
            f"speed: {name}: best {1e3 * min(times):.2f} ms, median {1e3 * np.median(times):.2f} ms, "
            f"{template.vertex_count} vertices"
        )


def rebuild(wheel: Path | None) -> None:
    """Build twice and compare the bytes with each other and with the shipped file."""
    digests = []
    for _ in range(2):
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, str(ROOT / "templates" / "head" / "build.py"), "--out", folder]
            subprocess.run(command + (["--wheel", str(wheel)] if wheel else []), check=True)
            digests.append(hashlib.sha256((Path(folder) / "head.npz").read_bytes()).hexdigest())
    shipped = hashlib.sha256((template_folder() / "head.npz").read_bytes()).hexdigest()
    print(f"rebuild: twice the same {digests[0] == digests[1]}; the shipped file {digests[0] == shipped}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    runs = {"fit": fit, "uv": uv, "blink": blink, "lids": lids, "indices": indices, "landmarks": landmarks}
    runs |= {"mouth": mouth, "corners": corners, "speed": speed}
    parser.add_argument("what", nargs="*", help=", ".join([*runs, "rebuild"]))
    parser.add_argument("--template", type=Path, help="a template file; the shipped head by default")
    parser.add_argument("--spread", type=float, default=1.0, help="for mouth: of the heads, in standard deviations")
    parser.add_argument("--wheel", type=Path, help="for rebuild: the source wheel")
    parser.add_argument("--picture", type=Path, help="for landmarks: where to draw them")
    options = parser.parse_args()
    template = Template.load(options.template)
    print(f"{template.name} {template.version}: {template.vertex_count} vertices, {len(template.triangles)} triangles")
    for name in options.what or runs:
        if name == "rebuild":
            rebuild(options.wheel)
        elif name == "landmarks":
            landmarks(template, options.picture)
        elif name == "mouth":
            mouth(template, options.spread)
        else:
            runs[name](template)


if __name__ == "__main__":
    main()

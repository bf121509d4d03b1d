"""The shipped head against its promises, and the builder's pieces by hand."""

import sys
from pathlib import Path

import igl
import numpy as np
import pytest

from avatarbuild.template import ARKIT_NAMES, EYE_PARTS, PART_NAMES, Template, template_folder
from avatarbuild.template import expression_weights as weights

FOLDER = Path(__file__).resolve().parents[1] / "templates" / "head"


@pytest.fixture(scope="module")
def head() -> Template:
    return Template.load()


@pytest.fixture(scope="module")
def builder():
    """The builder's modules, importable for this file only."""
    sys.path.insert(0, str(FOLDER))
    import depth
    import expressions
    import identity
    import lids
    import lips
    import subdivide
    import unwrap

    yield {m.__name__: m for m in (depth, expressions, identity, lids, lips, subdivide, unwrap)}
    sys.path.remove(str(FOLDER))


def heads(template: Template, count: int = 20) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((count, len(template.identity)))


def test_size_and_parts(head):
    assert tuple(head.parts) == PART_NAMES
    skin = head.parts["skin"].vertices
    assert 10_000 <= skin.stop <= 12_000
    assert head.identity.shape[0] == 100
    assert len(head.feature_edges) >= 44
    assert len(head.quads) > 4000
    folder = template_folder()
    assert sum(file.stat().st_size for file in folder.iterdir() if file.suffix != ".py" and file.is_file()) < 6_000_000
    assert "CC0" in (folder / "LICENSE").read_text()
    assert "Mika Suominen" in (folder / "NOTICE").read_text()


def test_proportions_vary_as_among_people(head):
    """Relative deviations as published; the sources stand in benchmarks/template.py."""
    marks = np.stack([head.landmarks(head.neutral(a)) for a in heads(head, 300)])
    size = {
        name: np.linalg.norm(marks[:, i] - marks[:, j], axis=1)
        for name, i, j in (
            *(("face width", 234, 454), ("face height", 168, 152), ("nose width", 129, 358), ("nose height", 168, 2)),
            ("pupils", 468, 473),
        )
    }
    for part, whole, people in (
        ("face height", "face width", 0.077),
        ("nose width", "nose height", 0.102),
        ("pupils", "face width", 0.054),
        ("pupils", "face height", 0.073),
    ):
        ratio = size[part] / size[whole]
        assert 0.85 < ratio.std() / ratio.mean() / people < 1.15, (part, whole)


def test_scaled_to_people_it_is_the_same_linear_head(head, builder):
    identity = builder["identity"]
    scaled = identity.as_people_vary(head)
    for a in heads(head, 2):
        b = identity.PEOPLE * a
        np.testing.assert_allclose(scaled.neutral(a), head.neutral(b), atol=1e-9)
        np.testing.assert_allclose(scaled.eye_positions(a), head.eye_positions(b), atol=1e-9)
    moved = np.sqrt((scaled.identity**2).sum(axis=2).mean(axis=1))
    np.testing.assert_allclose(scaled.sigma, moved, rtol=1e-2)


def test_frame_is_about_the_eyeballs(head):
    np.testing.assert_allclose(head.eye_centres.mean(axis=0), 0, atol=1e-4)
    assert head.eye_centres[0, 0] > 25
    for name, centre in zip(EYE_PARTS, head.eye_centres, strict=True):
        ball = head.mean[head.parts[name].vertices] - centre
        radius = np.linalg.norm(ball, axis=1)
        back = ball[:, 2] < 0
        np.testing.assert_allclose(radius[back], 12, atol=0.02)
        assert 12.5 < radius.max() < 13.5


def test_mirror_images(head):
    flip = np.array([-1, 1, 1])
    assert (head.symmetry[head.symmetry] == np.arange(head.vertex_count)).all()
    np.testing.assert_allclose(head.mean[head.symmetry] * flip, head.mean, atol=2e-3)
    for name in ARKIT_NAMES:
        if name.endswith("Left"):
            other = head.expressions[ARKIT_NAMES.index(name[:-4] + "Right")]
            one = head.expressions[ARKIT_NAMES.index(name)]
            np.testing.assert_allclose(one[head.symmetry] * flip, other, atol=0.06)


def test_eyeballs_are_rigid_and_follow_their_centres(head):
    for a in heads(head, 3):
        vertices, centres = head.neutral(a), head.eye_positions(a)
        for name, centre, rest in zip(EYE_PARTS, centres, head.eye_centres, strict=True):
            rows = head.parts[name].vertices
            np.testing.assert_allclose(vertices[rows] - centre, head.mean[rows] - rest, atol=0.06)
    assert (np.abs(head.expressions[:, head.parts["eye_left"].vertices]) < 1e-9).all()


def test_gaze_turns_the_iris_where_the_name_says(head):
    rest = head.landmarks(head.mean)
    for name, index, axis, sign in (
        ("eyeLookUpLeft", 473, 1, 1),
        ("eyeLookDownRight", 468, 1, -1),
        ("eyeLookOutLeft", 473, 0, 1),
        ("eyeLookOutRight", 468, 0, -1),
        ("eyeLookInLeft", 473, 0, -1),
    ):
        moved = head.landmarks(head.evaluate(None, weights(**{name: 1.0}))) - rest
        assert sign * moved[index, axis] > 4, name


def test_lids_lie_on_the_eyeballs(head, builder):
    """Three promises: contact line within 0.3 mm for 99 %, skin outside the eye, blink passes the lower lid."""
    lids = builder["lids"]
    skin = head.parts["skin"]
    sockets = head.regions["sockets"][skin.vertices]
    triangles, mean = head.triangles[skin.triangles], head.mean[skin.vertices]
    left = sockets[triangles].all(axis=1) & (mean[triangles][..., 0].mean(axis=1) > 0)
    band = lids.lid_band(mean, triangles, left)
    off, poke = [], []
    for a in heads(head, 40):
        vertices, centre = head.neutral(a), head.eye_positions(a)[0]
        r, _, radius = lids.surface(vertices[skin.vertices], centre)
        off.append((r - radius)[band.contact])
        poke.append((r - radius)[(band.ring >= lids.CREST - 1) & (band.ring < 16)])
    assert np.percentile(np.abs(off), 99) < 0.3
    assert np.percentile(poke, 0.1) > -0.3


def test_closed_lids_bulge_as_a_dome(head):
    """No hollow beside the middle of the closed upper lid, which would fold the line of the lids to a V."""
    lid = head.contours["lid_upper_left"]
    posed = head.pose(head.mean, weights(eyeBlink=1.0))[lid] - head.eye_centres[0]
    x = np.linspace(-7, 8, 7)
    order = np.argsort(posed[:, 0])
    depth = np.interp(x, posed[order, 0], posed[order, 2])
    assert (np.diff(depth, 2) < 0.1).all()


def test_lips_and_cheeks_are_as_thick_on_everybody(head):
    inside = np.flatnonzero(head.regions["mouth"] & ~head.regions["face"])
    skin = head.triangles[head.parts["skin"].triangles].astype(np.int64)
    outer = skin[~head.regions["mouth"][skin].all(axis=1)]
    wall = np.sqrt(igl.point_mesh_squared_distance(head.mean[inside], head.mean, outer)[0])
    thin = (wall > 3) & (wall < 8)
    assert thin.sum() > 50
    share = []
    for a in heads(head):
        vertices = head.neutral(a)
        share.append(np.sqrt(igl.point_mesh_squared_distance(vertices[inside[thin]], vertices, outer)[0]) / wall[thin])
    assert np.std(share, axis=0).mean() < 0.12


def test_corners_of_the_mouth_slide_round_the_teeth(head, builder):
    names = ("teeth_upper", "teeth_lower", "gums")
    faces = np.concatenate([head.triangles[head.parts[name].triangles] for name in names])
    teeth = builder["depth"].arch(head.mean, faces, head.mean[head.parts["teeth_upper"].vertices])
    corner = head.contours["lips_inner_upper"][[0, -1]]
    rest = teeth.distance(head.mean[corner])[0]
    for name in builder["depth"].SLIDING:
        for weight in (0.5, 1.0):
            moved = head.pose(head.mean, weights(**{name: weight}))[corner]
            assert np.abs(teeth.distance(moved)[0] - rest).max() < 1.3, name
        assert np.abs(teeth.distance(moved)[0] - rest).max() < 0.5, name


def test_distance_from_an_arch_by_hand(builder):
    square = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1], [0, 2, 0]])
    teeth = builder["depth"].arch(square, np.array([[0, 1, 2], [0, 2, 3]]), square[:4])
    away, forward = teeth.distance(np.array([[0, 0, 3.0], [4, 0, 0], [0, 3, 5]]))
    np.testing.assert_allclose(away, [2, 3, (5 + 4) / 2], atol=1e-6)
    np.testing.assert_allclose(forward, [1, 0, 1], atol=1e-6)


def test_lips_are_sealed_in_neutral_and_when_the_jaw_opens_with_mouth_close(head):
    upper, lower = head.contours["lips_inner_upper"], head.contours["lips_inner_lower"]
    for a in (np.zeros(100), *heads(head, 5)):
        for w in (weights(), weights(jawOpen=1.0, mouthClose=1.0), weights(mouthPressLeft=1.0)):
            vertices = head.evaluate(a, w)
            x = vertices[lower, 0]
            rising = np.maximum.accumulate(vertices[upper, 0])
            gap = np.interp(x, rising, vertices[upper, 1]) - vertices[lower, 1]
            assert np.median(gap) < 1.0
    opened = head.evaluate(None, weights(jawOpen=1.0))
    assert opened[upper, 1].mean() - opened[lower, 1].mean() > 10


def test_jaw_moves_the_lower_teeth_only_and_not_the_neck(head):
    jaw = head.expressions[ARKIT_NAMES.index("jawOpen")]
    assert np.abs(jaw[head.parts["teeth_upper"].vertices]).max() == 0
    assert np.linalg.norm(jaw[head.parts["teeth_lower"].vertices], axis=1).mean() > 10
    rim = head.mean[:, 1] < np.quantile(head.mean[head.regions["neck"], 1], 0.3)
    assert np.abs(jaw[rim & head.regions["neck"]]).max() < 0.05


def test_texture_has_no_flips_and_enough_texels(head):
    corners, flat = head.mean[head.triangles], head.uv[head.uv_triangles] * 4096
    e, f = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    signed = (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]) / 2
    assert (signed > 0).all()
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    face = head.regions["face"][head.triangles].all(axis=1)
    order = np.argsort(signed[face] / area[face])
    middle = np.searchsorted(np.cumsum(area[face][order]), area[face].sum() / 2)
    assert np.sqrt((signed[face] / area[face])[order][middle]) >= 10
    inside = head.chart_distance[(1023 - head.uv[:, 1] * 1023).astype(int), (head.uv[:, 0] * 1023).astype(int)]
    assert inside.max() > 50


def test_landmarks_lie_where_their_names_say(head):
    points = head.landmarks(head.mean)
    assert points[1, 2] == points[:468, 2].max() or points[4, 2] == points[:468, 2].max()
    assert points[33, 0] < points[133, 0] < 0 < points[362, 0] < points[263, 0]
    assert points[152, 1] < points[17, 1] < points[0, 1] < points[1, 1] < points[10, 1]
    np.testing.assert_allclose(points[[468, 473]], head.eye_centres[[1, 0]] + [[0, 0, 11.5]], atol=3)
    assert head.landmark_sliding[[152, 234, 454, 10]].all()
    assert not head.landmark_sliding[[1, 33, 263, 61, 291]].any()


def test_regions_are_apart_and_symmetric(head):
    for name, mask in head.regions.items():
        assert mask.any(), name
        assert (mask[head.symmetry] == mask).all(), name
    assert not (head.regions["face"] & head.regions["scalp"]).any()
    assert not (head.regions["ears"] & head.regions["face"]).any()


def test_catmull_clark_of_a_cube_and_partial_refinement(builder):
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    refine = builder["subdivide"].refine
    whole = refine(quads, np.ones(6, bool), cube)
    assert whole.matrix.shape == (8 + 12 + 6, 8)
    points = whole.matrix @ cube
    # by hand: corner = (F + 2 R + 0 P) / 3 with F = 1/3, R = 2/3 in each axis
    np.testing.assert_allclose(np.abs(points[:8]), 5 / 9)
    np.testing.assert_allclose(np.sort(np.abs(points[8]))[::-1], [0.75, 0.75, 0], atol=1e-12)
    some = refine(quads, np.arange(6) == 0, cube)
    assert some.matrix.shape[0] == 8 + 4 + 1
    np.testing.assert_allclose(np.asarray(some.matrix.sum(axis=1)), 1)
    half = np.sort(some.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(half, axis=0, return_counts=True)[1] == 2).all()


def test_flattening_a_flat_grid_is_an_isometry(builder):
    side = np.arange(6.0)
    grid = np.stack([*np.meshgrid(side, side), np.zeros((6, 6))], axis=-1).reshape(-1, 3)
    i = (np.arange(5)[:, None] * 6 + np.arange(5)).ravel()
    triangles = np.concatenate([np.stack([i, i + 1, i + 7], 1), np.stack([i, i + 7, i + 6], 1)])
    flat = builder["unwrap"].flatten(grid, triangles, np.ones(len(triangles)))
    apart = np.linalg.norm(flat[:, None] - flat[None], axis=2)
    np.testing.assert_allclose(apart, np.linalg.norm(grid[:, None] - grid[None], axis=2), atol=0.05)


def test_modes_recover_known_symmetric_and_antisymmetric_motion(builder):
    rng = np.random.default_rng(0)
    base = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 2, 0]])
    mirror = np.array([1, 0, 2])
    up = np.array([[0, 1.0, 0], [0, 1, 0], [0, 0, 0]])
    aside = np.array([[0.5, 0, 0], [0.5, 0, 0], [0, 0, 0]])
    draws = rng.standard_normal((500, 2))
    cloud = base + draws[:, :1, None] * up + draws[:, 1:, None] * aside
    mean, found = builder["identity"].modes(cloud, np.ones(3), mirror, 2)
    np.testing.assert_allclose(mean, base, atol=0.12)
    np.testing.assert_allclose(np.abs(found[0]), up, atol=0.12)
    np.testing.assert_allclose(np.abs(found[1]), aside, atol=0.12)


def test_nostrils_are_hollow(head):
    """From 6 to 9 mm below the rim a way up and back through each nostril is free for 17 mm, with flesh at its end."""
    skin = head.parts["skin"]
    triangles = head.triangles[skin.triangles].astype(np.int64)
    tip = head.landmarks(head.mean)[4]
    way = np.array([0.0, 0.8, -0.6])
    for side in (1, -1):
        start = tip + (8.5 * side, -16.0, -6.0)
        through = crossings(start, way, head.mean, triangles)
        assert through[0] > 17
        assert through[1] - through[0] > 3


def crossings(start: np.ndarray, way: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Distances, rising, at which a ray crosses triangles [Moeller & Trumbore 1997]."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal = np.cross(way, c - a)
    size = np.einsum("nx,nx->n", b - a, normal)
    off = start - a
    u = np.einsum("nx,nx->n", off, normal) / size
    q = np.cross(off, b - a)
    v = q @ way / size
    t = np.einsum("nx,nx->n", c - a, q) / size
    return np.sort(t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)])

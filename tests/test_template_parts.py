import numpy as np
import pytest

from templates.head.parts import (
    colours,
    crowns,
    eyeball,
    eyeball_radius,
    fit_rigid,
    gums,
    jaw_opening,
    teeth,
    tongue,
)
from templates.head.parts.part import signed_areas

PARTS = {
    "eye": eyeball(),
    "teeth_upper": teeth("upper"),
    "teeth_lower": teeth("lower"),
    "gums": gums(),
    "tongue": tongue(),
}
WIDE = {
    "teeth_upper": teeth("upper", 65.0, 48.0),
    "teeth_lower": teeth("lower", 48.0, 38.0),
    "gums": gums((65.0, 48.0), (48.0, 38.0)),
    "tongue": tongue(48.0, 38.0),
}
EVERY = [*PARTS.values(), *WIDE.values()]


def normals(part, vertices=None):
    v, t = part.vertices if vertices is None else vertices, part.triangles
    return 0.5 * np.cross(v[t[:, 1]] - v[t[:, 0]], v[t[:, 2]] - v[t[:, 0]])


def border_edges(triangles):
    """Directed edges without their opposite; raises when one directed edge occurs twice."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    directed = {tuple(e) for e in edges.tolist()}
    assert len(directed) == len(edges)
    return np.array([e for e in directed if e[::-1] not in directed]).reshape(-1, 2)


def volume(part, vertices=None):
    v = part.vertices if vertices is None else vertices
    return float(np.einsum("ij,ij->", normals(part, v), v[part.triangles].mean(1)) / 3)


def covered_twice(part, resolution):
    """Texel centres strictly inside more than one triangle of the chart."""
    count = np.zeros((resolution, resolution), int)
    for a, b, c in part.uv[part.uv_triangles] * resolution:
        low = np.floor(np.min([a, b, c], 0) - 0.5).astype(int)
        high = np.ceil(np.max([a, b, c], 0)).astype(int) + 1
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        sides = [(q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in ((a, b), (b, c), (c, a))]
        inside = np.min(sides, 0) > 1e-7
        count[y[inside].astype(int), x[inside].astype(int)] += 1
    return int((count > 1).sum())


@pytest.mark.parametrize("part", EVERY, ids=lambda p: p.name)
def test_meshes_are_sound_and_mirror_symmetric(part):
    n = len(part.vertices)
    assert sorted(np.unique(part.triangles)) == list(range(n))
    assert np.linalg.norm(normals(part), axis=1).min() > 0.03
    np.testing.assert_array_equal(part.vertices[part.mirror] * [-1, 1, 1], part.vertices)
    np.testing.assert_array_equal(part.mirror[part.mirror], np.arange(n))
    mirrored = {tuple(np.roll(t, -t.argmin())) for t in part.mirror[part.triangles][:, ::-1]}
    assert mirrored == {tuple(np.roll(t, -t.argmin())) for t in part.triangles}
    for delta in part.deltas.values():
        np.testing.assert_array_equal(delta[part.mirror] * [-1, 1, 1], delta)
    assert all(len(f) == n for f in part.fields.values())
    border_edges(part.triangles)


@pytest.mark.parametrize("part", EVERY, ids=lambda p: p.name)
def test_texture_has_no_flips_and_lies_in_the_square(part):
    assert part.uv.min() >= 0
    assert part.uv.max() <= 1
    assert signed_areas(part.uv, part.uv_triangles).min() > 1e-7
    # a texture edge joins what a mesh edge joins
    corners = np.full(len(part.uv), -1)
    corners[part.uv_triangles.ravel()] = part.triangles.ravel()
    np.testing.assert_array_equal(corners[part.uv_triangles], part.triangles)


@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS.keys())
def test_texture_has_no_overlap_and_an_even_density(part):
    assert covered_twice(part, 1024) == 0
    density = np.sqrt(signed_areas(part.uv, part.uv_triangles) / np.linalg.norm(normals(part), axis=1))
    if part.name == "eye":  # the hidden back of the eye is small in the texture
        density = density[np.isin(part.triangles, part.groups["front"]).all(1)]
    low, high = np.percentile(density, [5, 95])
    assert high / low < 2.6


@pytest.mark.parametrize("name", ["eye", "tongue"])
def test_closed_parts_are_watertight_and_face_outwards(name):
    part = PARTS[name]
    assert len(border_edges(part.triangles)) == 0
    assert len(part.vertices) - len(part.triangles) // 2 == 2  # Euler's formula for a sphere
    assert volume(part) > 0


def test_eyeball_measures():
    eye = PARTS["eye"]
    v, groups = eye.vertices, eye.groups
    assert v[groups["sclera"], 0].max() == pytest.approx(12.0, abs=0.03)
    np.testing.assert_allclose(np.hypot(*v[groups["limbus"], :2].T), 5.85, atol=1e-6)
    np.testing.assert_allclose(np.hypot(*v[groups["pupil"], :2].T), 1.9, atol=1e-6)
    # the sphere of 7.8 mm through the limbus reaches 10.478 - 5.159 + 7.8 mm
    assert v[groups["apex"][0], 2] == pytest.approx(13.119, abs=0.01)
    angle = np.arccos(np.clip(v[:, 2] / np.linalg.norm(v, axis=1), -1, 1))
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), eyeball_radius(angle), atol=1e-9)
    for points, z in ((groups["limbus"], 10.5), (groups["pupil"], 12.9)):
        np.testing.assert_allclose(v[points, 2], z, atol=0.1)
    sphere = eyeball(bulge=0.0).vertices
    np.testing.assert_allclose(np.linalg.norm(sphere, axis=1), 12.0, atol=1e-9)


def test_iris_points_lie_where_their_names_say():
    eye = PARTS["eye"]
    where = {k: weights @ eye.vertices[eye.triangles[t]] for k, (t, weights) in eye.points.items()}
    z = where["iris_left"][2]
    np.testing.assert_allclose(where["iris_centre"][:2], 0, atol=1e-9)
    np.testing.assert_allclose(where["iris_left"], [5.85, 0, z], atol=1e-6)
    np.testing.assert_allclose(where["iris_top"], [0, 5.85, z], atol=1e-6)
    np.testing.assert_allclose(where["iris_right"], [-5.85, 0, z], atol=1e-6)
    np.testing.assert_allclose(where["iris_bottom"], [0, -5.85, z], atol=1e-6)


@pytest.mark.parametrize("arch", ["upper", "lower"])
def test_teeth_are_fourteen_crowns_of_their_sizes(arch):
    part, up = PARTS[f"teeth_{arch}"], 1 if arch == "upper" else -1
    names = [k for k in part.groups if k.endswith("_left") and "edge" not in k and "neck" not in k]
    assert len(names) == 7
    widths = {"upper": [8.5, 6.7, 7.6, 7.0, 6.8, 10.2, 9.6], "lower": [5.2, 5.8, 6.9, 7.0, 7.1, 11.0, 10.5]}[arch]
    np.testing.assert_allclose([c.width for c in crowns(arch)], widths, rtol=0.04)
    loops = border_edges(part.triangles)
    assert set(loops.ravel()) == set(part.groups["neck"])
    for name in names:
        ids = part.groups[name]
        faces = part.triangles[np.isin(part.triangles, ids).all(1)]
        middle = part.vertices[ids].mean(0)
        a, b, c = (part.vertices[faces[:, k]] - middle for k in range(3))
        assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0
        root = part.vertices[np.intersect1d(ids, part.groups["neck"]), 1].mean()
        assert up * (root - part.vertices[ids, 1].mean()) > 0


def test_incisors_overlap_by_two_millimetres():
    upper, lower = PARTS["teeth_upper"], PARTS["teeth_lower"]
    top = upper.vertices[upper.groups["central_incisor_left"]]
    bottom = lower.vertices[lower.groups["central_incisor_left"]]
    assert bottom[:, 1].max() - top[:, 1].min() == pytest.approx(2.0, abs=0.25)
    labial = bottom[bottom[:, 1] > bottom[:, 1].max() - 0.5, 2].max()
    edge = top[top[:, 1] < top[:, 1].min() + 0.5, 2].mean()
    assert edge - labial == pytest.approx(2.0, abs=0.4)
    # the origin is the midpoint between the edges
    assert abs(edge) < 0.4
    assert abs(top[:, 1].min()) < 0.5


def test_arches_follow_width_and_depth():
    for name, part in (("teeth_upper", 65.0 / 58.0), ("teeth_lower", 48.0 / 53.0)):
        reach = [np.abs(p[name].vertices[:, 0]).max() for p in (PARTS, WIDE)]
        assert reach[1] / reach[0] == pytest.approx(part, abs=0.03)
    assert WIDE["teeth_upper"].vertices[:, 2].min() < PARTS["teeth_upper"].vertices[:, 2].min() - 2


def test_gums_hold_the_necks_and_cover_the_palate():
    part = PARTS["gums"]
    upper, lower = part.groups["upper"], part.groups["lower"]
    assert upper.max() + 1 == lower.min()
    assert len(upper) + len(lower) == len(part.vertices)
    assert part.vertices[upper, 1].min() > 2.0
    assert part.vertices[lower, 1].max() < 2.0
    normal = normals(part)
    for name, sign in (("palate", -1), ("floor", 1)):
        inside = np.isin(part.triangles, part.groups[name]).all(1)
        assert sign * normal[inside, 1].sum() > 0.8 * np.abs(normal[inside, 1]).sum()
    front = part.vertices[part.triangles].mean(1)
    labial = (front[:, 2] > 1.0 * front[:, 2].max() - 2) & (np.abs(front[:, 1]) > 8)
    assert (normal[labial, 2] > 0).all()
    for arch in ("upper", "lower"):
        necks = PARTS[f"teeth_{arch}"]
        margin = part.vertices[part.groups[f"margin_{arch}"]]
        sign = 1 if arch == "upper" else -1
        for ring in np.split(np.sort(necks.groups["neck"]), 14):
            middle = necks.vertices[ring].mean(0)
            near = margin[np.argsort(np.linalg.norm((margin - middle)[:, [0, 2]], axis=1))[:6]]
            assert sign * (middle[1] - near[:, 1].min()) > 0


def test_tongue_lies_behind_the_incisors_and_comes_out():
    part = PARTS["tongue"]
    lower = PARTS["teeth_lower"]
    inner = lower.vertices[lower.groups["central_incisor"], 2].max() - 6.5
    rest, low = part.vertices, part.vertices + part.deltas["jawOpen"]
    out = part.vertices + part.deltas["tongueOut"]
    for pose in (rest, low):
        assert pose[:, 2].max() < inner + 1.5
        assert volume(part, pose) > 0
        assert np.linalg.norm(normals(part, pose), axis=1).min() > 0.3
    assert low[:, 1].max() < rest[:, 1].max() - 3
    assert rest[:, 1].max() < PARTS["gums"].vertices[PARTS["gums"].groups["palate"], 1].max() - 5
    assert out[part.groups["tip"], 2].min() > 20
    # it passes over the lower incisors' edges
    over = (out[:, 2] < 0) & (out[:, 2] > -5)
    assert out[over, 1].min() > lower.vertices[lower.groups["central_incisor"], 1].max() - 0.5
    # half-way the surface keeps its orientation
    half = part.vertices + 0.5 * part.deltas["tongueOut"]
    assert volume(part, half) > 0.5 * volume(part)


def test_jaw_opens_by_what_is_asked():
    for opening in (10.0, 40.0):
        jaw = jaw_opening(opening)
        moved = jaw.apply(np.zeros(3))
        assert np.linalg.norm(moved) == pytest.approx(opening)
        assert moved[1] < 0
        assert moved[2] < 0
        assert abs(moved[0]) < 1e-12
    np.testing.assert_allclose(jaw.rotation @ jaw.rotation.T, np.eye(3), atol=1e-12)


def test_rigid_fit_finds_the_motion_under_noise():
    rng = np.random.default_rng(3)
    chin = rng.normal(0, 12, (200, 3)) + [0, -30, 5]
    jaw = jaw_opening(38.0)
    exact = fit_rigid(chin, jaw.apply(chin))
    np.testing.assert_allclose(exact.rotation, jaw.rotation, atol=1e-12)
    np.testing.assert_allclose(exact.translation, jaw.translation, atol=1e-9)
    noisy = fit_rigid(chin, jaw.apply(chin) + rng.normal(0, 0.5, chin.shape))
    error = np.linalg.norm(noisy.apply(chin) - jaw.apply(chin), axis=1).mean()
    assert 1e-4 < error < 0.15
    # outliers without weight do not count
    moved = jaw.apply(chin)
    moved[:50] += 30.0
    weighted = fit_rigid(chin, moved, (np.arange(200) >= 50).astype(float))
    np.testing.assert_allclose(weighted.rotation, jaw.rotation, atol=1e-9)


def test_colours_repeat_and_bear_the_iris_colour():
    eye = PARTS["eye"]
    blue, brown = (colours(eye, 128, iris) for iris in ((0.35, 0.48, 0.62), (0.36, 0.22, 0.12)))
    np.testing.assert_array_equal(blue, colours(eye, 128, (0.35, 0.48, 0.62)))
    assert blue[64, 64].max() < 20  # the pupil
    spot = 64, 64 + round(128 * 0.14)
    assert blue[spot][2] > blue[spot][0]
    assert brown[spot][0] > brown[spot][2]
    assert blue[64, 105].min() > 180  # the sclera
    enamel, gum = colours(PARTS["teeth_upper"], 128), colours(PARTS["gums"], 128)
    assert enamel.shape == gum.shape == (128, 128, 3)
    assert enamel.mean() > gum.mean() + 30

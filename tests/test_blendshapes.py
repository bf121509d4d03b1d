"""Stage blendshapes: what is exact, what stays the same under similarities, and which contacts hold on other heads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
import synthetic
from scipy.spatial import cKDTree

from avatarbuild.artefacts import Blendshapes, Neutral
from avatarbuild.contacts import HELD, REACH, STILL, TOGETHER, Contacts, Head
from avatarbuild.energies.deformation_transfer import displacement_gradients, gradient_rows, transfer_system
from avatarbuild.energies.jaw import Rigid, affine, carried, jaw_motion, rigid
from avatarbuild.errors import InputError
from avatarbuild.geometry.meshes import adjacency
from avatarbuild.geometry.raster import project, rasterise
from avatarbuild.geometry.rings import bilaplacian, rings, rings_of_opening
from avatarbuild.options import BlendshapesOptions
from avatarbuild.progress import Silent
from avatarbuild.rigging import keep, poses_of
from avatarbuild.solvers.held import solve_held
from avatarbuild.solvers.sparse import Factor
from avatarbuild.stages import blendshapes
from avatarbuild.template import ARKIT_NAMES, EYE_PARTS, Template
from avatarbuild.template import expression_weights as weights

SEEDS = (1, 2, 3, 4, 5)
SEALED = (
    "jawForward",
    "mouthPucker",
    "mouthLeft",
    "mouthSmile",
    "mouthFrown",
    "mouthStretch",
    "cheekPuff",
    "noseSneer",
)
_made: dict[object, Blendshapes] = {}


def built(seed: int) -> Blendshapes:
    if seed not in _made:
        _made[seed] = blendshapes.run(synthetic.neutral(seed), BlendshapesOptions(), Silent(), synthetic.template())
    return _made[seed]


def itself(t: Template) -> Neutral:
    return replace(synthetic.neutral(1), vertices=t.mean, eye_centres=t.eye_centres)


# ---- the transfer's own numerics


def test_gradient_of_a_triangle_by_hand() -> None:
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    # twice as long along x, half along y: the normal keeps its length, since the area stays
    posed = rest * [2, 0.5, 1]
    found = displacement_gradients(rest, (posed - rest)[None], np.array([[0, 1, 2]]))[0, 0]
    np.testing.assert_allclose(found, np.diag([1, -0.5, 0]), atol=1e-12)
    # turned a quarter about x: y -> z, z -> -y
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    found = displacement_gradients(rest, (rest @ turn.T - rest)[None], np.array([[0, 1, 2]]))[0, 0]
    np.testing.assert_allclose(found, turn - np.eye(3), atol=1e-12)
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert not displacement_gradients(flat, np.ones((1, 3, 3)), np.array([[0, 1, 2]])).any()


def patch(n: int = 7) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[0:n, 0:n].astype(float)
    vertices = np.stack([x, y, 0.1 * np.sin(x) * np.cos(y)], -1).reshape(-1, 3)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    return vertices, np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])


def test_a_stretch_is_transferred_as_that_stretch_whatever_the_target() -> None:
    source, triangles = patch()
    linear = np.array([[1.2, 0.1, 0.0], [0, 0.9, 0], [0, 0, 1]])
    # no triangle's normal enters where the target lies in the plane that the source is near
    target = source * [2.0, 3.0, 0.0]
    gradients = np.broadcast_to(linear - np.eye(3), (1, len(triangles), 3, 3))
    A, B, _ = transfer_system(target, triangles)
    held = np.zeros(len(source), bool)
    held[0] = True
    free = np.flatnonzero(~held)
    right = (B @ gradient_rows(gradients))[free]
    moved = np.zeros_like(target)
    moved[free] = Factor(A[free][:, free]).solve(right)
    np.testing.assert_allclose(moved, target @ (linear - np.eye(3)).T, atol=1e-9)


def test_the_system_is_the_fourth_vertex_form() -> None:
    """Sumner's unknown fourth vertices, eliminated by brute force, give the same normal equations up to the areas."""
    source, triangles = patch(4)
    rng = np.random.default_rng(3)
    target = source + 0.1 * rng.standard_normal(source.shape)
    S = np.eye(3) + 0.2 * rng.standard_normal((len(triangles), 3, 3))
    n, m = len(target), len(triangles)
    rows, right = [], []
    for j, (a, b, c) in enumerate(triangles):
        u, v = target[b] - target[a], target[c] - target[a]
        normal = np.cross(u, v)
        frame = np.stack([u, v, normal / np.sqrt(np.linalg.norm(normal))], axis=1)
        root = np.sqrt(np.linalg.norm(normal) / 2)
        # T = [X_b - X_a, X_c - X_a, X_4 - X_a] frame^-1, row k of T^T
        inverse = np.linalg.inv(frame)
        for k in range(3):
            row = np.zeros(n + m)
            row[[b, c, n + j]] = inverse[:, k]
            row[a] = -inverse[:, k].sum()
            rows.append(root * row)
            right.append(root * S[j, :, k])
    rows.append(np.eye(n + m)[0] * 1e3)
    right.append(target[0] * 1e3)
    oracle = np.linalg.lstsq(np.array(rows), np.array(right))[0][:n]
    A, B, _ = transfer_system(target, triangles)
    free = np.arange(1, n)
    moved = np.zeros_like(target)
    moved[free] = Factor(A[free][:, free]).solve((B @ gradient_rows(S[None] - np.eye(3)))[free])
    np.testing.assert_allclose(target + moved, oracle, atol=1e-8)


def test_held_unknowns_are_those_of_a_direct_solve() -> None:
    rng = np.random.default_rng(0)
    vertices, triangles = patch()
    A, _, _ = transfer_system(vertices, triangles)
    A = A.toarray() + 1e-3 * np.eye(len(vertices))
    matrix = sp.csr_matrix(A)
    b = rng.standard_normal((len(vertices), 4))
    free = rng.random((len(vertices), 4)) < 0.6
    free[:, 0] = True
    found = solve_held(matrix, Factor(matrix), b, free, 1e-10)
    for k in range(4):
        f = np.flatnonzero(free[:, k])
        np.testing.assert_allclose(found[f, k], np.linalg.solve(A[np.ix_(f, f)], b[f, k]), atol=1e-8)
        assert not found[~free[:, k], k].any()


def test_rings_around_a_vertex_and_an_opening() -> None:
    _, triangles = patch(7)
    graph = adjacency(49, triangles)
    ring = rings(graph, np.array([0]), 3)
    assert ring[[0, 1, 7, 8, 16, 2]].tolist() == [0, 1, 1, 1, 2, 2]
    assert ring.max() == 4
    middle = np.zeros(49, bool)
    middle[[16, 17, 18, 23, 24, 25, 30, 31, 32]] = True
    opening = rings_of_opening(graph, triangles, middle, 3)
    assert opening[24] == -1
    assert (opening[[16, 17, 18, 23, 25, 30, 31, 32]] == 0).all()
    assert opening[8] == 1
    # constants are as smooth as can be
    np.testing.assert_allclose(bilaplacian(graph) @ np.ones(49), 0, atol=1e-12)


def test_rigid_motions_and_pieces_of_the_jaw() -> None:
    rng = np.random.default_rng(1)
    angle = 0.4
    Q = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    jaw = Rigid(Q, np.array([0.0, -3.0, 1.0]))
    teeth, skin = rng.normal(0, 10, (40, 3)), rng.normal(0, 20, (80, 3))
    found = rigid(teeth, teeth + jaw.displacement(teeth))
    np.testing.assert_allclose(found.rotation, Q, atol=1e-12)
    # skin that lags behind the jaw by an offset leaves the target's jaw where it is, if the target's skin lags as well
    offset = rng.normal(0, 1, skin.shape)
    target = skin * 1.1
    before, after = jaw_motion(
        teeth, jaw.displacement(teeth), skin, jaw.displacement(skin) + offset, target, jaw.displacement(target) + offset
    )
    np.testing.assert_allclose(after.rotation, Q, atol=1e-10)
    # a piece that turns with the jaw and moves besides: its own motion is mapped by the pieces' affine map
    own = rng.normal(0, 1, teeth.shape)
    wide = teeth * [1.2, 1.0, 0.9] + 5
    np.testing.assert_allclose(affine(teeth, wide), np.diag([1.2, 1.0, 0.9]), atol=1e-6)
    moved = carried(teeth, jaw.displacement(teeth) + own, wide, before, after)
    np.testing.assert_allclose(moved, jaw.displacement(wide) + own * [1.2, 1.0, 0.9], atol=1e-5)


# ---- the stage


def test_the_template_onto_itself_is_exact() -> None:
    t = synthetic.template()
    head = Head(t.mean, t.eye_centres)
    for contacts in (True, False):
        with Silent().task("", 1) as task:
            found, figures = blendshapes.transferred(t, head, BlendshapesOptions(contacts=contacts), task)
        assert np.abs(found - t.expressions).max() < 1e-6
        assert figures["lid_gap_mm"] < 1e-6
        assert figures["lips_off_mm"] < 1e-6
        assert figures["teeth_out_mm"] < 1e-6


def test_shapes_turn_and_grow_with_the_person() -> None:
    person = synthetic.neutral(1)
    angle = 0.3
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    s, t = 1.13, np.array([3.0, -20.0, 8.0])
    moved = replace(person, vertices=s * person.vertices @ R.T + t, eye_centres=s * person.eye_centres @ R.T + t)
    found = blendshapes.run(moved, BlendshapesOptions(), Silent(), synthetic.template())
    expected = s * built(1).deltas @ R.T
    assert np.abs(found.deltas - expected).max() < 0.01  # the iterative solver's rest, and pixels of the tooth picture
    assert np.abs(found.deltas - expected).mean() < 1e-5


def test_repeats_bit_for_bit() -> None:
    again = blendshapes.run(synthetic.neutral(2), BlendshapesOptions(), Silent(), synthetic.template())
    assert again.deltas.tobytes() == built(2).deltas.tobytes()


def test_another_topology_is_told() -> None:
    person = synthetic.neutral(1)
    with pytest.raises(InputError, match="vertices"):
        blendshapes.run(
            replace(person, vertices=person.vertices[:-1]), BlendshapesOptions(), Silent(), synthetic.template()
        )


@pytest.mark.parametrize("seed", SEEDS)
def test_contacts_hold(seed: int) -> None:
    made = built(seed)
    assert made.deltas.shape == (52, synthetic.template().vertex_count, 3)
    assert made.deltas.dtype == np.float32
    assert np.isfinite(made.deltas).all()
    assert made.figures["lid_gap_mm"] <= 0.3
    assert made.figures["lid_sunk_mm"] <= 0.6
    assert made.figures["lips_off_mm"] <= 0.3
    assert made.figures["teeth_out_mm"] <= 0.3
    assert not made.warnings


def least_clearance(head: Head, shapes: np.ndarray, names: tuple[str, ...], side: int) -> float:
    """mm that the skin about an eye is before the eyeball in the sum of shapes (e, n, 3), the contact line left out."""
    t = synthetic.template()
    lids = Contacts(t, head).lids[side]
    ids = lids.band.vertices[lids.band.ring > lids.band.touch]
    rows = [t.expression_index[name + ("Left", "Right")[side]] for name in names]
    clear, direction = lids.own.clearance(head.vertices[ids] + shapes[rows][:, ids].sum(axis=0))
    return float(clear[direction @ lids.own.gaze > 0.2].min())


@pytest.mark.parametrize("side", [0, 1])
def test_eyeballs_stay_behind_the_skin_in_a_hearty_smile(side: int) -> None:
    t = synthetic.template()
    head, shapes = Head(t.mean, t.eye_centres), t.expressions.copy()
    assert min(least_clearance(head, shapes, names, side) for names in TOGETHER) < -0.3
    Contacts(t, head).clear_eyes(shapes)
    for names in (*TOGETHER, ("cheekSquint",), ("eyeSquint",)):
        assert least_clearance(head, shapes, names, side) > 0.05
    moved = {
        ARKIT_NAMES[j].removesuffix("Left").removesuffix("Right")
        for j in np.flatnonzero(np.abs(shapes - t.expressions).max(axis=(1, 2)) > 0)
    }
    assert moved <= {"cheekSquint", "eyeSquint", "mouthSmile"}
    assert np.abs(shapes - t.expressions).max() < 1.0


def test_learnt_motion_ends_softly_beyond_the_templates_and_leaves_held_lids_and_lips() -> None:
    t = synthetic.template()
    contacts = Contacts(t, Head(t.mean, t.eye_centres))
    skin, mean = contacts.skin, t.mean[contacts.skin]
    poses = poses_of(t)[:, skin]
    share, moving = contacts.reach(poses), np.linalg.norm(poses, axis=2) > STILL
    held = np.zeros(len(mean), bool)
    held[np.concatenate([contacts.lips.held, *(lids.band.vertices for lids in contacts.lids)])] = True
    edges = np.stack(adjacency(len(mean), t.triangles[t.parts["skin"].triangles]).nonzero())
    lengths = np.linalg.norm(mean[edges[0]] - mean[edges[1]], axis=1)
    for one, its in zip(share, moving, strict=True):
        assert (one[its] == 1).all()
        assert (one[held & ~its] == 0).all()
        if its.any():
            assert (one[cKDTree(mean[its]).query(mean)[0] > REACH] == 0).all()
        free = ~its[edges].any(axis=0)
        steps = np.abs(one[edges[0]] - one[edges[1]])[free]
        assert (steps <= 1.5 * (1 / REACH + 1 / HELD) * lengths[free] + 1e-9).all()


def test_a_nose_may_follow_puffed_cheeks_but_not_the_forehead() -> None:
    t = synthetic.template()
    puff, skin = ARKIT_NAMES.index("cheekPuff"), t.parts["skin"].vertices
    tip = np.argmin(np.linalg.norm(t.mean[skin] - t.landmarks(t.mean)[t.landmarks68][30], axis=1))
    assert np.abs(t.expressions[puff, tip]).max() == 0
    learnt = t.expressions.copy()
    learnt[puff, skin] += [0, 1, 0]
    shapes, figures = keep(t, Head(t.mean, t.eye_centres), learnt)
    beyond = shapes - t.expressions
    assert beyond[puff, tip, 1] > 0.8
    assert np.abs(beyond[puff, skin][t.mean[skin, 1] > t.mean[tip, 1] + 80]).max() == 0
    assert figures["lid_gap_mm"] < 0.01
    assert figures["lips_off_mm"] < 0.01


def frontal(vertices: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(450, 900) the triangle in each pixel of a frontal picture about `centre`, 8 pixels a millimetre."""
    K = np.array([[8 * 1200.0, 0, 450], [0, 8 * 1200.0, 225], [0, 0, 1]])
    R = np.diag([1.0, -1, -1])
    pixels, depth = project(vertices, K, np.zeros(5), R, np.array([0, 0, 1200]) - R @ centre)
    return rasterise(pixels, depth, synthetic.template().triangles, (900, 450)).triangle


def eye_pixels(vertices: np.ndarray, centre: np.ndarray) -> int:
    """Pixels of an eyeball seen from the front, 8 a millimetre."""
    t = synthetic.template()
    seen = frontal(vertices, centre)
    balls = [t.parts[name].triangles for name in EYE_PARTS]
    return sum(int(((seen >= ball.start) & (seen < ball.stop)).sum()) for ball in balls)


@pytest.mark.parametrize("seed", SEEDS)
def test_blink_closes_the_eyes(seed: int) -> None:
    made = built(seed)
    middle = made.eye_centres.mean(axis=0)
    posed = made.neutral + np.tensordot(weights(eyeBlink=1.0), made.deltas, 1)
    assert eye_pixels(made.neutral, middle) > 5000
    assert eye_pixels(posed, middle) == 0


def test_lids_above_which_the_skin_lies_near_the_eye_close_on_the_lower_ones() -> None:
    t = synthetic.template()
    contacts = Contacts(t, Head(t.mean, t.eye_centres))
    head, j = t.mean.copy(), ARKIT_NAMES.index("eyeBlinkLeft")
    band, eye = contacts.lids[0].band, contacts.lids[0].own
    beside = band.ring > band.touch
    near = band.vertices[beside]
    clear, direction = eye.clearance(head[near])
    ends = np.clip((25 - band.ring[beside]) / 8, 0, 1)[:, None]
    head[near] -= ends * np.clip(0.45 * clear, 0, 1.2)[:, None] * direction
    made = blendshapes.run(replace(itself(t), vertices=head), BlendshapesOptions(), Silent(), t)
    assert made.figures["lid_gap_mm"] < 0.05
    assert made.figures["lid_sunk_mm"] < 0.3
    rim = band.vertices[(band.ring == band.touch + 2) & (band.over > 0.9)]
    # lifted forwards as the skin has to be, and hardly farther down than the template's
    lower = t.mean[rim, 1] + t.expressions[j, rim, 1] - (head + made.deltas[j])[rim, 1]
    assert 0 < lower.max() < 1.5


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_parts_move_as_they_should(seed: int) -> None:
    t, made = synthetic.template(), built(seed)
    index = t.expression_index
    for name in ("eye_left", "eye_right", "teeth_upper"):
        assert not made.deltas[:, t.parts[name].vertices].any()
    lower = t.parts["teeth_lower"].vertices
    rest = made.neutral[lower]
    for name in ("jawOpen", "jawLeft", "jawForward"):
        posed = rest + made.deltas[index[name], lower]
        assert (
            np.abs(rigid(rest, posed).displacement(rest) + rest - posed).max() < 0.01
        )  # the template is stored in half precision
    opened = made.deltas[index["jawOpen"], lower]
    assert opened[:, 1].min() < -12
    out = made.deltas[index["tongueOut"]]
    assert np.abs(np.delete(out, np.r_[t.parts["tongue"].vertices], axis=0)).max() == 0
    assert out[t.parts["tongue"].vertices, 2].max() > 20
    assert not made.deltas[index["mouthClose"], lower].any()


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_what_the_source_leaves_stays(seed: int) -> None:
    t, made = synthetic.template(), built(seed)
    still = np.linalg.norm(t.expressions, axis=2) < 1e-7
    assert not made.deltas[still].any()


def test_symmetric_head_has_symmetric_blinks() -> None:
    t, person = synthetic.template(), synthetic.neutral(3)
    flip = np.array([-1.0, 1, 1])
    vertices = (person.vertices + person.vertices[t.symmetry] * flip) / 2
    eyes = (person.eye_centres + person.eye_centres[::-1] * flip) / 2
    made = blendshapes.run(
        replace(person, vertices=vertices, eye_centres=eyes), BlendshapesOptions(), Silent(), synthetic.template()
    )
    left, right = (made.deltas[t.expression_index[f"eyeBlink{side}"]] for side in ("Left", "Right"))
    assert np.abs(left[t.symmetry] * flip - right).max() < 0.02


def mouth_pixels(vertices: np.ndarray, neutral: np.ndarray) -> int:
    """Pixels of the mouth's inside, teeth, gums and tongue seen from the front, 8 a millimetre."""
    t = synthetic.template()
    names = ("teeth_upper", "teeth_lower", "gums", "tongue")
    inner = np.concatenate([np.arange(len(t.triangles))[t.parts[name].triangles] for name in names])
    bag = np.flatnonzero(t.regions["mouth"][t.triangles].all(axis=1))
    centre = neutral[t.contours["lips_inner_upper"]].mean(axis=0)
    return int(np.isin(frontal(vertices, centre), np.concatenate([inner, bag])).sum())


@pytest.mark.parametrize("seed", SEEDS[:3])
def test_sealed_lips_stay_sealed(seed: int) -> None:
    made = built(seed)
    shapes = [weights(jawOpen=1.0, mouthClose=1.0), *(weights(**{name: 1.0}) for name in SEALED)]
    rest = mouth_pixels(made.neutral, made.neutral)
    assert mouth_pixels(made.neutral + made.deltas[ARKIT_NAMES.index("jawOpen")], made.neutral) > 20000
    for w in shapes:
        posed = made.neutral + np.tensordot(w, made.deltas, 1)
        of_template = synthetic.template().pose(synthetic.template().mean, w)
        expected = mouth_pixels(of_template, synthetic.template().mean)
        assert mouth_pixels(posed, made.neutral) <= max(rest, expected) + 64  # 1 mm^2


def test_contacts_help() -> None:
    """Without them the same head's lids leave their balls: the figures are able to tell."""
    person = synthetic.neutral(4)
    free = blendshapes.run(person, BlendshapesOptions(contacts=False), Silent(), synthetic.template())
    assert free.figures["lid_gap_mm"] > 2 * built(4).figures["lid_gap_mm"]

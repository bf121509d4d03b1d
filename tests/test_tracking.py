"""The tracker: small quadratic programs, the lens, markers, the texture's differences, dense flow, modelling."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product

import cv2
import numpy as np
import pytest
import synthetic

from avatarbuild.artefacts import Blendshapes
from avatarbuild.energies import texture_flow
from avatarbuild.geometry.mipmap import build_mipmap, sample_texture
from avatarbuild.geometry.raster import rasterise
from avatarbuild.geometry.rotations import rotation
from avatarbuild.solvers.boxed import boxed, reduced
from avatarbuild.stages import tracking
from avatarbuild.template import ARKIT_NAMES, Template, expression_weights
from avatarbuild.tracking import body, dense, fit, full_rate, gaze, lids, modelling, neck
from avatarbuild.tracking import markers as marking
from avatarbuild.tracking.alternation import Eyes, Tracked, as_shown, evidence, looking_ahead, pulled, regard
from avatarbuild.tracking.body import Motion
from avatarbuild.tracking.fit import Face, Pinned, State, Weights
from avatarbuild.tracking.frames import Frame
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.markers import SKIN, Markers
from avatarbuild.tracking.neck import PULLS, SHAPES
from avatarbuild.tracking.rig import Places, Rider, Rig
from avatarbuild.tracking.samples import flow_region

A = SHAPES + PULLS
LENS = Lens(700.0, 0.04, (480, 640))
UPRIGHT = np.diag([1.0, -1.0, -1.0])  # the head's axes to the camera's


@cache
def template() -> Template:
    return Template.load()


@cache
def rig() -> Rig:
    t = template()
    return Rig(t.mean, np.concatenate([t.expressions[:SHAPES], neck.pulls(t, t.mean)]), t.triangles)


def face() -> Face:
    t, r = template(), rig()
    places = Places(t.landmark_triangles[:SKIN], t.landmark_barycentric[:SKIN])
    m = Markers(places, np.zeros((SKIN, 3)), np.ones(SKIN), np.zeros(SKIN, bool))
    skin = t.triangles[t.parts["skin"].triangles]
    return fit.face_of(r, LENS, m, [], skin, ((t.expression_index["mouthClose"], t.expression_index["jawOpen"]),))


def state(weights: np.ndarray, turn: tuple[float, float, float] = (0.03, -0.1, 0.02)) -> State:
    return State(rotation(np.array(turn)) @ UPRIGHT, np.array([5.0, -8.0, 420.0]), weights)


def seen_marks(f: Face, s: State) -> np.ndarray:
    """(478, 2) where a face in a state shows its markers."""
    at = f.lens.project(f.marker_rider.at(s.weights) @ s.R.T + s.t)[0]
    return np.concatenate([at, np.zeros((10, 2))])


def frame_of(f: Face, s: State) -> Frame:
    nothing = np.full(A, np.nan)
    return Frame(0, 0.0, seen_marks(f, s), 1.0, nothing, *neck.bounds(), np.zeros(2), [])


# quadratic programs


def test_boxed_against_all_faces_of_the_box() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        J = rng.standard_normal((6, 4))
        M, b = J.T @ J + 0.01 * np.eye(4), rng.standard_normal(4)
        best = np.inf
        for at in product((-1, 0, 1), repeat=4):  # at the low bound, free, at the high bound
            fixed = np.array(at)
            x = np.where(fixed > 0, 1.0, 0.0)
            free = fixed == 0
            if free.any():
                x[free] = np.linalg.solve(M[np.ix_(free, free)], b[free] - M[np.ix_(free, ~free)] @ x[~free])
            if ((x >= -1e-9) & (x <= 1 + 1e-9)).all():
                best = min(best, 0.5 * x @ M @ x - b @ x)
        found = boxed(M, b, np.zeros(4), np.ones(4), np.full(4, 0.5), 5000)
        assert 0.5 * found @ M @ found - b @ found == pytest.approx(best, abs=1e-5)


def test_reduced_is_the_whole_systems_solution() -> None:
    rng = np.random.default_rng(1)
    J = rng.standard_normal((20, 9))
    M, b = J.T @ J, rng.standard_normal(9)
    S, r, D, d = reduced(M, b, 4)
    rest = np.linalg.solve(S, r)
    np.testing.assert_allclose(np.concatenate([d - D @ rest, rest]), np.linalg.solve(M, b), rtol=1e-8)


# derivatives


def test_lens_derivative() -> None:
    x = np.random.default_rng(2).uniform((-90, -90, 300), (90, 90, 500), (30, 3))
    _, J = LENS.project(x)
    for k in range(3):
        step = np.eye(3)[k] * 1e-4
        numeric = (LENS.project(x + step)[0] - LENS.project(x - step)[0]) / 2e-4
        np.testing.assert_allclose(J[..., k], numeric, atol=1e-6)


def moved(s: State, change: np.ndarray) -> State:
    return State(rotation(change[:3]) @ s.R, s.t + change[3:6], s.weights + change[6:])


def test_marker_derivative() -> None:
    f = face()
    s = state(neck.padded(expression_weights(jawOpen=0.3, mouthSmile=0.4), 0.0))
    pictures = f.lens.project(f.marker_rider.at(s.weights) @ s.R.T + s.t)[0]
    pictures = pictures + np.random.default_rng(3).normal(0, 1e-6, pictures.shape)  # near zero: z / f stays as it is
    r, J = marking.rows(f.marker_rider, f.markers, s.weights, pictures, f.lens, s.R, s.t)
    assert np.abs(r).max() < 1e-5
    for k in (0, 1, 2, 3, 4, 5, 6 + 17, 6 + 23):
        step = np.zeros(6 + A)
        step[k] = 1e-5
        ahead, behind = (moved(s, sign * step) for sign in (1, -1))
        numeric = [
            marking.rows(f.marker_rider, f.markers, at.weights, pictures, f.lens, at.R, at.t)[0]
            for at in (ahead, behind)
        ]
        np.testing.assert_allclose(J[:, k], (numeric[0] - numeric[1]) / 2e-5, atol=2e-3 * max(1, np.abs(J[:, k]).max()))


def test_sliding_markers_count_across_their_line_only() -> None:
    f = face()
    s = state(np.zeros(A))
    pictures = seen_marks(f, s)[:SKIN]
    sliding = template().landmark_sliding[:SKIN]
    m = replace(f.markers, sliding=sliding)
    shifted = pictures.copy()
    shifted[sliding] += 3.0
    r, _ = marking.rows(f.marker_rider, m, s.weights, shifted, f.lens, s.R, s.t)
    across = marking._across(shifted[sliding])
    two = r.reshape(-1, 2)[sliding]
    np.testing.assert_allclose(across[:, 0] * two[:, 1] - across[:, 1] * two[:, 0], 0, atol=1e-9)
    assert 0.2 < np.linalg.norm(two, axis=1).max() < 3 * np.sqrt(2)


def wave(h: int, w: int) -> np.ndarray:
    i, j = np.mgrid[0:h, 0:w] + 0.5
    return (np.sin(j / 29) + np.cos(i / 37) + np.sin((i + 2 * j) / 45)).astype(np.float32)


def test_texture_flow_derivative() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform((-60, -60, -10), (60, 60, 10), (40, 1, 3)) + rng.uniform(-2, 2, (40, 3, 3))
    moves = rng.standard_normal((40, 3, 3, 2))
    rho = rng.standard_normal((40, 3))
    picture, everything = wave(400, 300), np.ones(40, bool)
    R, t = rotation(np.array([0.05, 0.1, -0.02])) @ UPRIGHT, np.array([3.0, 4.0, 400.0])

    def look(change: np.ndarray) -> texture_flow.Sight:
        at = points + moves @ change[6:]
        place = (rotation(change[:3]) @ R, t + change[3:6])
        return texture_flow.sight(at, everything, picture, np.array([20.0, 30.0]), 1.5, LENS.parameters, *place)

    here = look(np.zeros(8))
    J = texture_flow.jacobian(moves, here)
    _, known = texture_flow.residuals(rho, here)
    assert known.mean() > 0.8
    for k in range(8):
        step = np.zeros(8)
        step[k] = 1e-3
        ahead, behind = (texture_flow.residuals(rho, look(sign * step))[0] for sign in (1, -1))
        numeric = ((ahead - behind) / (2 * step[k])).ravel()
        use = known.ravel()
        assert np.corrcoef(J[use, k], numeric[use])[0, 1] > 0.97  # a slope is the mean of its four pixels' own
        assert J[use, k] @ numeric[use] == pytest.approx(J[use, k] @ J[use, k], rel=0.08)


# fits


def test_markers_alone_recover_pose_and_weights() -> None:
    f = face()
    truth = state(neck.padded(expression_weights(jawOpen=0.6, browInnerUp=0.8, mouthSmileLeft=0.5), 0.0))
    here = frame_of(f, truth)
    w = Weights(sparse=1e-6, ridge=1e-6, score=0.0)
    start = State(UPRIGHT, np.array([0.0, 0.0, 450.0]), np.zeros(A))
    found = fit.fit_points(f, here, fit.detected(f, here, w), start, w, rigid=6, steps=25)
    posed, wanted = (f.rig.posed(s.weights) @ s.R.T + s.t for s in (found, truth))
    off = np.linalg.norm(posed - wanted, axis=1)[template().regions["face"]]
    assert off.mean() < 0.3
    assert found.weights.min() >= 0
    assert found.weights.max() <= 1


def test_a_neck_that_pulls_at_the_chin_moves_no_jaw() -> None:
    t, f = template(), face()
    moved = neck.padded(np.zeros(SHAPES), 0.0)
    moved[SHAPES : SHAPES + 2] = 1.2, -0.8
    still = state(moved)
    at = np.flatnonzero(flow_region(t))[::7]
    places = Places(at, np.full((len(at), 3), 1 / 3))
    posed = places.on(f.rig.posed(moved), t.triangles)
    assert np.abs(posed - places.on(t.mean, t.triangles)).max() > 3  # mm
    pictures = LENS.project(posed @ still.R.T + still.t)[0]
    w = Weights()
    shown = fit.found(f, dense.Targets(places, pictures, 1.0, np.ones((2, 2)), np.zeros(2), 1.0, w.density), w)
    start = replace(still, weights=np.zeros(A))
    found = fit.fit_points(f, frame_of(f, still), shown, start, w, rigid=0, steps=15)
    np.testing.assert_allclose(found.weights[SHAPES:], moved[SHAPES:], atol=0.1)
    assert found.weights[:SHAPES].max() < 0.03


def test_the_torso_is_told_from_jaws_that_drop() -> None:
    """
    A third of the frames show a jaw that pulls looked like taking up; the others what a torso does, which stands still
    in the room while the camera sways.
    """
    t, rng = template(), np.random.default_rng(3)
    chin = t.landmarks(t.mean)[t.landmarks68][8]
    poses, moved = [], []
    for _ in range(40):
        turn = cv2.Rodrigues(rng.normal(0, 0.08, 3))[0]
        moved.append(Motion(cv2.Rodrigues(rng.normal(0, 0.03, 3))[0], rng.normal(0, 10, 3)))
        poses.append(moved[-1].of(UPRIGHT @ turn, np.array([0.0, 0.0, 450.0]) + rng.normal(0, 6, 3)))
    offset = np.array([-1.0, 0.5])
    still = neck.Torso(UPRIGHT, np.array([0.0, 0.0, 450.0]), None, chin[1] + 20, chin, 0.3, offset)
    seen = np.array([still.weights(*pose, m) for pose, m in zip(poses, moved, strict=True)])
    seen[::3, 1] -= 1.0
    found = neck.torso(t, t.mean, poses, moved, None, seen)
    assert abs(found.share - 0.3) < 0.05
    wanted = np.array([still.weights(*pose, m) for pose, m in zip(poses, moved, strict=True)])
    off = np.array([found.weights(*pose, m) for pose, m in zip(poses, moved, strict=True)]) - wanted
    assert neck.UNIT * np.abs(off[:, :2]).max() < 1.0  # mm

    f = replace(face(), torso=found)
    R, place = poses[7]
    one = Tracked(
        frame_of(f, state(np.zeros(A))), State(R, place, np.zeros(A)), [], 1.0, *np.full((2, 2, 2), np.nan), []
    )
    held = pulled(f, one)
    for values in (held.state.weights, held.frame.low, held.frame.high):
        np.testing.assert_array_equal(values[SHAPES:], found.weights(R, place, None))
    fields = np.tensordot(held.state.weights[SHAPES:], f.rig.deltas[SHAPES:], axes=1)
    at = int(np.linalg.norm(t.mean - chin, axis=1).argmin())
    passing = found.share * ((t.mean[at] @ found.R.T + found.t - place) @ R - t.mean[at])
    passing[:2] += found.offset
    assert np.linalg.norm(fields[at] - passing) < 0.5


def test_the_body_is_found_again_below_the_chin() -> None:
    """A flat body with a collar and stripes, 450 mm away; the camera sways, comes nearer and rolls."""
    lens = Lens(1400.0, 0.0, (1080, 1920))
    still = np.array([10.0, 60.0, 450.0])

    def picture(motion: Motion) -> np.ndarray:
        y, x = np.mgrid[:1920:4, :1080:4] + 2.0
        rays = np.stack([(x - 540) / lens.focal, (y - 960) / lens.focal, np.ones_like(x)], axis=-1) @ motion.R
        depth = (still[2] + motion.R.T[2] @ motion.t) / rays[..., 2]  # the body's plane, z = 450 in its own frame
        at = rays * depth[..., None] - motion.R.T @ motion.t - still
        collar = np.hypot(at[..., 0] / 60, (at[..., 1] - 20) / 40) < 1
        cloth = 140 + 30 * np.sin(at[..., 1] / 4) + 20 * np.sin(at[..., 0] / 40 + at[..., 1] / 90)
        grey = np.where(collar, 190 + at[..., 0] / 4, cloth).clip(0, 255).astype(np.uint8)
        return body.whole(np.repeat(grey[..., None], 3, axis=2))

    chin, bridge = lens.project(still + np.array([[0.0, -10, 0], [0, -95, 0]]))[0]
    patch = body.patch(picture(body.STILL), chin, bridge, 450.0, lens)
    assert patch is not None
    rolled = cv2.Rodrigues(np.array([0, 0, 0.03]))[0]
    for moved in (body.STILL, Motion(np.eye(3), np.array([9.0, -6, 0])), Motion(rolled, np.array([-5.0, 4, -12]))):
        found = patch.find(picture(moved))
        assert found is not None
        off = found.R @ still + found.t - (moved.R @ still + moved.t)
        assert np.abs(off).max() < 1.0  # mm
        assert abs(found.R[1, 0] - moved.R[1, 0]) < 0.006
    rng = np.random.default_rng(1)
    assert patch.find(body.whole(rng.integers(0, 255, (1920, 1080, 3), np.uint8))) is None
    assert patch.find(np.zeros((0, 0), np.float32)) is None
    assert body.patch(np.zeros((0, 0), np.float32), chin, bridge, 450.0, lens) is None
    low = chin + np.array([0, 850.0])
    assert body.patch(patch.picture, low, low - (chin - bridge), 450.0, lens) is None


def test_a_neck_goes_from_the_head_s_pose_to_the_torso_s() -> None:
    t = template()
    begin, chin = -80.0, np.array([0.0, -105.0, 5.0])
    R, place = UPRIGHT @ cv2.Rodrigues(np.array([0.05, -0.1, 0.02]))[0], np.array([3.0, -8.0, 455.0])
    torso = neck.Torso(UPRIGHT, np.array([0.0, 0.0, 450.0]), None, begin, chin, 0.3, np.zeros(2))
    high, edge, low = np.array([[0.0, -70.0, 20.0], chin, [0.0, torso.heights[1] - 1, -20.0]])[:, None]
    still = torso.at(None)
    shown = [neck.bent(x, x, torso.heights, (R, place), still) @ R.T + place for x in (high, edge, low)]
    np.testing.assert_allclose(shown[0], high @ R.T + place, atol=1e-9)
    np.testing.assert_allclose(shown[1], 0.7 * (edge @ R.T + place) + 0.3 * (edge @ still[0].T + still[1]), atol=1e-9)
    np.testing.assert_allclose(shown[2], low @ still[0].T + still[1], atol=1e-9)
    np.testing.assert_allclose(neck.bent(t.mean, t.mean, neck.UNBENT, (R, place), still), t.mean, atol=1e-4)


def test_a_finer_picture_says_no_more_of_the_weights() -> None:
    """Four times as many points on the same skin, as from twice the resolution: the same weights."""
    f = face()
    truth = state(neck.padded(expression_weights(jawOpen=0.4, mouthSmileLeft=0.6), 0.0))
    here = replace(frame_of(f, truth), scores=np.full(A, 0.1))
    w = Weights(score=50.0)
    (points,) = fit.detected(f, here, w)
    again = np.tile(np.arange(SKIN), 4)
    m = points.markers
    finer = Markers(
        Places(m.places.triangle[again], m.places.barycentric[again]),
        m.offset[again],
        m.weight[again],
        m.sliding[again],
    )
    four = Pinned(finer, f.rig.rider(finer.places), points.pictures[again], points.worth[again], points.reach)
    start = replace(truth, weights=np.zeros(A))
    a = fit.fit_points(f, here, [points], start, w.beside(w.density), rigid=0, steps=6)
    b = fit.fit_points(f, here, [four], start, w.beside(4 * w.density), rigid=0, steps=6)
    np.testing.assert_allclose(a.weights, b.weights, atol=2e-3)


def test_limits_hold() -> None:
    f = face()
    truth = state(neck.padded(expression_weights(jawOpen=0.2, mouthClose=0.2), 0.0))
    here = frame_of(f, truth)
    found = fit.fit_points(f, here, fit.detected(f, here, Weights()), truth, Weights(), rigid=0, steps=5)
    i, j = (template().expression_index[name] for name in ("mouthClose", "jawOpen"))
    assert found.weights[i] <= found.weights[j] + 1e-12


def test_dense_flow_finds_a_moved_head() -> None:
    """A head drawn with a texture, then looked for from a pose that is 4 mm off."""
    t = template()
    part = t.parts["skin"].triangles
    skin, region = t.triangles[part], flow_region(t)[part]
    rng = np.random.default_rng(5)
    skin_noise = np.zeros((1024, 1024))
    for cell in (4, 8, 16, 32):
        skin_noise += np.kron(rng.standard_normal((1024 // cell,) * 2), np.full((cell, cell), 0.15))
    texture = (build_mipmap(np.asarray(skin_noise, np.float32)[..., None]), t.uv, t.uv_triangles[part])
    R, place = UPRIGHT, np.array([0.0, 10.0, 420.0])
    camera = t.mean @ R.T + place
    pixels = LENS.project(camera)[0]
    raster = rasterise(pixels, camera[:, 2], skin, LENS.size)
    drawn = sample_texture(texture[0], raster, pixels, camera[:, 2], skin, texture[1], texture[2])[..., 0]
    nothing = np.full(A, np.nan)
    here = Frame(0, 0.0, np.zeros((478, 3)), 1.0, nothing, *neck.bounds(), np.zeros(2), [drawn])
    off = place + np.array([3.0, -2.0, 0.0])
    found = dense.targets(here, t.mean, skin, region, texture, LENS, R, off, level=0)
    assert found.share > 0.6
    depth = np.median(camera[skin[region], 2])
    assert found.density == pytest.approx((LENS.focal / depth / 5) ** 2, rel=0.02)
    true = LENS.project(found.places.on(t.mean, skin) @ R.T + place)[0]
    error = np.linalg.norm(found.pictures - true, axis=1)
    assert np.median(error) < 0.3
    assert np.quantile(error, 0.9) < 1.0


def test_where_something_hides_the_face_the_detector_counts_less() -> None:
    """The drawn head with a flat patch over its right half: flow finds nothing there."""
    h, w = 120, 100
    tried = np.zeros((h, w), bool)
    tried[20:100, 20:80] = True
    good = tried.copy()
    good[:, :50] = False
    cover = dense._about(good, tried)
    targets = dense.Targets(
        Places(np.zeros(0, int), np.zeros((0, 3))), np.zeros((0, 2)), 0.5, cover, np.zeros(2), 2.0, 0.03
    )
    shares = targets.covered(2 * np.array([[30.0, 60.0], [70.0, 60.0], [5.0, 5.0], [500.0, 60.0]]))
    np.testing.assert_allclose(shares, [0, 1, 1, 1], atol=0.02)
    f = face()
    here = frame_of(f, state(np.zeros(A)))
    (whole,), (half,) = (fit.detected(f, here, Weights(), trust) for trust in (1.0, np.full(SKIN, 0.5)))
    np.testing.assert_allclose(half.worth, 0.5 * whole.worth)


# the eyes


def eye_picture(open_: float, skin: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Two eyes on plain skin, each `open_` of a lens 80 by 30 pixels, and the detector's points at their corners."""
    picture = np.full((200, 400, 3), skin, np.uint8)
    marks = np.zeros((478, 2))
    for middle, (inner, outer) in ((120, (133, 33)), (280, (362, 263))):
        side = 1 if middle > 200 else -1
        marks[inner], marks[outer] = (middle - 40 * side, 100), (middle + 40 * side, 100)
        lens = np.zeros(picture.shape[:2], np.uint8)
        cv2.ellipse(lens, (middle, 100), (40, round(15 * open_)), 0, 0, 360, 1, -1)
        iris = np.zeros_like(lens)
        cv2.circle(iris, (middle, 100), 15, 1, -1)
        if open_ > 0:
            picture[lens > 0] = (225, 220, 215)
            picture[(lens & iris) > 0] = (70, 80, 60)
    return picture, marks


@pytest.mark.parametrize("skin", [(225, 175, 150), (190, 130, 100), (90, 55, 40)])
def test_lids_are_shut_as_far_as_the_eye_is_hidden(skin: tuple[int, int, int]) -> None:
    shown = [lids.eye_shown(*eye_picture(open_, skin)) for open_ in (1.0, 0.5, 0.0)]
    opened = lids.usually_open(np.array([shown[0]] * 5 + [shown[2]]))
    wide, half, none = (lids.shut(shown[i], opened) for i in range(3))
    np.testing.assert_allclose(wide, 0, atol=1e-9)
    assert ((half > 0.15) & (half < 0.5)).all()
    np.testing.assert_allclose(none, 1, atol=1e-9)
    looking_down = lids.shut(shown[1], opened, np.full(2, 0.8))
    assert (looking_down < half).all()


def test_eyes_that_cannot_be_judged_are_left_to_the_detector() -> None:
    picture, marks = eye_picture(0.0, (225, 175, 150))
    nothing = lids.eye_shown(picture, marks)
    assert np.isnan(lids.shut(nothing, lids.usually_open(np.array([nothing] * 4)))).all()
    small = lids.eye_shown(cv2.resize(picture, None, fx=0.1, fy=0.1), marks / 10)
    assert np.isnan(small).all()


def test_gaze_of_irises_on_the_eyeballs() -> None:
    t = template()
    R, place = rotation(np.array([0.1, 0.2, 0.0])) @ UPRIGHT, np.array([0.0, 0.0, 400.0])
    wanted = np.array([[0.3, -0.1], [0.2, 0.15]])
    marks = np.zeros((2, 2))
    for side in range(2):
        yaw, pitch = wanted[side]
        ahead = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
        marks[side] = Lens(700, 0, (480, 640)).project((t.eye_centres[side] + 10.4 * ahead) @ R.T + place)[0]
    found = gaze.gaze(marks, t.eye_centres, np.full(2, 12.0), Lens(700, 0, (480, 640)), R, place)
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    looks = gaze.look_weights(t, found)
    named = {name: looks[i] for i, name in enumerate(ARKIT_NAMES) if looks[i] > 0}
    assert set(named) == {"eyeLookOutLeft", "eyeLookDownLeft", "eyeLookInRight", "eyeLookUpRight"}
    assert named["eyeLookOutLeft"] == pytest.approx(0.3 / np.radians(t.eye_rotations["eyeLookOutLeft"].degrees))


def looking(wanted: np.ndarray, lies: np.ndarray, rims: np.ndarray, wrong: float = np.nan) -> Tracked:
    """
    A frame whose irises look `wanted` (2, 2) at a pose that the detector alone tells by 0.1 rad too low; where their
    rims (2,) are not seen they seem to look elsewhere, with circles of `wrong` mm.
    """
    t, s = template(), state(np.zeros(A))
    yaw, pitch = (wanted + np.where(rims[:, None], 0, lies)).T
    ahead = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], axis=1)
    irises = LENS.project((t.eye_centres + 10.4 * ahead) @ s.R.T + s.t)[0]
    depth = (t.eye_centres @ s.R.T + s.t)[:, 2]
    radii = np.where(rims, 6.0, wrong) * LENS.focal / depth
    nodding = replace(s, R=rotation(np.array([0.1, 0.0, 0.0])) @ s.R)
    return Tracked(frame_of(face(), nodding), nodding, [], 1.0, irises, radii, np.full((2, 2), np.nan))


def test_gaze_is_that_of_the_final_pose_and_of_the_eye_whose_rim_is_seen() -> None:
    f, t = face(), template()
    both, left = np.ones(2, bool), np.array([True, False])
    wrong = np.full((2, 2), 0.3)
    clip = [looking(np.zeros((2, 2)), wrong, both)] * 6
    clip += [looking(np.full((2, 2), 0.1), wrong, rims) for rims in (both, left, ~both)]
    clip += [looking(np.full((2, 2), 0.1), wrong, left, radius) for radius in (4.5, 6.7)]
    unknown = np.full(2, np.nan)
    eyes = Eyes(t.eye_centres, np.full(2, 12.0), np.zeros((2, 2)), unknown, unknown, np.zeros(2, bool))
    placed = [replace(one, state=state(np.zeros(A))) for one in clip]
    eyes = looking_ahead(f, placed, eyes)
    assert eyes.by_rims.all()
    rest, seen, one_eye, none = (regard(f, placed[i], t, eyes) for i in (0, 6, 7, 8))
    np.testing.assert_allclose(rest.gaze, 0, atol=1e-3)
    np.testing.assert_allclose(seen.gaze, 0.1, atol=1e-3)
    np.testing.assert_allclose(one_eye.gaze, 0.1, atol=1e-3)
    assert np.isnan(none.gaze).all()
    for i in (9, 10):  # a circle that is not the iris
        np.testing.assert_allclose(regard(f, placed[i], t, eyes).gaze, 0.1, atol=1e-3)
    up = t.expression_index["eyeLookUpLeft"]
    assert one_eye.frame.low[up] == one_eye.frame.high[up] == one_eye.state.weights[up] > 0.1
    early = regard(f, clip[6], t, replace(eyes, rest=np.zeros((2, 2))))
    assert np.abs(early.gaze[:, 1] - 0.1).min() > 0.05


def test_a_shut_eye_is_not_wide_open() -> None:
    t, one = template(), looking(np.zeros((2, 2)), np.zeros((2, 2)), np.ones(2, bool))
    one = replace(one, frame=replace(one.frame, shown=np.array([0.0, 0.3])))
    eyes = Eyes(t.eye_centres, np.full(2, 12.0), np.zeros((2, 2)), np.full(2, 0.3), np.full(2, 6.0), np.ones(2, bool))
    high = regard(face(), one, t, eyes).frame.high
    assert [high[t.expression_index[f"eyeWide{side}"]] for side in ("Left", "Right")] == [0, 1]


def test_gaze_is_held_through_a_blink() -> None:
    angles = np.zeros((5, 2, 2))
    angles[:, :, 0] = np.array([0.0, 9.0, np.nan, 9.0, 0.4])[:, None]
    known = np.array([True, False, True, False, True])[:, None].repeat(2, axis=1)
    np.testing.assert_allclose(gaze.held(angles, known)[:, 0, 0], [0, 0.1, 0.2, 0.3, 0.4])


# every frame


def test_smoothing_keeps_lines_and_has_no_lag() -> None:
    line = np.linspace(0, 3, 40)[:, None]
    np.testing.assert_allclose(full_rate.smoothed(line, np.ones(40), 30.0), line, atol=1e-9)
    pulse = np.zeros((41, 1))
    pulse[20] = 1
    out = full_rate.smoothed(pulse, np.ones(41), 30.0)[:, 0]
    np.testing.assert_allclose(out, out[::-1], atol=1e-12)
    assert out.argmax() == 20


def test_smoothing_halves_what_swings_at_the_cut_off() -> None:
    time = np.arange(600) / 60
    swing = np.cos(2 * np.pi * full_rate.CUT_OFF * time)[:, None]
    out = full_rate.smoothed(swing, np.ones(600), 60.0)
    assert np.abs(out[100:500]).max() == pytest.approx(0.5, abs=0.02)


def test_bad_frames_do_not_pull() -> None:
    line = np.linspace(0, 1, 30)[:, None]
    spoilt, worth = line.copy(), np.ones(30)
    spoilt[15], worth[15] = 9.0, 0.0
    np.testing.assert_allclose(full_rate.smoothed(spoilt, worth, 30.0), line, atol=1e-3)


# modelling


def test_shapes_are_learnt_where_points_show_them() -> None:
    """A person's jaw opens to one side; frames with exact points teach it, and the other shapes stay."""
    t, base = template(), rig()
    j, other = t.expression_index["jawOpen"], t.expression_index["browInnerUp"]
    own = base.deltas.copy()
    size = np.linalg.norm(own[j], axis=1)
    own[j, :, 0] += 0.25 * size
    person = Rig(base.neutral, own, base.triangles)
    f = face()
    skin = t.triangles[t.parts["skin"].triangles]
    inside = np.flatnonzero(t.regions["face"][skin].all(axis=1))[::4]
    places = Places(inside, np.full((len(inside), 3), 1 / 3))
    m = Markers(places, np.zeros((len(inside), 3)), np.ones(len(inside)), np.zeros(len(inside), bool))
    frames, pinned, states = [], [], []
    for weight in (0.4, 0.7, 1.0):
        s = state(neck.padded(expression_weights(jawOpen=weight), 0.0), (0.0, 0.02, 0.0))
        pictures = LENS.project(person.rider(places).at(s.weights) @ s.R.T + s.t)[0]
        pinned.append([Pinned(m, base.rider(places), pictures, np.full(len(inside), 4.0), 5.0)])
        states.append(s)
        frames.append(frame_of(f, s))
    freedom = modelling.Freedom(worth=1.0)
    space = modelling.Space(t, base, np.array([0.0, 0.0, 1.0]), freedom)
    learnt = modelling.learn(space, f, base, frames, pinned, states, (), Weights(), freedom)
    moving = (size > 2) & t.regions["face"]
    before = np.abs((base.deltas - own)[j, moving, 0]).mean()
    after = np.abs((learnt.deltas - own)[j, moving, 0]).mean()
    assert after < 0.35 * before
    np.testing.assert_allclose(learnt.deltas[other], base.deltas[other], atol=1e-9)
    outside = ~(t.regions["face"] | t.regions["nose"] | t.regions["lips"] | t.regions["lids"])
    np.testing.assert_array_equal(learnt.deltas[:, outside], base.deltas[:, outside])


def test_shapes_that_act_together_are_learnt_to_the_end() -> None:
    """Shapes that overlap, data worth far more than the prior: the steps of three rounds end at the minimum."""
    t, full = template(), rig()
    chosen = [t.expression_index[name] for name in ("jawOpen", "mouthFunnel", "mouthSmileLeft", "mouthSmileRight")]
    base = Rig(full.neutral, full.deltas[chosen], full.triangles)
    f = fit.wearing(face(), base)
    skin = t.triangles[t.parts["skin"].triangles]
    inside = np.flatnonzero(t.regions["face"][skin].all(axis=1))[::4]
    places = Places(inside, np.full((len(inside), 3), 1 / 3))
    m = Markers(places, np.zeros((len(inside), 3)), np.ones(len(inside)), np.zeros(len(inside), bool))
    weights = np.random.default_rng(5).uniform(0.1, 0.9, (6, len(chosen)))
    frame, states, pictures = frame_of(face(), state(np.zeros(A))), [], []
    for row in weights:
        s = state(row, (0.0, 0.02, 0.0))
        camera = base.rider(places).at(row) @ s.R.T + s.t
        pictures.append(LENS.project(camera + 1.5 * row[0] * np.sin(camera[:, ::-1] / 25))[0])
        states.append(s)
    posed = []
    for rounds, steps, tolerance in ((3, modelling.Freedom.steps, modelling.Freedom.tolerance), (1, 80, 1e-9)):
        freedom = modelling.Freedom(steps=steps, tolerance=tolerance)
        space = modelling.Space(t, base, np.array([0.0, 0.0, 1.0]), freedom)
        learnt = base
        for _ in range(rounds):
            rider = learnt.rider(places)
            pinned = [[Pinned(m, rider, seen, np.full(len(inside), 6.0), 50.0)] for seen in pictures]
            now = (fit.wearing(f, learnt), base, [frame] * 6, pinned, states)
            learnt = modelling.learn(space, *now, (), Weights(), freedom)
        posed.append(np.stack([learnt.posed(s.weights) - base.posed(s.weights) for s in states]))
    assert np.abs(posed[1]).max() > 1
    assert np.sqrt(((posed[0] - posed[1]) ** 2).mean() / (posed[1] ** 2).mean()) < 0.05


def test_gauge_changes_no_pose() -> None:
    base = rig()
    own = base.deltas * np.linspace(0.7, 1.6, A)[:, None, None]
    s = state(np.full(A, 0.3))
    scaled, (out,) = modelling.gauge(Rig(base.neutral, own, base.triangles), base, [s])
    np.testing.assert_allclose(scaled.posed(out.weights), Rig(base.neutral, own, base.triangles).posed(s.weights))
    np.testing.assert_allclose(scaled.deltas, base.deltas, atol=1e-12)


def test_a_shape_stays_as_large_as_the_person_needs_it() -> None:
    """Who raises their brows by more than the transferred shape at weight 1 keeps the larger shape."""
    base = rig()
    own = Rig(base.neutral, base.deltas * 1.5, base.triangles)
    s = state(neck.padded(expression_weights(browInnerUp=1.0, jawOpen=0.5), 0.0))
    scaled, (out,) = modelling.gauge(own, base, [s])
    np.testing.assert_allclose(scaled.posed(out.weights), own.posed(s.weights), atol=1e-9)
    wide = template().expression_index["jawOpen"]
    np.testing.assert_allclose(scaled.deltas[wide], base.deltas[wide], atol=1e-9)


def test_evidence() -> None:
    f = face()
    half = state(neck.padded(expression_weights(jawOpen=0.5), 0.0))
    one = Tracked(frame_of(f, half), half, [], 1.0, np.zeros((2, 2)), np.ones(2, bool), np.zeros((2, 2)))
    found = evidence([one], np.ones(1, bool), rig())
    i = template().expression_index["jawOpen"]
    assert found[i] == pytest.approx(0.5, abs=0.02)
    assert found[np.arange(A) != i].max() == 0
    assert evidence([one], np.zeros(1, bool), rig()).max() == 0
    poor = replace(one, quality=0.1)
    assert evidence([poor], np.ones(1, bool), rig()).max() == 0


def test_what_the_video_hardly_shows_stays_as_it_was_transferred() -> None:
    base = rig()
    learnt = replace(base, deltas=base.deltas + 1.0)
    found = np.linspace(0, 1, SHAPES)
    moved_ = (as_shown(learnt, base, found).deltas - base.deltas[:SHAPES])[:, 0, 0]
    assert (moved_[found <= 0.25] == 0).all()
    np.testing.assert_allclose(moved_[found >= 0.6], 1)
    assert (np.diff(moved_) >= -1e-12).all()


def test_without_a_video_the_shapes_are_the_transferred_ones() -> None:
    t = synthetic.template()
    shapes = Blendshapes(t.mean, t.expressions.astype(np.float32), t.eye_centres)
    made = tracking.without(shapes, "no video")
    assert made.warnings == ["no video"]
    assert made.deltas is shapes.deltas
    assert len(made.times) == 0


def test_a_rigs_points_ride_on_its_triangles() -> None:
    r = rig()
    places = Places(np.array([7, 900]), np.array([[0.2, 0.3, 0.5], [1.0, 0.0, 0.0]]))
    weights = np.linspace(0, 1, len(r.deltas))
    np.testing.assert_allclose(r.rider(places).at(weights), places.on(r.posed(weights), r.triangles), atol=1e-9)


def test_rider() -> None:
    rest, moves = np.ones((2, 3)), np.arange(12.0).reshape(2, 3, 2)
    np.testing.assert_allclose(Rider(rest, moves).at(np.array([1.0, 0.5])), 1 + moves[..., 0] + 0.5 * moves[..., 1])


def test_the_eyes_turn_together_and_a_closed_one_follows() -> None:
    both = np.array([[0.2, 0.1], [0.1, -0.1]])
    np.testing.assert_allclose(gaze.yoked(both, np.zeros(2)), [[0.15, 0.0]] * 2)
    one = np.array([[0.2, 0.1], [np.nan, np.nan]])
    np.testing.assert_allclose(gaze.yoked(one, np.zeros(2)), [[0.2, 0.1]] * 2)
    winking = gaze.yoked(both, np.array([0.0, 1.0]))
    np.testing.assert_allclose(winking[0], (both[0] + 0.05 * both[1]) / 1.05)
    assert np.isnan(gaze.yoked(np.full((2, 2), np.nan), np.zeros(2))).all()

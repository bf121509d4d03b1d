"""The template laid onto people who are not in it: from a cloud sampled on them and from landmarks seen by cameras."""

from __future__ import annotations

from dataclasses import replace

import cv2
import igl
import numpy as np
import pycolmap
import pytest
import scipy.sparse as sp
import synthetic
from derivatives import numerical

from avatarbuild.artefacts import Cloud
from avatarbuild.energies import reprojection
from avatarbuild.energies.thin_shell import ThinShell
from avatarbuild.geometry import meshes
from avatarbuild.options import NeutralOptions
from avatarbuild.registration import morphable, shell
from avatarbuild.registration.counterparts import Target, counterparts
from avatarbuild.registration.morphable import Placement, Step
from avatarbuild.registration.pins import pins, sealed_pairs
from avatarbuild.registration.sightings import Sightings, sightings
from avatarbuild.registration.trust import cloud_trust, smoothness
from avatarbuild.sfm.metric import Placed
from avatarbuild.simulation.photographs import look_at
from avatarbuild.stages import neutral as stage

YAWS = (-55, -40, -25, -10, 0, 10, 25, 40, 55)


def watched(points: np.ndarray, noise: float, seed: int = 0) -> Sightings:
    """Landmarks (478, 3) as nine cameras on an arc of 450 mm see them, with `noise` pixels."""
    rng = np.random.default_rng(seed)
    camera = pycolmap.Camera(model="PINHOLE", width=1200, height=1600, params=[1400.0, 1400.0, 600.0, 800.0])
    R, t, seen = [], [], []
    for yaw in np.radians(YAWS):
        eye = 450 * np.array([np.sin(yaw), 0.1 * np.cos(5 * yaw), np.cos(yaw)])
        R.append(look_at(eye, np.zeros(3)))
        t.append(-R[-1] @ eye)
        flat = np.asarray(camera.img_from_cam(points @ R[-1].T + t[-1]))
        seen.append(np.c_[flat + noise * rng.standard_normal(flat.shape), np.zeros(len(flat))])
    k = len(YAWS)
    placed = Placed(np.arange(k), [camera] * k, np.array(R), np.array(t))
    pose = np.stack([np.array(YAWS, float), np.zeros(k), np.zeros(k)], axis=1)
    return sightings(placed, np.array(seen), pose, np.ones(k, bool))


def sampled(vertices: np.ndarray, noise: float, count: int = 120_000, seed: int = 0) -> Cloud:
    """Points on the outside of a head, as stereo gives them: none on the back, none on the eyes."""
    t = synthetic.template()
    rng = np.random.default_rng(seed)
    skin = t.triangles[t.parts["skin"].triangles]
    hidden = t.regions["mouth"] | t.regions["sockets"]
    centre = t.mean[skin].mean(axis=1)
    skin = skin[~hidden[skin].any(axis=1) & (centre[:, 2] > -95)]
    area = meshes.face_areas(vertices, skin)
    chosen = rng.choice(len(skin), count, p=area / area.sum())
    share = rng.dirichlet(np.ones(3), count)
    points = np.einsum("nc,nci->ni", share, vertices[skin[chosen]])
    normals = meshes.face_normals(vertices, skin)[chosen]
    points = points + noise * rng.standard_normal((count, 1)) * normals
    turned = normals + 0.1 * rng.standard_normal(normals.shape)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    colours = np.clip(np.array([190, 140, 120]) + rng.normal(0, 6, (count, 3)), 0, 255).astype(np.uint8)
    return Cloud(points.astype(np.float32), turned.astype(np.float32), colours, np.full(count, 5, np.uint8))


def registered(cloud: Cloud, seen: Sightings) -> tuple[np.ndarray, Placement]:
    """What stage neutral does for the skin."""
    t, o = synthetic.template(), NeutralOptions()
    model, target = stage.fit_model(t, seen, cloud, o, lambda: None)
    head = model.head(t)
    held = pins(t, seen, head, o.landmark_sd, o.rim_sd, o.lip_border_sd, o.slide_sd)
    count = t.parts["skin"].vertices.stop
    triangles = t.triangles[t.parts["skin"].triangles]
    trust = stage.listening(t)[:count]
    x, _ = shell.register(head[:count], triangles, target, trust, held, stage.stiffnesses(o), lambda: None)
    return x, model


def to_surface(x: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Distances of the registered face to a true head's surface."""
    t = synthetic.template()
    skin = t.triangles[t.parts["skin"].triangles].astype(np.int64)
    face = t.regions["face"][: len(x)] & ~(t.regions["mouth"] | t.regions["sockets"] | t.regions["lids"])[: len(x)]
    return np.sqrt(igl.point_mesh_squared_distance(np.ascontiguousarray(x[face]), vertices, skin)[0])


@pytest.fixture(scope="module")
def person() -> tuple[np.ndarray, Sightings, Cloud]:
    vertices = synthetic.neutral(31).vertices
    return vertices, watched(synthetic.template().landmarks(vertices), 1.0), sampled(vertices, 0.12)


@pytest.fixture(scope="module")
def found(person: tuple[np.ndarray, Sightings, Cloud]) -> tuple[np.ndarray, Placement]:
    _, seen, cloud = person
    return registered(cloud, seen)


def test_reprojection_has_the_right_slope() -> None:
    rng = np.random.default_rng(3)
    R = np.stack([cv2.Rodrigues(rng.normal(0, 0.3, 3))[0] for _ in range(2)])
    t, focal = rng.normal(0, 20, (2, 3)) + [0, 0, 400], np.array([900.0, 1100.0])
    x, m = rng.normal(0, 50, (4, 3)), rng.normal(0, 0.1, (2, 4, 2))
    _, J = reprojection.residual(x, R, t, focal, m)
    full = numerical(lambda v: reprojection.residual(v, R, t, focal, m)[0], x).reshape(2, 4, 2, 4, 3)
    for p in range(4):
        assert np.allclose(full[:, p, :, p], J[:, p], rtol=1e-5, atol=1e-6)


def test_the_models_jacobian() -> None:
    t = synthetic.template()
    rng = np.random.default_rng(4)
    now = Placement(1.1, cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0], np.array([3.0, -2, 7]), rng.normal(0, 1, 100))
    chosen = rng.integers(0, t.vertex_count, 6)
    world = now.place(t.neutral(now.coefficients))[chosen]
    J = morphable._jacobian(now, world, t.identity[:, chosen])

    def at(step: np.ndarray) -> np.ndarray:
        moved = morphable._moved(now, step)
        return moved.place(t.neutral(moved.coefficients))[chosen]

    slope = numerical(at, np.zeros(107)).reshape(6, 3, 107)
    assert np.allclose(slope, J, atol=1e-4)


def test_a_head_of_the_model_is_found_again() -> None:
    t = synthetic.template()
    a = np.zeros(100)
    a[:20] = np.random.default_rng(5).normal(0, 0.8, 20)
    truth = Placement(1.03, cv2.Rodrigues(np.array([0.05, 0.1, -0.02]))[0], np.array([4.0, -6, 3]), a)
    vertices = truth.head(t)
    seen = watched(t.landmarks(vertices), 0.0)
    trust = stage.listening(t)
    steps = [Step(0, 1, p, 1) for p in (10, 1, 0.01)] + [Step(100, 0.01, p, 8) for p in (0.1, 0.001, 1e-5, 1e-5, 1e-5)]
    cloud = sampled(vertices, 0.0, 60_000)
    target = Target.of(cloud.points, cloud.normals, np.ones(len(cloud.points)))
    model = morphable.fit(t, seen, target, trust, np.full(478, 1.0), steps, morphable.start(t, seen))
    assert 1e-4 < to_surface(model.head(t)[: t.parts["skin"].vertices.stop], vertices).mean() < 0.15


def test_a_shell_at_rest_has_no_energy() -> None:
    t = synthetic.template()
    part = t.parts["skin"]
    rest, triangles = t.mean[part.vertices], t.triangles[part.triangles]
    thin = ThinShell.of(rest, triangles)
    assert thin.energy(rest, thin.rotations(rest), 1.0, 1.0) < 1e-6
    R = cv2.Rodrigues(np.array([0.7, -1.1, 0.4]))[0]
    moved = rest @ R.T + [10, -20, 30]
    assert np.allclose(thin.rotations(moved), R, atol=1e-6)
    assert thin.energy(moved, thin.rotations(moved), 1.0, 1.0) < 1e-6
    assert thin.energy(1.1 * rest, thin.rotations(1.1 * rest), 1.0, 1.0) > 100


def test_the_shells_system_is_the_energys_derivative() -> None:
    vertices = np.array([[0.0, 0, 0], [2, 0, 0.3], [0, 2, 0.1], [2.2, 2, 0], [1, 3.5, 0.5]])
    triangles = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4]])
    thin = ThinShell.of(vertices, triangles)
    rng = np.random.default_rng(6)
    x = vertices + 0.2 * rng.standard_normal(vertices.shape)
    R = thin.rotations(x)
    slope = numerical(lambda v: np.array([thin.energy(v, R, 0.7, 1.3)]), x)[0].reshape(x.shape)
    gradient = 2 * (thin.matrix(0.7, 1.3) @ x - thin.right_side(R, 0.7, 1.3))
    assert np.allclose(slope, gradient, rtol=1e-6, atol=1e-6)


def test_counterparts_know_the_border_and_the_back() -> None:
    x, y = np.meshgrid(np.arange(-10, 10, 0.25), np.arange(-10, 10, 0.25))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    target = Target.of(points, np.tile([0.0, 0, 1], (len(points), 1)), np.ones(len(points)))
    vertices = np.array([[0.1, 0.1, 1.0], [12.0, 0, 0.5], [0.0, 0, 0.5], [0, 0, 5.0]])
    normals = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, -1], [0, 0, 1]])
    got = counterparts(vertices, normals, target, reach=3.0)
    assert np.allclose(got.place[0, 2], 0)
    assert np.isclose(got.weight[0], (1 - (1 / 3) ** 2) ** 2, atol=0.02)
    assert np.array_equal(got.weight[1:], [0, 0, 0])


def test_tangled_points_are_not_smooth() -> None:
    rng = np.random.default_rng(7)
    points = rng.uniform(0, 30, (8000, 3)) * [1, 1, 0.05]
    up = np.tile([0.0, 0, 1], (len(points), 1))
    tangled = rng.standard_normal(points.shape)
    tangled /= np.linalg.norm(tangled, axis=1, keepdims=True)
    assert np.median(smoothness(points, up)) > 0.99
    assert np.median(smoothness(points, tangled)) < 0.5


def test_a_stranger_is_registered(
    person: tuple[np.ndarray, Sightings, Cloud], found: tuple[np.ndarray, Placement]
) -> None:
    vertices, _, _ = person
    x, model = found
    t = synthetic.template()
    off = to_surface(x, vertices)
    assert 0.01 < off.mean() < 0.12
    assert np.percentile(off, 99) < 0.6
    alone = to_surface(model.head(t)[: len(x)], vertices)
    assert alone.mean() > 2 * off.mean()
    marks = t.landmarks68[27:]
    corners = t.triangles[t.landmark_triangles[marks]]
    apart = np.einsum("lc,lci->li", t.landmark_barycentric[marks], x[corners] - vertices[corners])
    assert 0.05 < np.linalg.norm(apart, axis=1).mean() < 1.0


def test_closed_lips_stay_closed(found: tuple[np.ndarray, Placement]) -> None:
    t = synthetic.template()
    x, model = found
    rest = model.head(t)
    upper, lower = sealed_pairs(t).T
    assert len(upper) > 10
    assert np.abs((x[upper] - x[lower]) - (rest[upper] - rest[lower])).max() < 0.5


def test_a_hole_in_a_cheek_is_completed(person: tuple[np.ndarray, Sightings, Cloud]) -> None:
    vertices, seen, cloud = person
    x, y, _ = cloud.points.T
    keep = ~((x > 30) & (y < -10) & (y > -70))
    holed = replace(cloud, points=cloud.points[keep], normals=cloud.normals[keep], colours=cloud.colours[keep])
    off = to_surface(registered(holed, seen)[0], vertices)
    assert off.mean() < 0.4
    assert off.max() < 4.0


def test_hair_and_outliers_do_not_dent_the_head(
    person: tuple[np.ndarray, Sightings, Cloud], found: tuple[np.ndarray, Placement]
) -> None:
    vertices, seen, cloud = person
    t = synthetic.template()
    rng = np.random.default_rng(8)
    n = len(cloud.points)
    stray = rng.uniform(cloud.points.min(axis=0), cloud.points.max(axis=0), (n // 5, 3))
    scalp = vertices[t.regions["scalp"] & (t.mean[:, 1] > 20)]
    root = scalp[rng.integers(0, len(scalp), n // 4)]
    hair = root * (1 + rng.uniform(0, 20, (len(root), 1)) / np.linalg.norm(root, axis=1, keepdims=True))
    more = np.concatenate([stray, hair + rng.normal(0, 1, hair.shape)])
    normals = rng.standard_normal(more.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colours = np.concatenate([rng.integers(0, 255, stray.shape), rng.integers(10, 50, hair.shape)]).astype(np.uint8)
    spoilt = Cloud(
        np.concatenate([cloud.points, more]).astype(np.float32),
        np.concatenate([cloud.normals, normals]).astype(np.float32),
        np.concatenate([cloud.colours, colours]),
        np.full(n + len(more), 5, np.uint8),
    )
    trust = cloud_trust(spoilt.points, spoilt.normals, spoilt.colours, vertices, t)
    assert np.median(trust[:n]) > 0.9
    assert trust[-len(hair) :].mean() < 0.1
    x, _ = registered(spoilt, seen)
    assert to_surface(x, vertices).mean() < 0.2
    crown = np.flatnonzero((t.regions["scalp"] & (t.mean[:, 1] > 60))[: len(x)])
    assert np.linalg.norm(x[crown] - found[0][crown], axis=1).mean() < 2.0


def test_registration_repeats_bit_for_bit(
    person: tuple[np.ndarray, Sightings, Cloud], found: tuple[np.ndarray, Placement]
) -> None:
    _, seen, cloud = person
    again, _ = registered(cloud, seen)
    assert again.tobytes() == found[0].tobytes()


def test_pins_move_with_the_person() -> None:
    t = synthetic.template()
    vertices = synthetic.neutral(32).vertices
    held = pins(t, watched(t.landmarks(vertices), 0.0), vertices, 6.0, 0.3, 1.0, 4.0)
    off = np.asarray(held.rows @ vertices[: t.parts["skin"].vertices.stop]) - held.places
    across = np.einsum("ci,cij,cj->c", off, held.stiffness, off)
    assert sp.issparse(held.rows)
    assert np.sqrt(np.median(across)) < 1.0  # standard deviations


def test_rims_seen_at_a_wrong_depth_stay_in_line() -> None:
    """What all photos see 2 mm too deep is moved along the line of sight, and neither up nor down the face."""
    t = synthetic.template()
    vertices = synthetic.neutral(32).vertices
    right = watched(t.landmarks(vertices), 0.0)
    middle = right.points[[61, 291, 0, 17]].mean(axis=0)
    sight = (right.centres - middle) / np.linalg.norm(right.centres - middle, axis=1, keepdims=True)
    sight = sight.mean(axis=0) / np.linalg.norm(sight.mean(axis=0))
    up = np.cross(sight, [1.0, 0, 0])
    lips = t.contours["lips_outer_lower"]

    def cost(shift: np.ndarray) -> float:
        held = pins(t, replace(right, points=right.points + shift), vertices, 6.0, 0.3, 1.0, 4.0)
        rows = np.unique(held.rows[:, lips].tocoo().row)
        off = np.asarray(held.rows @ vertices[: t.parts["skin"].vertices.stop]) - held.places
        return float(np.einsum("ci,cij,cj->c", off, held.stiffness, off)[rows].mean())

    still = cost(np.zeros(3))
    assert cost(2 * sight) - still < 0.1 * (cost(2 * up) - still)

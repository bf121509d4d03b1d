"""Simulated captures: light and occlusion by hand, the renderer's energy, the truth against what was rendered."""

import json

import numpy as np
import pytest
import synthetic

from avatarbuild.energies.harmonics import basis
from avatarbuild.errors import InputError
from avatarbuild.formats.images import read_photo
from avatarbuild.formats.video import decode_frames
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.mipmap import build_mipmap
from avatarbuild.simulation import noise, truth
from avatarbuild.simulation.capture import SimulationOptions, simulate
from avatarbuild.simulation.light import Light, _with_harmonics, occlusion, room_light
from avatarbuild.simulation.noise import cells, fractal, plane
from avatarbuild.simulation.performance import perform
from avatarbuild.simulation.photographs import sweep
from avatarbuild.simulation.rendering import Skin, draw
from avatarbuild.simulation.studio import vertex_tangents
from avatarbuild.simulation.subject import random_subject
from avatarbuild.simulation.wrinkles import gains
from avatarbuild.template import ARKIT_NAMES

UP = np.array([[0, 0, 1.0]])


def constant_light(level: float = 1.0) -> Light:
    return _with_harmonics(UP, np.array([1e-9]), np.full((1, 3), level))


def test_uniform_light_makes_every_white_surface_equally_bright():
    light = constant_light(0.7)
    normals = np.random.default_rng(0).standard_normal((50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(basis(normals) @ light.harmonics, 0.7, atol=2e-3)


def test_a_narrow_lobe_lights_like_a_distant_lamp_within_the_order():
    """A lobe of sharpness k holds 2 pi / k of light; matt surfaces see 2 / k cos, of which order 2 keeps the shape."""
    light = _with_harmonics(UP, np.array([200.0]), np.ones((1, 3)))
    facing = basis(UP) @ light.harmonics
    np.testing.assert_allclose(facing, 2 / 200, rtol=0.12)
    back = basis(-UP) @ light.harmonics
    assert (np.abs(back) < 0.1 * facing).all()


def test_turned_light_is_the_light_seen_from_a_turned_head():
    rng = np.random.default_rng(2)
    light = room_light(rng, np.array([0.8, 0.3, 0.5]))
    R = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    d = rng.standard_normal((20, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    np.testing.assert_allclose(light.turned(R).radiance(d @ R.T), light.radiance(d), rtol=1e-12)


def test_occlusion_in_the_open_and_beside_a_wall():
    """Nothing above a floor: 1. At the foot of an endless wall half the light is gone, from the wall's side."""
    wall = np.array([[0, -1e5, -1e5], [0, 1e5, -1e5], [0, 1e5, 1e5], [0, -1e5, 1e5]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    normal = np.array([[0, 0, 1.0]])
    open_, bent = occlusion(wall, faces, np.array([[1.0, 0, 0]]), normal, rays=400)
    assert open_[0] == pytest.approx(0.5, abs=0.02)
    assert bent[0, 0] > 0.3
    open_, bent = occlusion(wall, faces, np.array([[5e4, 0, 2e5]]), normal, rays=100)
    assert open_[0] == 1
    np.testing.assert_allclose(bent, normal, atol=0.02)


def test_noise_is_centred_of_unit_size_and_repeats():
    p = plane(300, 300)
    for octaves in (1, 4):
        values = fractal(p, 11.0, octaves, 3)
        assert abs(values.mean()) < 0.1
        assert 0.6 < values.std() < 1.3
    assert (fractal(p, 11.0, 2, 3) == fractal(p, 11.0, 2, 3)).all()
    assert (fractal(p, 11.0, 2, 3) != fractal(p, 11.0, 2, 4)).mean() > 0.9
    distance, label = cells(p, 20.0, 1)
    assert distance.min() >= 0
    assert distance.max() < 40
    assert 0.4 < label.mean() < 0.6


def test_cells_leave_no_nearer_point_out() -> None:
    """Against all 27 cells about each place."""
    p = np.random.default_rng(1).uniform(-40, 40, (60, 3)).astype(np.float32)
    size, seed = 7.0, 5
    hashed = noise._hash.py_func
    found = []
    for x in p.astype(float) / size:
        near = []
        for step in np.ndindex(3, 3, 3):
            cell = [int(c) for c in np.floor(x) + step - 1]
            h = hashed(*(c + int(noise._LATTICE) for c in cell), seed)
            g = hashed(h & 0xFFFFF, (h >> 12) & 0xFFFFF, 7, seed + 1)
            scattered = np.array(cell) + np.array([h & 1023, (h >> 10) & 1023, g & 1023]) / 1023
            near.append(np.linalg.norm(scattered - x))
        found.append(size * min(near))
    np.testing.assert_allclose(cells(p, size, seed)[0], found, rtol=1e-4)


def test_a_matt_head_in_uniform_light_shows_its_albedo():
    """The furnace: albedo 0.5 everywhere, no gloss, nothing occluded, light 1 from everywhere: every pixel is 0.5."""
    template = synthetic.template()
    surface = np.zeros((8, 8, 6), np.float32)
    surface[..., :3] = 0.5
    normals = vertex_normals(template.mean, template.triangles)
    head = Skin(
        template.mean,
        normals,
        vertex_tangents(template.mean, template),
        normals,
        np.ones(len(template.mean)),
        template.triangles,
        template.uv,
        template.uv_triangles,
        build_mipmap(surface),
    )
    camera = sweep(np.random.default_rng(0), 3, (90, 120))[1].camera
    picture = draw(camera, [], [head], constant_light(), 1)
    seen = picture[..., 0] > 0
    assert seen.mean() > 0.1
    np.testing.assert_allclose(picture[seen], 0.5, atol=2e-3)


def test_the_sweep_covers_the_semicircle_at_three_heights():
    shots = sweep(np.random.default_rng(1), 40, (480, 640))
    yaw, pitch = np.array([s.yaw for s in shots]), np.array([s.pitch for s in shots])
    assert yaw.min() < -78
    assert yaw.max() > 78
    assert np.diff(np.sort(yaw[np.abs(pitch) < 10])).max() < 16
    assert (pitch > 12).sum() >= 6
    assert (pitch < -12).sum() >= 4
    for shot in shots:
        # The position that yaw and pitch tell is that of R and t.
        x, y, z = shot.camera.centre - [0, -28, -38]
        assert np.degrees(np.arctan2(x, z)) == pytest.approx(shot.yaw, abs=8)
        assert np.degrees(np.arctan2(y, np.hypot(x, z))) == pytest.approx(shot.pitch, abs=8)


def test_performance_shows_most_shapes_and_keeps_the_rules():
    clip = perform(np.random.default_rng(0), 12, 30, (540, 960))
    w = clip.weights
    assert w.shape == (360, 52)
    assert w.min() >= 0
    assert w.max() <= 1
    assert (w.max(axis=0) > 0.3).sum() >= 46
    close, jaw = w[:, ARKIT_NAMES.index("mouthClose")], w[:, ARKIT_NAMES.index("jawOpen")]
    assert (close <= jaw + 1e-12).all()
    assert w[0].max() < 0.1
    left, right = w[:, ARKIT_NAMES.index("mouthSmileLeft")], w[:, ARKIT_NAMES.index("mouthSmileRight")]
    assert np.abs(left - right).max() > 0.5


def test_wrinkles_rest_at_rest_and_grow():
    assert max(gains({}).values()) == 0
    half, full = gains({"browInnerUp": 0.5}), gains({"browInnerUp": 1.0, "browOuterUpLeft": 1, "browOuterUpRight": 1})
    assert 0 < half["forehead"] < full["forehead"]
    assert full["chin"] == 0


def test_the_person_is_outside_the_template_and_eyes_are_centred():
    template = synthetic.template()
    subject = random_subject(template, np.random.default_rng(5))
    np.testing.assert_allclose(subject.eye_centres.mean(axis=0), 0, atol=1e-9)
    face = np.nonzero(template.regions["face"] & ~template.regions["mouth"] & ~template.regions["sockets"])[0]
    shift = np.tile(np.eye(3), (len(face), 1, 1)).transpose(1, 2, 0).reshape(3, -1)
    turn = np.cross(np.eye(3)[:, None], template.mean[None, face]).transpose(0, 2, 1).reshape(3, -1)
    basis = np.concatenate(
        [template.identity[:, face].transpose(0, 2, 1).reshape(len(template.identity), -1), shift, turn]
    )
    away = (subject.neutral - template.mean)[face].T.reshape(-1)
    rest = away - basis.T @ np.linalg.lstsq(basis.T, away, rcond=None)[0]
    outside = np.linalg.norm(rest.reshape(3, -1), axis=0).mean()
    assert 0.15 < outside < 1.5
    weights = np.zeros(52)
    weights[[ARKIT_NAMES.index("mouthSmileLeft"), ARKIT_NAMES.index("jawOpen")]] = 1
    alone = sum(subject.deltas(w) for w in np.eye(52)[weights > 0])
    assert 0.2 < np.abs(subject.deltas(weights) - alone).max() < 15


@pytest.fixture(scope="module")
def small():
    return synthetic.capture(photos=6, video_seconds=0.4, video_fps=15)


def test_photos_read_back_upright_with_their_lens(small):
    told = json.loads((synthetic.truth_folder(small) / "cameras.json").read_text())
    assert len(told["photos"]) == len(list((small / "photos").iterdir())) == 6
    for photo in told["photos"]:
        read = read_photo(small / "photos" / photo["file"])
        assert read.rgb.shape == (photo["height"], photo["width"], 3)
        assert read.focal == pytest.approx(photo["K"][0][0], rel=0.01)
        assert read.rgb.std() > 20


def test_truth_agrees_with_itself(small):
    folder = synthetic.truth_folder(small)
    mesh, video = np.load(folder / "mesh.npz"), np.load(folder / "video.npz")
    frames = len(video["weights"])
    assert frames == 6 == sum(1 for _ in decode_frames(small / "video" / "MOV_0001.mp4"))
    template = synthetic.template()
    order = truth.order_of(template)
    np.testing.assert_array_equal(mesh["template_vertex"], order.vertex)
    assert (order.place[order.vertex] == np.arange(len(order.vertex))).all()
    m = video["delta"].shape[1]
    linear = np.tensordot(video["weights"], mesh["true"].astype(np.float32), 1)
    # Only the correctives of pairs are missing from the linear sum.
    assert np.abs(linear - video["delta"]).max() < 6
    assert np.median(np.abs(linear - video["delta"])) < 0.02
    for f in range(frames):
        X = mesh["neutral"][:m] + video["delta"][f].astype(np.float64)
        X = X @ video["head_pose"][f, :3, :3].T + video["head_pose"][f, :3, 3]
        X = X[mesh["lm68"]] @ video["cam_R"][f].T + video["cam_t"][f]
        k1, k2, p1, p2, k3 = video["dist"]
        x, y = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        pixels = np.stack([u, v], 1) * [video["K"][0, 0], video["K"][1, 1]] + video["K"][:2, 2]
        assert np.abs(pixels - video["landmarks68"][f]).max() < 0.05
        assert video["landmarks68_visible"][f, 17:].mean() > 0.8


def test_truth_holds_what_a_scorer_needs(small):
    folder = synthetic.truth_folder(small)
    with np.load(folder / "mesh.npz") as mesh:
        near = np.linalg.norm(mesh["neutral"] - mesh["neutral"][mesh["lm68"][30]], axis=1)
        face_faces = (mesh["tri"] < truth.FACE).all(axis=1)
        assert (near[: truth.NARROW] < 130).all()
        assert (mesh["material"][face_faces] == 0).all()
        assert mesh["uv_index"].max() < len(mesh["uv"])
        assert mesh["lm68"].max() < truth.FACE
    with np.load(folder / "visibility.npz") as seen:
        assert seen["photo_count"].max() == 6
        assert seen["photo_count"][:3000].mean() > 2.5
        assert seen["photo_count"].min() == 0
    normals = sorted(folder.glob("normals_*.npz"))
    assert len(normals) == 5
    with np.load(normals[0]) as told:
        n = told["normal"][told["mask"]].astype(float) / 127
        np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=0.02)
        assert (n[:, 2] < 0.3).mean() > 0.99
        assert n[:, 2].mean() < -0.6
    with np.load(folder / "light.npz") as light:
        assert light["photo_SH"].shape == (3, 9)
        assert light["photo_env"].shape == (96, 192, 3)


def test_photos_alone_leave_a_video_of_no_frames():
    with np.load(synthetic.truth_folder(synthetic.capture(photos=6)) / "video.npz") as video:
        m = video["delta"].shape[1]
        assert video["delta"].shape == (0, m, 3)
        assert video["weights"].shape == (0, 52)
        assert video["cam_R"].shape == (0, 3, 3)
    assert m > 9000


def test_photos_show_the_face_where_the_truth_says():
    """The shipped landmark network finds the inner landmarks of a frontal photo near their true places."""
    from avatarbuild.landmarks import find_faces

    folder = synthetic.capture(seed=4, photos=5, photo_width=360, texture=1024)
    known = synthetic.truth(folder)
    name = "IMG_0002.JPG"
    faces = find_faces(read_photo(folder / "photos" / name).rgb)
    assert len(faces) == 1
    template = synthetic.template()
    pixels, _ = known.cameras[name].project(known.neutral[known.landmarks68])
    found = faces[0].points[template.landmarks68, :2]
    eyes = np.linalg.norm(pixels[36] - pixels[45])
    error = np.linalg.norm(found - pixels, axis=1)[17:] / eyes
    assert error.mean() < 0.06


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    options = SimulationOptions(
        photos=2, photo_width=120, video_seconds=0.2, video_fps=10, video_width=96, texture=256, second_person=True
    )
    template = synthetic.template()
    for name in ("one", "two"):
        simulate(tmp_path / name, 9, options, template=template)
    for path in sorted((tmp_path / "one").rglob("*.*")) + sorted((tmp_path / "one.truth").iterdir()):
        other = tmp_path / str(path.relative_to(tmp_path)).replace("one", "two", 1)
        assert path.read_bytes() == other.read_bytes(), path.name


def test_other_seeds_give_other_people(small):
    other = synthetic.capture(seed=2, photos=6, video_seconds=0.4, video_fps=15)
    one = (small / "photos" / "IMG_0003.JPG").read_bytes()
    assert one != (other / "photos" / "IMG_0003.JPG").read_bytes()


def test_head_turns_are_told_from_the_head(tmp_path):
    """Cameras are relative to the head: with turns they differ from the room's by room_from_head."""
    folder = synthetic.capture(photos=4, photo_width=160, texture=256, head_turn=5.0, expression_drift=0.2)
    told = json.loads((synthetic.truth_folder(folder) / "cameras.json").read_text())
    turns = [np.array(photo["room_from_head"]) for photo in told["photos"]]
    assert max(np.degrees(np.arccos((np.trace(T[:3, :3]) - 1) / 2)) for T in turns) > 2
    plain = synthetic.capture(photos=4, photo_width=160, texture=256)
    still = json.loads((synthetic.truth_folder(plain) / "cameras.json").read_text())
    assert all(np.allclose(photo["room_from_head"], np.eye(4)) for photo in still["photos"])


def test_bad_requests_are_told_in_one_line(tmp_path):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "x.txt").write_text("x")
    with pytest.raises(InputError, match="not empty"):
        simulate(tmp_path / "taken", 0, SimulationOptions(photos=1))
    with pytest.raises(InputError, match="photo_width"):
        simulate(tmp_path / "a", 0, SimulationOptions(photo_width=3))
    with pytest.raises(InputError, match="neither"):
        simulate(tmp_path / "b", 0, SimulationOptions(photos=0, video_seconds=0))


def test_synthetic_scene_is_consistent_across_views():
    """The colour of a surface point is the same in every picture that sees it."""
    scene = synthetic.scene(3, (200, 150))
    points = scene.vertices[(np.abs(scene.vertices[:, :2]) < 50).all(axis=1)][::37]
    colours = []
    for image, camera in zip(scene.images, scene.cameras):
        pixels, _ = camera.project(points)
        j, i = np.floor(pixels).astype(int).T
        colours.append(image[i, j, 1])
    assert np.corrcoef(colours[0], colours[2])[0, 1] > 0.75

"""The points stage on a textured ball with known cameras; COLMAP's dense files."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest
import stereo_scenes as scenes
import synthetic

from avatarbuild.artefacts import Cameras, Capture, StoredImage
from avatarbuild.errors import InputError
from avatarbuild.formats import colmap_dense
from avatarbuild.geometry import patchmatch, stereo_views
from avatarbuild.options import PointsOptions
from avatarbuild.progress import Silent
from avatarbuild.stages import points

MIDDLE = np.array([0.0, -10.0, -75.0])  # of the head region
RADIUS = 90.0
SIZE = (288, 288)
OPTIONS = PointsOptions(max_image_size=288, least_piece=50, eyeballs=True)
ANGLES = ((-13, 3), (0, 0), (13, -3), (5, 16), (-8, -15))
K1 = 0.05


def photograph(pose, blur=0.0) -> bytes:
    """A JPEG of the ball through a lens with radial distortion K1."""
    K = scenes.calibration(300.0, *SIZE)
    lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=288, height=288, params=[300.0, 144.0, 144.0, K1])
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    flat = np.asarray(lens.cam_from_img(np.stack([u.ravel() + 0.5, v.ravel() + 0.5], axis=1))) * 300.0 + 143.5
    big = scenes.calibration(300.0, 400, 400)  # a wider pinhole image to take the lens's pixels from
    grey = scenes.picture(big, *pose, scenes.sphere_depth(big, *pose, (400, 400), MIDDLE, RADIUS))
    x, y = (flat.reshape(*SIZE, 2) + 56.0).astype(np.float32).transpose(2, 0, 1)
    image = cv2.remap(grey.astype(np.float32), x, y, cv2.INTER_CUBIC)
    if blur:
        image = cv2.GaussianBlur(image, (0, 0), blur)
    image = np.clip(image, 0, 255).astype(np.uint8)
    assert K[0, 0] == lens.params[0]
    return cv2.imencode(".jpg", np.repeat(image[..., None], 3, axis=2), [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()


def ball(angles=ANGLES, blur=None, metric=True) -> tuple[Capture, Cameras]:
    """A capture of the ball and its true cameras, in the head frame."""
    poses = [scenes.orbit(a, b, 420.0, MIDDLE) for a, b in angles]
    k = len(poses)
    names = [f"IMG_{i:04d}" for i in range(k)]
    images = [StoredImage(photograph(p, (blur or {}).get(i, 0.0))) for i, p in enumerate(poses)]
    views = synthetic.views(names, names, SIZE, images, focal=np.full(k, 300.0))
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=[300.0, 144.0, 144.0, K1], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    for i, (R, t) in enumerate(poses):
        image = pycolmap.Image(name=f"{names[i]}.jpg", camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(R), t))
    return Capture(views, None, -1, np.ones(k, bool), False), Cameras(model, metric, {"source": "none"})


def map_bytes(values: np.ndarray) -> bytes:
    """A map (h, w[, c]) as COLMAP writes it."""
    h, w = values.shape[:2]
    planes = np.moveaxis(values.reshape(h, w, -1), -1, 0)
    return f"{w}&{h}&{len(planes)}&".encode("ascii") + planes.astype("<f4").tobytes()


@pytest.fixture(scope="module", autouse=True)
def three_levels():
    """The photos are small: let the pyramid begin lower."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(points, "COARSE_SIZE", 72)
        yield


@pytest.fixture(scope="module")
def cloud(three_levels):
    return points.run(*ball(), OPTIONS, Silent())


def test_the_ball_is_found(cloud):
    offset = cloud.points - MIDDLE
    distance = np.linalg.norm(offset, axis=1)
    error = np.abs(distance - RADIUS)
    assert 0.005 < np.median(error) < 0.3  # a pixel is 1.1 mm
    assert np.quantile(error, 0.95) < 1.2
    assert (error > 3.0).mean() < 0.01
    outward = (offset / distance[:, None] * cloud.normals).sum(axis=1)
    assert np.median(np.degrees(np.arccos(np.clip(outward, -1, 1)))) < 6
    assert cloud.views.min() >= OPTIONS.min_views


def test_the_ball_is_covered(cloud):
    """Every point of the front within 40 degrees of the middle view has a cloud point within 2 mm."""
    rng = np.random.default_rng(1)
    d = rng.normal(size=(4000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    front = MIDDLE + RADIUS * d[d[:, 2] > np.cos(np.radians(40))]
    gap = np.sqrt(((front[:, None, :] - cloud.points[None, ::2]) ** 2).sum(axis=-1).min(axis=1))
    assert (gap < 2.0).mean() > 0.97


def test_threads_change_no_bit(cloud, monkeypatch):
    monkeypatch.setattr(points, "cores", lambda: 1)
    again = points.run(*ball(), OPTIONS, Silent())
    for name in ("points", "normals", "colours", "views"):
        assert getattr(again, name).tobytes() == getattr(cloud, name).tobytes(), name


def test_without_a_scale_the_region_comes_from_the_cameras(cloud):
    capture, cameras = ball(metric=False)
    region = points.subject(cameras)
    assert np.linalg.norm(region.centre - MIDDLE) < 1.0
    assert region.axes[0] > RADIUS
    free = points.run(capture, cameras, OPTIONS, Silent())
    assert len(free.points) > 0.8 * len(cloud.points)


def test_photos_that_do_not_overlap_are_refused():
    with pytest.raises(InputError, match="overlap"):
        points.run(*ball(((-90, 0), (0, 0), (90, 0))), OPTIONS, Silent())


def test_two_photos_are_refused():
    with pytest.raises(InputError, match="2 placed photos"):
        points.run(*ball(((0, 0), (13, 0))), OPTIONS, Silent())


def test_a_blurred_photo_gives_no_points():
    cloud = points.run(*ball(blur={1: 3.0}), OPTIONS, Silent())
    assert cloud.figures["reference_views"] == len(ANGLES) - 1
    assert any("IMG_0001" in warning for warning in cloud.warnings)


def test_small_photos_work():
    cloud = points.run(*ball(), PointsOptions(max_image_size=200, least_piece=20), Silent())
    assert np.median(np.abs(np.linalg.norm(cloud.points - MIDDLE, axis=1) - RADIUS)) < 0.5


def test_sources_surround_the_reference_and_shun_blur():
    angle = np.abs(np.subtract.outer(np.arange(-60.0, 61, 5), np.arange(-60.0, 61, 5)))
    k = len(angle)
    even, all_of_it = np.ones(k), np.ones((k, k))
    chosen = stereo_views.choose_sources(angle, even, even, all_of_it, 4)
    middle = np.array(chosen[12]) - 12
    assert (middle > 0).any()
    assert (middle < 0).any()
    assert (np.abs(middle) * 5 <= 30).all()
    sharp = even.copy()
    sharp[chosen[12][0]] = 0.3
    assert chosen[12][0] not in stereo_views.choose_sources(angle, even, sharp, all_of_it, 2)[12]
    assert stereo_views.choose_sources(np.full((2, 2), 70.0), np.ones(2), np.ones(2), np.ones((2, 2)), 3) == [[], []]


def test_region_bounds_by_hand():
    """A ball of radius 10, 100 before a camera: depths 90 to 110 in the middle, nothing beyond asin(0.1)."""
    region = stereo_views.Region(np.zeros(3), np.full(3, 10.0))
    K = scenes.calibration(100.0, 41, 41)
    low, high = stereo_views.region_bounds(region, K, np.eye(3), np.array([0.0, 0.0, 100.0]), (41, 41))
    assert 1 / low[20, 20] == pytest.approx(110.0)
    assert 1 / high[20, 20] == pytest.approx(90.0)
    rim = 100 * np.tan(np.arcsin(0.1))
    assert (high[20] > 0).sum() == 2 * int(rim) + 1
    box = stereo_views.silhouette_box(region, K, np.eye(3), np.array([0.0, 0.0, 100.0]))
    assert np.allclose(box, [20.5 - rim, 20.5 - rim, 20.5 + rim, 20.5 + rim])


def test_sharpness_falls_with_blur_in_one_direction():
    grey = scenes.texture(np.stack([*np.meshgrid(np.arange(120.0), np.arange(120.0)), np.zeros((120, 120))], axis=-1))
    grey = grey.astype(np.float32)
    moved = cv2.blur(grey, (5, 1))
    assert stereo_views.sharpness(moved) < 0.9 * stereo_views.sharpness(grey)


def test_colmap_maps_round_trip_and_read_as_colmap_does(tmp_path):
    values = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    data = map_bytes(values)
    assert data.startswith(b"4&2&3&")
    assert np.frombuffer(data[6:], "<f4")[:8].tolist() == values[..., 0].ravel().tolist()
    assert np.array_equal(colmap_dense.read_map(data), values)
    for bad in (b"", b"4&2&3&", b"a&b&c&", data[:-1]):
        with pytest.raises(ValueError):
            colmap_dense.read_map(bad)
    (tmp_path / "d.bin").write_bytes(map_bytes(values[..., 0]))
    if hasattr(pycolmap, "DepthMap") and hasattr(pycolmap.DepthMap, "read"):
        depth = pycolmap.DepthMap()
        depth.read(str(tmp_path / "d.bin"))


def test_planes_from_depth_and_normals_are_those_they_came_from():
    v, u = np.mgrid[:6, :5] + 0.5
    q = 0.01 + 1e-4 * u - 2e-4 * v
    planes = np.stack([q, np.full_like(q, 1e-4), np.full_like(q, -2e-4)], axis=-1).astype(np.float32)
    K = scenes.calibration(80.0, 5, 6)
    back = colmap_dense.planes_of(1.0 / planes[..., 0], patchmatch.plane_normals(planes, K), K)
    assert np.allclose(back, planes, rtol=1e-4)
    unknown = colmap_dense.planes_of(np.zeros((6, 5)), np.zeros((6, 5, 3)), K)
    assert not unknown.any()


def test_the_card_backend_fuses_maps_in_colmaps_layout(cloud, monkeypatch):
    """COLMAP's PatchMatch replaced by one that writes the ball's true maps: workspace, reading, fusion."""

    def true_maps(folder, nearest, farthest, half_window, count):
        model = pycolmap.Reconstruction(str(folder / "sparse"))
        wanted = (folder / "stereo" / "patch-match.cfg").read_text().splitlines()[::2]
        for image in model.images.values():
            assert (folder / "images" / image.name).exists()
            if image.name not in wanted:
                continue
            camera = model.cameras[image.camera_id]
            pose = image.cam_from_world().matrix()
            K, shape = camera.calibration_matrix(), (camera.height, camera.width)
            z = scenes.sphere_depth(K, pose[:, :3], pose[:, 3], shape, MIDDLE, RADIUS)
            hit = np.isfinite(z)
            assert nearest <= z[hit].min() < z[hit].max() <= farthest
            centre, rays = scenes.rays(K, pose[:, :3], pose[:, 3], shape)
            z = np.where(hit, z, 0.0)
            normal = np.where(hit[..., None], centre + rays * z[..., None] - MIDDLE, 0.0) / RADIUS @ pose[:, :3].T
            for kind, values in (("depth", z), ("normal", normal)):
                path = folder / "stereo" / f"{kind}_maps" / f"{image.name}.geometric.bin"
                path.write_bytes(map_bytes(values))

    monkeypatch.setattr(colmap_dense, "run_patch_match", true_maps)
    monkeypatch.setattr(points, "card_at_hand", lambda: True)
    fused = points.run(*ball(), PointsOptions(max_image_size=288, least_piece=50, backend="cuda"), Silent())
    error = np.abs(np.linalg.norm(fused.points - MIDDLE, axis=1) - RADIUS)
    assert 1e-4 < np.median(error) < 0.02
    assert len(fused.points) > 0.8 * len(cloud.points)


def test_the_card_backend_needs_a_card(monkeypatch):
    monkeypatch.setattr(points, "card_at_hand", lambda: False)
    with pytest.raises(InputError, match="CUDA"):
        points.run(*ball(((0, 0), (13, 0), (-13, 0))), PointsOptions(backend="cuda"), Silent())

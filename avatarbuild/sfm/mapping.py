"""From verified matches to cameras: COLMAP's database and incremental mapper, and the last bundle adjustment."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from avatarbuild.sfm.features import Features

Verified = dict[tuple[int, int], pycolmap.TwoViewGeometry]


def _write_database(
    path: Path,
    names: list[str],
    features: list[Features],
    cameras: list[pycolmap.Camera],
    camera_of: np.ndarray,
    pairs: Verified,
) -> None:
    with pycolmap.Database.open(str(path)) as database:
        ids = []
        for camera in cameras:
            number = database.write_camera(camera)
            rig = pycolmap.Rig()
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
            rig.add_ref_sensor(sensor)
            ids.append((number, database.write_rig(rig), sensor))
        images = []
        for name, f, lens in zip(names, features, camera_of):
            camera_id, rig_id, sensor = ids[lens]
            image = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(pycolmap.data_t(sensor, image))
            database.write_frame(frame)
            database.write_keypoints(image, np.ascontiguousarray(f.points))
            images.append(image)
        for (i, j), geometry in sorted(pairs.items()):
            database.write_matches(images[i], images[j], geometry.inlier_matches)
            database.write_two_view_geometry(images[i], images[j], geometry)


def map_photos(
    names: list[str],
    features: list[Features],
    cameras: list[pycolmap.Camera],
    camera_of: np.ndarray,
    pairs: Verified,
    tell: Callable[[], None],
) -> list[pycolmap.Reconstruction]:
    """
    Incremental structure from motion [Schoenberger & Frahm 2016] of k photos; `cameras` hold the focal priors, photo i
    has cameras[camera_of[i]]. `tell` is called after each placed photo. Returns the models, largest first.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.num_threads = 1  # several threads add residuals in a changing order: other bytes every time
    options.extract_colors = False
    options.min_model_size = 3
    options.ba_use_gpu = False
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        _write_database(database, names, features, cameras, camera_of, pairs)
        models = pycolmap.incremental_mapping(
            str(database), folder, str(Path(folder) / "models"), options=options, next_image_callback=tell
        )
    return sorted(models.values(), key=lambda m: (-m.num_reg_images(), -m.num_points3D()))


def refine_lens(model: pycolmap.Reconstruction) -> None:
    """
    Replaces each camera's model by OPENCV (k1, k2, p1, p2) and adjusts cameras, points and lens once more, in place:
    the radial term alone leaves half a pixel in the corners of phone lenses.
    """
    for number in sorted(model.cameras):
        camera = model.cameras[number]
        if camera.model != pycolmap.CameraModelId.SIMPLE_RADIAL:
            continue
        f, cx, cy, k = camera.params
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = [f, f, cx, cy, k, 0.0, 0.0, 0.0]
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)

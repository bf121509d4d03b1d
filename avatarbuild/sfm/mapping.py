"""From verified matches to cameras: COLMAP's incremental mapper on the largest features, then all of them."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from avatarbuild.sfm.adjustment import adjust
from avatarbuild.sfm.features import Features
from avatarbuild.sfm.focal import longer_fits

log = logging.getLogger(__name__)

Verified = dict[tuple[int, int], pycolmap.TwoViewGeometry]

# The mapper's time grows with its points: the largest features of each photo place the cameras, then all features are
# triangulated and adjusted together.
_SKELETON = 1800
_LEAST_MATCHES = 15
_FAR, _NEAR = 4.0, 2.0  # pixels: observations further from their point are dropped, before and after the adjustment
_LEAST_ANGLE = 1.5  # degrees between the rays of a point
_REGROWN = (16.0, 8.0, 4.0, _NEAR)  # pixels
_LEAST_SEEN = 8  # points of a photo
# A guess too long comes right, one too short may not: even 0.93 of the truth has been seen to end at 0.72 of it.
_RESTARTS, _AGAIN = 3, 2.0


def _options() -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.num_threads = 1  # several threads add residuals in a changing order: other bytes every time
    options.extract_colors = False
    options.min_model_size = 3
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = 1e-5
    options.ba_global_max_num_iterations = 30
    options.ba_global_max_refinements = 2
    return options


def _write_database(
    path: Path,
    names: list[str],
    features: list[Features],
    cameras: list[pycolmap.Camera],
    camera_of: np.ndarray,
    pairs: Verified,
    largest: int | None,
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
            matches = geometry.inlier_matches
            if largest is not None:
                matches = matches[(matches < largest).all(axis=1)]
            if len(matches) < _LEAST_MATCHES:
                continue
            part = pycolmap.TwoViewGeometry(geometry.todict() | {"inlier_matches": matches})
            database.write_matches(images[i], images[j], matches)
            database.write_two_view_geometry(images[i], images[j], part)


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
    has cameras[camera_of[i]]. `tell` is called after each placed photo. Returns the models, largest first; the first
    one has all its features and OPENCV lenses.
    """
    with tempfile.TemporaryDirectory() as folder:
        full = str(Path(folder) / "full.db")
        models = _skeletons(names, features, cameras, camera_of, pairs, tell, Path(folder))
        if models:
            _free_lenses(models[0])
            adjust(models[0])
            freed = [models[0].cameras[number] for number in range(1, len(cameras) + 1)]
            _write_database(Path(full), names, features, freed, camera_of, pairs, None)
            models[0] = pycolmap.triangulate_points(
                models[0], full, folder, str(Path(folder) / "dense"), clear_points=True, options=_options()
            )
            if models[0].num_reg_images() < len(names):
                models[0] = _place_the_rest(models[0], full, folder, tell)
            for furthest in (_FAR, _NEAR):
                _drop_outliers(models[0], furthest)
                adjust(models[0])
            _drop_outliers(models[0], _NEAR)
    return models


def _skeletons(
    names: list[str],
    features: list[Features],
    cameras: list[pycolmap.Camera],
    camera_of: np.ndarray,
    pairs: Verified,
    tell: Callable[[], None],
    folder: Path,
) -> list[pycolmap.Reconstruction]:
    """
    Models of the largest features, largest first. Where longer focal lengths would explain the photos better, the
    mapper starts from those again; the models that place the most photos with the most observations win.
    """
    best: list[pycolmap.Reconstruction] = []
    for number in range(1 + _RESTARTS):
        database, models = str(folder / f"skeleton{number}.db"), str(folder / f"models{number}")
        _write_database(Path(database), names, features, cameras, camera_of, pairs, _SKELETON)
        found = pycolmap.incremental_mapping(
            database, str(folder), models, options=_options(), next_image_callback=tell if number == 0 else _nothing
        )
        here = sorted(found.values(), key=lambda m: (-m.num_reg_images(), -m.num_points3D()))
        if not here or (best and _worth(here[0]) <= _worth(best[0])):
            break
        best = here
        if not longer_fits(here[0]):
            break
        focal = {k: _AGAIN * here[0].cameras[k].mean_focal_length() for k in sorted(here[0].cameras)}
        log.info("a longer lens fits better, the mapper starts again from these focal lengths: %s", focal)
        cameras = [_with_focal(camera, focal.get(i + 1)) for i, camera in enumerate(cameras)]
    return best


def _nothing() -> None: ...


def _worth(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.compute_num_observations()


def _with_focal(camera: pycolmap.Camera, focal: float | None) -> pycolmap.Camera:
    """The camera as it is known beforehand, with another focal length."""
    if focal is None:
        return camera
    other = pycolmap.Camera.create_from_model_id(camera.camera_id, camera.model, focal, camera.width, camera.height)
    other.has_prior_focal_length = camera.has_prior_focal_length
    return other


def regrow(
    model: pycolmap.Reconstruction,
    names: list[str],
    features: list[Features],
    camera_of: np.ndarray,
    pairs: Verified,
) -> pycolmap.Reconstruction:
    """
    The model's cameras adjusted to the points of other `pairs` (those of a head that turned, say), lenses kept: points
    are triangulated within ever smaller errors. Photos that see too few of them are left out.
    """
    with tempfile.TemporaryDirectory() as folder:
        database = str(Path(folder) / "pairs.db")
        lenses = [model.cameras[number] for number in sorted(model.cameras)]
        _write_database(Path(database), names, features, lenses, camera_of, pairs, None)
        for furthest in _REGROWN:
            options = _options()
            options.ba_refine_focal_length = options.ba_refine_extra_params = False
            options.mapper.filter_max_reproj_error = furthest
            options.triangulation.complete_max_reproj_error = options.triangulation.merge_max_reproj_error = furthest
            angle = np.degrees(furthest / max(lens.mean_focal_length() for lens in lenses))
            options.triangulation.create_max_angle_error = options.triangulation.continue_max_angle_error = angle
            model = pycolmap.triangulate_points(
                model, database, folder, str(Path(folder) / f"within{furthest:g}"), clear_points=True, options=options
            )
            adjust(model, lens=False)
            _drop_outliers(model, furthest)
    for number in sorted(model.reg_image_ids()):
        if model.images[number].num_points3D < _LEAST_SEEN:
            model.deregister_frame(model.images[number].frame_id)
    return model


def _place_the_rest(
    model: pycolmap.Reconstruction, database: str, folder: str, tell: Callable[[], None]
) -> pycolmap.Reconstruction:
    """Photos that share too few large features with the others are placed with all their features."""
    start, more = Path(folder) / "start", Path(folder) / "more"
    start.mkdir()
    model.write_binary(str(start))
    options = _options()
    options.multiple_models = False
    found = pycolmap.incremental_mapping(
        database, folder, str(more), options=options, input_path=str(start), next_image_callback=tell
    )
    return max([model, *found.values()], key=lambda m: m.num_reg_images())


def _free_lenses(model: pycolmap.Reconstruction) -> None:
    # SIMPLE_RADIAL leaves half a pixel in the corners of phone lenses.
    for number in sorted(model.cameras):
        camera = model.cameras[number]
        if camera.model != pycolmap.CameraModelId.SIMPLE_RADIAL:
            continue
        f, cx, cy, k = camera.params
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = [f, f, cx, cy, k, 0.0, 0.0, 0.0]


def _drop_outliers(model: pycolmap.Reconstruction, furthest: float) -> None:
    pycolmap.ObservationManager(model).filter_all_points3D(furthest, _LEAST_ANGLE)

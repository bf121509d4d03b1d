"""Whether a longer focal length would explain a model's photos better: a wrong first guess can trap the mapper."""

from __future__ import annotations

import numpy as np
import pycolmap

from avatarbuild.sfm.adjustment import adjust

# Half the true focal length ends, with a strong distortion, at 0.72 of it: a minimum of its own, where cameras on an
# arc are too near the head and the arc too wide. Guesses from 0.75 to 4 times the truth all come out right.
_LONGER = 1.4
_BETTER = 0.93  # of the cost: a model in its right minimum comes back to 1.000 of it
_ENOUGH = 60  # observations a photo are enough to tell


def longer_fits(model: pycolmap.Reconstruction) -> bool:
    """
    Whether a model came to rest at focal lengths that are too short.

    A dolly zoom: focal lengths grow by a factor, cameras step back by as much of their distance, and few points with
    long tracks are adjusted with them. Costs are the adjustment's, sum sqrt(1 + e^2) - 1 over observations.
    """
    few = _fewer(model)
    zoomed = _dolly_zoom(few, _LONGER)
    adjust(few)
    adjust(zoomed)
    return _cost(zoomed) < _BETTER * _cost(few)


def _fewer(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A copy with the points of longest tracks, as many as it takes for `_ENOUGH` in every photo that has them."""
    few = pycolmap.Reconstruction(model)
    count = dict.fromkeys(few.reg_image_ids(), 0)
    for number in sorted(few.point3D_ids(), key=lambda n: (-few.points3D[n].track.length(), n)):
        images = [element.image_id for element in few.points3D[number].track.elements]
        if min(count[i] for i in images) >= _ENOUGH:
            few.delete_point3D(number)
            continue
        for i in images:
            count[i] += 1
    return few


def _dolly_zoom(model: pycolmap.Reconstruction, factor: float) -> pycolmap.Reconstruction:
    """A copy with longer lenses without distortion, its cameras back by as much: what stands midway keeps its size."""
    zoomed = pycolmap.Reconstruction(model)
    for number in sorted(zoomed.cameras):
        camera = zoomed.cameras[number]
        longer = pycolmap.Camera.create_from_model_id(
            number, camera.model, factor * camera.mean_focal_length(), camera.width, camera.height
        )
        camera.params = list(longer.params)
    for number in zoomed.reg_image_ids():
        image = zoomed.images[number]
        seen = [zoomed.points3D[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
        if not seen:
            continue
        pose = image.cam_from_world()
        depth = float(np.median(np.array(seen) @ pose.rotation.matrix()[2] + pose.translation[2]))
        back = pose.translation + np.array([0.0, 0.0, (factor - 1.0) * depth])
        zoomed.frames[image.frame_id].set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose.rotation, back))
    return zoomed


def _cost(model: pycolmap.Reconstruction) -> float:
    model.update_point_3d_errors()
    points = [model.points3D[number] for number in sorted(model.point3D_ids())]
    errors = np.array([point.error for point in points])
    return float(np.array([point.track.length() for point in points]) @ (np.hypot(1.0, errors) - 1.0))

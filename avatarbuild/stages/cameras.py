"""Stage cameras: structure from motion, in millimetres and the head frame where the photos show a face."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pycolmap

from avatarbuild.artefacts import Cameras, Capture
from avatarbuild.errors import InputError
from avatarbuild.landmarks import TRUSTED_PRESENCE, TRUSTED_YAW, canonical_face
from avatarbuild.options import CamerasOptions
from avatarbuild.parallel import in_order
from avatarbuild.progress import Progress
from avatarbuild.sfm import head, matching, metric
from avatarbuild.sfm.features import Features, extract
from avatarbuild.sfm.mapping import Verified, map_photos, regrow

log = logging.getLogger(__name__)

LEAST_MATCHES = 15
LEAST_PLACED = 3
# of the photos must be placed by the head's features alone; else the whole set's cameras are adjusted to it
ENOUGH = 0.8
DEFAULT_FOCAL = 1.2  # times the longer side, COLMAP's own guess where nothing is known
SHORTEST_FOCAL = 0.35  # times the longer side: phones have no shorter lens, whatever a header claims
OFF = 0.1  # of the focal length that was claimed: further off is worth a warning


def run(capture: Capture, options: CamerasOptions, progress: Progress) -> Cameras:
    """
    Places the photos.

    Raises InputError where fewer than three photos can be placed, or where the face could not be found in space.
    """
    photos = capture.photos
    names = [f"{name}.jpg" for name in photos.names]
    warnings: list[str] = []
    with progress.task("features", len(photos)) as task:
        features = []
        for found in _features(capture, options):
            features.append(found)
            task.advance()
    lenses, camera_of = _lenses(capture)
    matches = _match(features, options, progress)
    models, which, settled = _map(capture, options, features, matches, (lenses, camera_of), progress, warnings)
    if not models or models[0].num_reg_images() < LEAST_PLACED:
        placed_count = models[0].num_reg_images() if models else 0
        raise InputError(
            f"{placed_count} of {len(photos)} photos could be placed in space, at least {LEAST_PLACED} are needed: "
            "shoot more photos, sharp ones, in small steps around the head, in a room with texture"
        )
    model = models[0]
    left_out = sorted(set(names) - {model.images[i].name for i in model.reg_image_ids()})
    if left_out:
        listed = ", ".join(name.removesuffix(".jpg") for name in left_out)
        warnings.append(f"{len(left_out)} of {len(photos)} photos could not be placed and are left out: {listed}")
    _colour(model, capture, names)
    placed = metric.placed_photos(model, names)
    figures: dict[str, Any] = {
        "placed": len(placed.index),
        "photos": len(photos),
        "points": model.num_points3D(),
        "reprojection_px": round(model.compute_mean_reprojection_error(), 3),
        "focal_px": [round(model.cameras[i].mean_focal_length(), 2) for i in sorted(model.cameras)],
        "features": which,
        "head_px": None if settled is None else [round(settled.before, 3), round(settled.after, 3)],
    }
    warnings += _warn_of_focal(capture, camera_of, model)
    scale: dict[str, Any] = {"source": "none", "relative_sd": None}
    if capture.face:
        scale = _to_head(capture, model, placed, options, figures, warnings)
    figures["scale_source"], figures["scale_relative_sd"] = scale["source"], scale["relative_sd"]
    return Cameras(model, capture.face, scale, figures, warnings)


def _features(capture: Capture, options: CamerasOptions) -> Iterator[Features]:
    factors: list[float] = []

    def grey_images() -> Iterator[np.ndarray]:
        for image in capture.photos.images:
            grey = cv2.cvtColor(image.rgb(), cv2.COLOR_RGB2GRAY)
            factor = min(1.0, options.max_image_size / max(grey.shape))
            factors.append(factor)
            if factor < 1.0:
                grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
            yield grey

    for number, found in enumerate(extract(grey_images(), options.max_features)):
        scale = np.float32(1 / factors[number])
        yield Features(found.points * scale, found.scales * scale, found.descriptors)


def _lenses(capture: Capture) -> tuple[list[pycolmap.Camera], np.ndarray]:
    """One camera a lens, with its focal prior, and which of them each photo has."""
    photos = capture.photos
    numbers, camera_of = np.unique(photos.lens, return_inverse=True)
    lenses: list[pycolmap.Camera] = []
    for number in numbers:
        width, height = (int(v) for v in photos.size[photos.lens == number][0])
        known = photos.focal[photos.lens == number]
        known = known[np.isfinite(known)]
        length = float(np.median(known)) if len(known) else DEFAULT_FOCAL * max(width, height)
        length = max(length, SHORTEST_FOCAL * max(width, height))
        lens = pycolmap.Camera.create_from_model_id(
            len(lenses) + 1, pycolmap.CameraModelId.SIMPLE_RADIAL, length, width, height
        )
        lens.has_prior_focal_length = bool(len(known))
        lenses.append(lens)
    return lenses, camera_of


def _match(features: list[Features], options: CamerasOptions, progress: Progress) -> dict[tuple[int, int], np.ndarray]:
    alike = matching.likeness(features)
    pairs = matching.choose_pairs(alike, options.overlap, options.loop_pairs, options.exhaustive_up_to)
    units = [matching.unit_descriptors(f.descriptors) for f in features]
    found = {}
    with progress.task("matches", len(pairs)) as task:
        results = in_order(lambda pair: matching.match(units[pair[0]], units[pair[1]]), pairs)
        for pair, matches in zip(pairs, results):
            if len(matches) >= LEAST_MATCHES:
                found[pair] = matches
            task.advance()
    return found


def _verify(
    features: list[Features],
    matches: dict[tuple[int, int], np.ndarray],
    lenses: tuple[list[pycolmap.Camera], np.ndarray],
    progress: Progress,
) -> Verified:
    cameras, camera_of = lenses

    def check(pair: tuple[int, int]) -> pycolmap.TwoViewGeometry:
        i, j = pair
        return matching.verify(features[i], features[j], matches[pair], (cameras[camera_of[i]], cameras[camera_of[j]]))

    verified = {}
    with progress.task("two-view geometry", len(matches)) as task:
        for pair, geometry in zip(matches, in_order(check, matches)):
            if len(geometry.inlier_matches) >= LEAST_MATCHES:
                verified[pair] = geometry
            task.advance()
    return verified


def _map(
    capture: Capture,
    options: CamerasOptions,
    features: list[Features],
    matches: dict[tuple[int, int], np.ndarray],
    lenses: tuple[list[pycolmap.Camera], np.ndarray],
    progress: Progress,
    warnings: list[str],
) -> tuple[list[pycolmap.Reconstruction], str, head.Settled | None]:
    """The models, which features they are made of ('all' or 'head'), and how the head fits."""
    names = [f"{name}.jpg" for name in capture.photos.names]

    def place(pairs: Verified, label: str) -> list[pycolmap.Reconstruction]:
        with progress.task(label, len(names)) as task:
            return map_photos(names, features, *lenses, pairs, task.advance)

    def pairs_on_head() -> Verified:
        on_head = {(i, j): m[heads[i][m[:, 0]] & heads[j][m[:, 1]]] for (i, j), m in matches.items()}
        return _verify(features, {k: m for k, m in on_head.items() if len(m) >= LEAST_MATCHES}, lenses, progress)

    if not capture.face:
        return place(_verify(features, matches, lenses, progress), "placing photos"), "all", None
    heads = head.head_features(features, capture.photos.landmarks, matches)
    if options.features == "head":
        return place(pairs_on_head(), "placing photos by the head"), "head", None
    by_all = place(_verify(features, matches, lenses, progress), "placing photos")
    settled = head.settle(by_all[0], dict(zip(names, heads))) if by_all else None
    if options.features == "all" or settled is None or not settled.head_moved:
        return by_all, "all", settled
    warnings.append("the head turned against the room between the photos: the head's own features place the cameras")
    on_head = pairs_on_head()
    by_head = place(on_head, "placing photos by the head")
    if by_head and by_head[0].num_reg_images() >= ENOUGH * by_all[0].num_reg_images():
        return by_head, "head", settled
    return [regrow(by_all[0], names, features, lenses[1], on_head)], "head", settled


def _colour(model: pycolmap.Reconstruction, capture: Capture, names: list[str]) -> None:
    """Gives every point of the model the colour it has in the first photo of its track."""
    first: dict[int, list[tuple[int, int]]] = {}
    for number in sorted(model.point3D_ids()):
        element = min((e.image_id, e.point2D_idx) for e in model.points3D[number].track.elements)
        first.setdefault(element[0], []).append((number, element[1]))
    for image_id in sorted(first):
        image = model.images[image_id]
        rgb = capture.photos.images[names.index(image.name)].rgb()
        for number, index in first[image_id]:
            x, y = image.points2D[index].xy
            row, column = min(int(y), rgb.shape[0] - 1), min(int(x), rgb.shape[1] - 1)
            model.points3D[number].color = rgb[row, column]


def _warn_of_focal(capture: Capture, camera_of: np.ndarray, model: pycolmap.Reconstruction) -> list[str]:
    """A line for each lens whose focal length came out far from what was claimed of it."""
    photos, lines = capture.photos, []
    for number in sorted(model.cameras):
        claimed = float(np.nanmedian(photos.focal[camera_of == number - 1]))
        found = model.cameras[number].mean_focal_length()
        if np.isfinite(claimed) and abs(found / claimed - 1) > OFF:
            lines.append(
                f"the focal length came out {100 * (found / claimed - 1):+.0f} % off what EXIF or capture.toml says "
                f"(without them, a phone's main camera): {found:.0f} pixels instead of {claimed:.0f}"
            )
    return lines


def _to_head(
    capture: Capture,
    model: pycolmap.Reconstruction,
    placed: metric.Placed,
    options: CamerasOptions,
    figures: dict[str, Any],
    warnings: list[str],
) -> dict[str, Any]:
    """Takes the model to millimetres and the head frame; returns where the scale comes from."""
    photos = capture.photos
    trusted = photos.trusted(TRUSTED_PRESENCE, TRUSTED_YAW)
    shown = int(trusted[placed.index].sum())
    if shown < LEAST_PLACED:
        raise InputError(
            f"{shown} of the placed photos show the face, at least {LEAST_PLACED} are needed: "
            "shoot more photos from the front"
        )
    points, angles = metric.face_points(placed, photos.landmarks, trusted)
    face = canonical_face()
    mean_scale, rotation = metric.head_rotation(points, face.points, face.rigidity)
    grey = lambda i: cv2.cvtColor(photos.images[i].rgb(), cv2.COLOR_RGB2GRAY)  # noqa: E731
    iris = metric.iris_size(placed, points, photos.landmarks, trusted, photos.pose[:, 0], grey)
    figures["landmark_spread_mrad"] = round(1000 * float(np.nanmedian(angles)), 2)
    answer: dict[str, Any]
    if iris is None:
        warnings.append("no iris is clear enough to be measured: the scale is that of a mean face, good to about 6 %")
        scale = mean_scale
        answer = {"source": "mean face", "relative_sd": 0.06}
    else:
        scale = options.iris_diameter / iris.diameter
        sd = np.hypot(metric.IRIS_SPREAD / options.iris_diameter, iris.spread / np.sqrt(iris.count))
        answer = {"source": "iris", "relative_sd": round(float(sd), 4), "iris_spread": round(iris.spread, 4)}
        answer["iris_count"] = iris.count
        answer["iris_pixels"] = [[photos.names[i], side, round(px, 2)] for i, side, px in iris.pixels]
    wanted = capture.settings.get("known_length")
    if wanted is not None:
        known = metric.known_length(placed, _ends(capture, wanted))
        if known is None:
            warnings.append("the known length's photos could not be placed: the scale is the iris's")
        else:
            scale = wanted["mm"] / known[0]
            answer |= {"source": "known length", "relative_sd": round(known[1], 4)}
    if iris is not None:
        answer["iris_mm"] = round(iris.diameter * scale, 3)
        figures["iris_mm"] = answer["iris_mm"]
    origin = metric.head_origin(points, scale, rotation)
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), origin))
    return answer


def _ends(capture: Capture, wanted: dict[str, Any]) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """The marked ends of a known length: photo, a (2,), b (2,) pixels of the stored photos."""
    number = {name: i for i, name in enumerate(capture.photos.names)}
    return [(number[p["photo"]], np.array(p["a"], float), np.array(p["b"], float)) for p in wanted["points"]]

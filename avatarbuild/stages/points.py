"""Dense multi-view stereo: photos and cameras in, an oriented, coloured cloud of the head out."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np

from avatarbuild.artefacts import Cameras, Capture, Cloud
from avatarbuild.errors import InputError
from avatarbuild.formats import colmap_dense
from avatarbuild.geometry import depth_maps, fusion, point_clouds, stereo_views
from avatarbuild.geometry.depth_maps import Search
from avatarbuild.geometry.fusion import Agreement
from avatarbuild.geometry.stereo_views import Region, StereoView
from avatarbuild.options import PointsOptions
from avatarbuild.parallel import cores
from avatarbuild.progress import Progress, Task

log = logging.getLogger(__name__)

COARSE_SIZE = (
    300  # pixels: the coarsest level is about this long: the head some 120, a random plane soon finds its place
)
COARSEST = Search(sweeps=4, tries=5, steps=1, span=0.1, tilt=1.0)
MIDDLE = Search(sweeps=2, tries=2, steps=1, span=0.01, tilt=0.4)
FINEST = Search(sweeps=1, tries=1, steps=2, span=0.003, tilt=0.2)
REPAIR = Search(sweeps=2, tries=2, steps=1, span=0.01, tilt=0.4, consistency=0.15)
SHARES = {"coarsest": 1.0, "middle": 1.0, "finest": 4.0, "repair": 1.0}  # of the time, for the estimate

NEAR_VIEWS, NEAR_ANGLE = 16, 50.0  # views that a point is compared with: the nearest, within so many degrees
BLURRED = 0.75  # photos of less relative sharpness are sources only where there is nothing else, and never references
WORST_COST = 0.6  # 1 - correlation, of a pixel that may become a point
LEAST_FACING = 0.2  # cosine between normal and ray, 78 degrees

LASHES = 1.2  # the eye's outline is enlarged by this: lashes stand before the lids and are no surface
# the lid rims among the 478 landmarks, the subject's right and left eye
EYE_RIMS = (
    [33, 7, 163, 144, 145, 153, 154, 155, 133, 173, 157, 158, 159, 160, 161, 246],
    [263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466],
)


def agreement(tolerance: float, normal: float, least: int, spread: float, doubt: float) -> Agreement:
    """An `Agreement` of angles in degrees."""
    return Agreement(tolerance, float(np.cos(np.radians(normal))), least, float(np.cos(np.radians(spread))), doubt)


def run(capture: Capture, cameras: Cameras, options: PointsOptions, progress: Progress) -> Cloud:
    """
    The cloud of the head, in the cameras' units and frame.

    Raises InputError where the photos do not overlap enough to be matched, or nothing agrees.
    """
    if options.backend == "cuda" and not card_at_hand():
        raise InputError(
            "points.backend is cuda, but there is no CUDA card or no pycolmap built for it: use cpu or auto"
        )
    region = subject(cameras)
    views = load_views(capture, cameras, region, options, progress)
    sources, near, sharp = neighbourhoods(views, region, options)
    if options.backend == "cuda" or (options.backend == "auto" and card_at_hand()):
        planes, cost = match_on_card(views, sources, region, options, progress)
    else:
        planes, cost = match(views, sources, near, region, options, progress)
    points, normals, colours, seen = fuse(views, near, sharp, planes, cost, options, progress)
    keep = np.flatnonzero(worth_keeping(points, normals, views, region, capture, cameras, options))
    if not len(keep):
        raise InputError(
            f"no point of the head is confirmed by {options.min_views} of {len(views)} photos: "
            "more photos of a still subject, 10 to 15 degrees apart, are needed"
        )
    figures = {
        "points": len(keep),
        "views": len(views),
        "reference_views": sum(bool(s) for s in sources),
        "median_agreeing_views": float(np.median(seen[keep])),
        "spacing": round(spacing(points[keep]), 3),
    }
    log.info("%d points from %d photos, %.2f apart", len(keep), figures["reference_views"], figures["spacing"])
    left_out = [v.name for v, s in zip(views, sources) if not s]
    warnings = [f"no dense points from {', '.join(left_out)}: blurred or without neighbours"] if left_out else []
    return Cloud(points[keep], normals[keep], colours[keep], seen[keep], figures, warnings)


def in_threads(work: Callable[[int], Any], items: Iterable[int], task: Task, share: float) -> list[Any]:
    """[work(i) for i in items], on all cores; each advances `task` by `share`."""
    with ThreadPoolExecutor(cores()) as pool:
        futures = [pool.submit(work, i) for i in items]
        try:
            for future in as_completed(futures):
                future.result()
                task.advance(share)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [f.result() for f in futures]


def subject(cameras: Cameras) -> Region:
    """Where the subject is: the head in the head frame, else what the cameras look at."""
    if cameras.metric:
        return stereo_views.head_region()
    model = cameras.model
    images = [model.images[i] for i in sorted(model.reg_image_ids())]
    centres = np.array([image.projection_center() for image in images])
    axes = np.array([image.cam_from_world().matrix()[2, :3] for image in images])
    points = [model.points3D[i] for i in sorted(model.point3D_ids())]
    xyz = np.array([p.xyz for p in points]).reshape(-1, 3)
    return stereo_views.subject_region(centres, axes, xyz, np.array([p.track.length() for p in points]))


def level_count(options: PointsOptions) -> int:
    """Pyramid levels, the finest included."""
    return max(1, 1 + round(np.log2(options.max_image_size / COARSE_SIZE)))


def load_views(
    capture: Capture, cameras: Cameras, region: Region, options: PointsOptions, progress: Progress
) -> list[StereoView]:
    """The placed photos, undistorted and cut to the region, in the order of their names."""
    model = cameras.model
    photo = {f"{name}.jpg": i for i, name in enumerate(capture.photos.names)}
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    images = [image for image in images if image.name in photo]
    levels = level_count(options)

    def load(n: int) -> StereoView | None:
        image = images[n]
        index = photo[image.name]
        pose = image.cam_from_world().matrix()
        camera = model.cameras[image.camera_id]
        rgb = capture.photos.images[index].rgb
        margin = 2 * options.window
        return stereo_views.stereo_view(
            index, image.name, rgb, camera, pose[:, :3], pose[:, 3], region, options.max_image_size, levels, margin
        )

    with progress.task("Undistorting photos", len(images)) as task:
        views = [v for v in in_threads(load, range(len(images)), task, 1) if v is not None]
    if len(views) < options.min_views:
        raise InputError(
            f"{len(views)} placed photos show the subject: dense points need {options.min_views}; take more photos"
        )
    return views


def neighbourhoods(
    views: list[StereoView], region: Region, options: PointsOptions
) -> tuple[list[list[int]], list[np.ndarray], np.ndarray]:
    """Each view's sources to match with, views to compare with, and relative sharpness."""
    centres = np.array([v.centre for v in views])
    angle = stereo_views.view_angles(centres, region.centre)
    sharp = stereo_views.relative_sharpness(np.array([v.sharpness for v in views]), angle)
    foot = np.linalg.norm(centres - region.centre, axis=1) / np.array([v.K[0, 0] for v in views])
    overlap = stereo_views.overlaps(views, region)
    sources = stereo_views.choose_sources(angle, foot, sharp, overlap, options.sources)
    # a lone source is no evidence; a blurred reference gives blurred depth
    sources = [s if len(s) >= options.min_views - 1 and sharp[i] >= BLURRED else [] for i, s in enumerate(sources)]
    if not any(sources):
        raise InputError(
            "no photo overlaps enough others for dense points: photos 10 to 15 degrees apart are needed, "
            f"each with {options.min_views - 1} neighbours"
        )
    near = []
    for i in range(len(views)):
        order = [j for j in np.argsort(angle[i], kind="stable") if j != i and sources[j] and angle[i, j] < NEAR_ANGLE]
        near.append(np.array(order[:NEAR_VIEWS], np.int64))
    return sources, near, sharp


def match(
    views: list[StereoView],
    sources: list[list[int]],
    near: list[np.ndarray],
    region: Region,
    options: PointsOptions,
    progress: Progress,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """
    The plane map (h, w, 3) and cost (h, w) of every view.

    From level to level a view keeps what others confirm and its surroundings; at the end the pixels that nobody
    confirms are searched once more, with the other views' maps as a guide.
    """
    levels = level_count(options)
    refs = [i for i in range(len(views)) if sources[i]]
    planes = [np.zeros((*v.grey[-1].shape, 3), np.float32) for v in views]
    cost = [np.full(v.grey[-1].shape, depth_maps.UNKNOWN) for v in views]
    masks: list[np.ndarray] = []
    sure: list[np.ndarray] = []
    seed = lambda i, step: 1000 * (i + 1) + 10 * step  # noqa: E731

    def improve(i: int, level: int, how: Search) -> tuple[np.ndarray, np.ndarray]:
        if level == levels - 1:
            start = depth_maps.first_planes(views[i], region, level, seed(i, 99))
        else:
            start = depth_maps.next_level(planes[i], masks[i], views[i].grey[level].shape)
        return depth_maps.search(
            views, i, sources[i], region, level, start, None, None, how, options.window, seed(i, level)
        )

    def repair(i: int) -> tuple[np.ndarray, np.ndarray]:
        found, c = depth_maps.search(
            views, i, sources[i], region, 0, planes[i], ~sure[i], planes, REPAIR, options.window, seed(i, 50)
        )
        return found, np.where(sure[i], cost[i], c)

    middle = SHARES["middle"] * max(levels - 2, 0)
    total = SHARES["coarsest"] * (levels > 1) + middle + SHARES["finest"] + SHARES["repair"]
    with progress.task("Matching", total * len(refs)) as task:
        for level in reversed(range(levels)):
            name = "finest" if level == 0 else "coarsest" if level == levels - 1 else "middle"
            how = COARSEST if level == levels - 1 else FINEST if level == 0 else MIDDLE
            found = in_threads(lambda i: improve(i, level, how), refs, task, SHARES[name])  # noqa: B023
            planes, cost = placed_among(found, refs, views, level)
            rule = agreement(1.5, 60.0, 1, 0.0, 0.5) if level else agreement(1.0, 50.0, 2, 0.0, 0.3)
            weight = [(c < WORST_COST).astype(np.float32) for c in cost]
            maps = depth_maps.joined(views, planes, weight, level)
            sure = in_threads(lambda i: depth_maps.confirmed(maps, i, near[i], rule), range(len(views)), task, 0)  # noqa: B023
            masks = [depth_maps.surface_mask(s) for s in sure] if level else []
        found = in_threads(repair, refs, task, SHARES["repair"])
        planes, cost = placed_among(found, refs, views, 0)
    return planes, cost


def card_at_hand() -> bool:
    """Whether COLMAP's PatchMatch can run."""
    import pycolmap

    return bool(pycolmap.has_cuda)


def match_on_card(
    views: list[StereoView], sources: list[list[int]], region: Region, options: PointsOptions, progress: Progress
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """What `match` gives, from COLMAP's PatchMatch; it keeps no costs, so all pixels count the same."""
    distance = np.array([np.linalg.norm(v.centre - region.centre) for v in views])
    reach = float(region.axes.max())
    nearest = max(float(distance.min()) - reach, 0.1 * float(distance.min()))
    with tempfile.TemporaryDirectory(prefix="avatarbuild-") as name, progress.task("Matching on the card", 1) as task:
        folder = Path(name)
        images = [v.colour for v in views]
        K, R, t = [v.K for v in views], [v.R for v in views], [v.t for v in views]
        names = colmap_dense.write_workspace(folder, images, K, R, t, sources)
        colmap_dense.run_patch_match(folder, nearest, float(distance.max()) + reach, options.window, options.sources)
        task.advance()
        planes = [
            colmap_dense.read_planes(folder, name, v.K) if name else np.zeros((*v.grey[0].shape, 3), np.float32)
            for name, v in zip(names, views)
        ]
    cost = [np.where(p[..., 0] > 0, np.float32(0.1), depth_maps.UNKNOWN) for p in planes]
    return planes, cost


def placed_among(
    found: list[tuple[np.ndarray, np.ndarray]], refs: list[int], views: list[StereoView], level: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The maps found for the views `refs`, and empty ones for the others."""
    planes = [np.zeros((*v.grey[level].shape, 3), np.float32) for v in views]
    cost = [np.full(v.grey[level].shape, depth_maps.UNKNOWN) for v in views]
    for i, (p, c) in zip(refs, found):
        planes[i], cost[i] = p, c
    return planes, cost


def fuse(
    views: list[StereoView],
    near: list[np.ndarray],
    sharp: np.ndarray,
    planes: list[np.ndarray],
    cost: list[np.ndarray],
    options: PointsOptions,
    progress: Progress,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals (n, 3) float32, colours (n, 3), agreeing views (n,) uint8: each surface by its best view."""
    rule = agreement(options.tolerance, 50.0, options.min_views - 1, options.spread, options.doubt)
    centres = np.array([v.centre for v in views])
    weight = [
        depth_maps.confidence(v, 0, p, c, WORST_COST, LEAST_FACING) * np.float32(min(float(s), 1.0) ** 4)
        for v, p, c, s in zip(views, planes, cost, sharp)
    ]
    maps = depth_maps.joined(views, planes, weight, 0)

    def place(i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        shape = cost[i].shape
        point, normal = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
        seen = np.zeros(shape, np.uint8)
        fusion.fuse(maps, i, near[i], centres, rule, point, normal, seen)
        return point[seen > 0], normal[seen > 0], seen

    def own(i: int) -> np.ndarray:
        keep = np.zeros(cost[i].shape, np.bool_)
        fusion.owned(maps, i, near[i], rule, keep)
        return keep

    everyone = range(len(views))
    with progress.task("Fusing", 2 * len(views)) as task:
        placed = in_threads(place, everyone, task, 1)
        for i, (_, _, seen) in enumerate(placed):
            maps.weight[maps.start[i] : maps.start[i] + seen.size] *= seen.ravel() > 0
        owners = in_threads(own, everyone, task, 1)
    kept = [keep[seen > 0] for keep, (_, _, seen) in zip(owners, placed)]
    points = np.concatenate([p[k] for k, (p, _, _) in zip(kept, placed)])
    normals = np.concatenate([n[k] for k, (_, n, _) in zip(kept, placed)])
    views_of = np.concatenate([seen[keep] for keep, (_, _, seen) in zip(owners, placed)])
    return points, normals, np.concatenate([v.colour[keep] for v, keep in zip(views, owners)]), views_of


def spacing(points: np.ndarray) -> float:
    """Median distance of a point to its nearest neighbour."""
    return float(np.median(point_clouds.nearest_distance(points))) if len(points) > 1 else 0.0


def worth_keeping(
    points: np.ndarray,
    normals: np.ndarray,
    views: list[StereoView],
    region: Region,
    capture: Capture,
    cameras: Cameras,
    options: PointsOptions,
) -> np.ndarray:
    """(n,) bool: inside the region, not alone, not in a small piece, not on an eyeball."""
    keep = (((points - region.centre) / region.axes) ** 2).sum(axis=1) <= 1.0
    for rule in (
        lambda p: point_clouds.lonely(p),
        lambda p: point_clouds.small_pieces(p, 4.0 * max(spacing(p), 1e-9), options.least_piece),
    ):
        index = np.flatnonzero(keep)
        keep[index[rule(points[index])]] = False
    if not options.eyeballs and cameras.metric:
        keep &= ~on_eyeballs(points, normals, views, capture, cameras)
    return keep


def on_eyeballs(
    points: np.ndarray, normals: np.ndarray, views: list[StereoView], capture: Capture, cameras: Cameras
) -> np.ndarray:
    """(n,) bool: points that show between the lids, lashes included."""
    photos = capture.photos
    model = cameras.model
    camera_of = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    P, centres, outlines = [], [], []
    for v in views:
        rims = photos.landmarks[v.photo, np.array(EYE_RIMS), :2]
        if not photos.trusted(0.9, 45.0)[v.photo] or not np.isfinite(rims).all():
            continue
        rims = rims.mean(axis=1, keepdims=True) * (1.0 - LASHES) + LASHES * rims
        rays = np.asarray(camera_of[v.name].cam_from_img(rims.reshape(-1, 2))).reshape(*rims.shape)
        outlines.append(list(rays @ v.K[:2, :2].T + v.K[:2, 2]))
        P.append(v.K @ np.hstack([v.R, v.t[:, None]]))
        centres.append(v.centre)
    return point_clouds.within_outlines(points, normals, P, np.array(centres).reshape(-1, 3), outlines)

"""The person as the tracker knows them: rig, markers, texture, eyes, and what the detector says of them at rest."""

from __future__ import annotations

import numpy as np

from avatarbuild.artefacts import Albedo, Blendshapes, Cameras, Capture, Clip, Neutral, Views
from avatarbuild.geometry.head_pose import head_pose
from avatarbuild.geometry.mipmap import build_mipmap
from avatarbuild.landmarks import canonical_face
from avatarbuild.parallel import in_order
from avatarbuild.rigging import limits_of
from avatarbuild.sfm.metric import placed_photos
from avatarbuild.template import Template
from avatarbuild.texture.photos import placed_in_head
from avatarbuild.tracking import samples
from avatarbuild.tracking.alternation import Eyes, Skin
from avatarbuild.tracking.corrections import shifted
from avatarbuild.tracking.fit import Face, face_of
from avatarbuild.tracking.frames import LEVELS, Frame, ScoreLevel, frame
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.markers import Clicks, Markers, markers
from avatarbuild.tracking.neck import SHAPES, pulls
from avatarbuild.tracking.rig import Rig

SAMPLES = (6000, 4000, 2000, 800)  # of the skin, for each level of the pyramid, finest first
LEAST_SCORE = 0.15  # a channel of the detector that never says more is dead


def subject(
    capture: Capture,
    cameras: Cameras,
    neutral: Neutral,
    albedo: Albedo,
    blendshapes: Blendshapes,
    template: Template,
    lens: Lens,
    seen: Views,
) -> tuple[Face, Skin, Eyes]:
    """
    The face with the transferred shapes, its skin as it is drawn, and the eyes that look ahead; `seen`: frames of the
    clip, whose faces' size tells how fine the texture's samples must be.
    """
    photos = placed_in_head(
        capture.photos,
        placed_photos(cameras.model, [f"{name}.jpg" for name in capture.photos.names]),
        neutral.head_from_cloud,
    )
    points = markers(template, blendshapes.neutral, photos, capture.photos, capture.neutral)
    deltas = np.concatenate([blendshapes.deltas[:SHAPES].astype(np.float64), pulls(template, blendshapes.neutral)])
    rig = Rig(blendshapes.neutral, deltas, template.triangles)
    mean = canonical_face()
    faces = seen.landmarks[np.isfinite(seen.presence)][:, : len(mean.points)]
    scale = float(np.median([head_pose(mean.points, mean.rigidity, points_).scale for points_ in faces]))
    grey = samples.grey_chart(albedo.albedo)
    levels = samples.levels_of_samples(
        template,
        blendshapes.neutral,
        grey,
        albedo.coverage,
        [(1 << level) / scale for level in range(LEVELS)],
        list(SAMPLES),
    )
    part = template.parts["skin"].triangles
    skin = Skin(
        samples.flow_region(template)[part],
        (build_mipmap(grey[..., None]), template.uv, template.uv_triangles[part]),
    )
    face = face_of(rig, lens, points, levels, template.triangles[part], tuple(limits_of(template).items()))
    unknown = np.full(2, np.nan)
    rest, by_rims = np.zeros((2, 2)), np.zeros(2, bool)
    return face, skin, Eyes(neutral.eye_centres, neutral.eye_radius, rest, unknown, unknown, by_rims)


def said(views: Views) -> np.ndarray:
    """(k, a) the detector's scores of the shapes in the pictures that show the face."""
    return np.nan_to_num(views.scores[np.isfinite(views.presence), :SHAPES])


def score_level(at_rest: np.ndarray, scores: np.ndarray) -> ScoreLevel:
    """
    What the detector's channels say of a face at rest, their lowest tenth in scores `at_rest` (k, a), and which of them
    are alive in a clip's `scores` (j, a).
    """
    return ScoreLevel(np.quantile(at_rest, 0.1, axis=0), scores.max(axis=0) > LEAST_SCORE)


def kept_frames(clip: Clip, level: ScoreLevel, m: Markers, clicks: dict[int, Clicks]) -> list[Frame]:
    """The frames that the capture kept, those without a face left out; `clicks`: what the user's points say of them."""
    views = clip.frames
    seen = np.flatnonzero(np.isfinite(views.presence))

    def one(i: int) -> Frame:
        return kept_frame(clip, level, m, clicks, i, views.images[i].rgb())

    return list(in_order(one, [int(i) for i in seen]))


def kept_frame(clip: Clip, level: ScoreLevel, m: Markers, clicks: dict[int, Clicks], i: int, rgb: np.ndarray) -> Frame:
    """The i-th of the frames that a clip keeps, its picture `rgb`."""
    number, views = int(clip.processed[i]), clip.frames
    scores = level.of(views.scores[i, :SHAPES])
    told = clicks.get(number)
    marks = views.landmarks[i] if told is None else shifted(views.landmarks[i], told, m)
    return frame(number, float(clip.times[number]), rgb, marks, float(views.presence[i]), scores, told)

"""Stage neutral: the template laid onto the person.

Morphable model by landmarks and cloud, thin shell by cloud, landmarks and rims, then eyeballs, lids, teeth and tongue.
Everything is fitted in the cloud's frame and moved to the head frame at the end. Source: method, section 2.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatarbuild.artefacts import Cameras, Capture, Cloud, Neutral
from avatarbuild.errors import InputError
from avatarbuild.formats.corrections import Corrections
from avatarbuild.geometry import meshes
from avatarbuild.options import NeutralOptions
from avatarbuild.progress import Progress
from avatarbuild.registration import morphable, shell
from avatarbuild.registration.counterparts import Target, counterparts
from avatarbuild.registration.drawn import as_drawn
from avatarbuild.registration.eyes import eyeballs
from avatarbuild.registration.inner_parts import inner_parts
from avatarbuild.registration.iris_sightings import Photos
from avatarbuild.registration.iris_texture import eye_texture
from avatarbuild.registration.lids import lid_fit, settle_lids
from avatarbuild.registration.morphable import Placement, Step
from avatarbuild.registration.pins import pins
from avatarbuild.registration.shell import Stiffness
from avatarbuild.registration.sightings import Sightings, sightings
from avatarbuild.registration.trust import cloud_trust
from avatarbuild.sfm.metric import Placed, placed_photos
from avatarbuild.template import Template

LEAST_PHOTOS = 3
BEYOND_FACE = 0.15  # how much scalp, ears and neck count in the model's fit: hair and collars bend it
MEASURED = 10.0  # mm: the cloud is looked for this far from the finished head
FIXED_STEPS = 5

BY_LANDMARKS = [Step(0, 1, prior, 1) for prior in (19.2, 6.4, 6.4, 3.2, 3.2)]
"""Landmarks alone, the prior from stiff to loose."""
COARSE_CLOUD = [Step(100, 1, 12.8, 20), Step(100, 0.5, 3.2, 12), Step(100, 0.1, 0.64, 8)]
"""Then the cloud, from far and with landmarks as a leash."""


def run(
    capture: Capture,
    cameras: Cameras,
    points: Cloud,
    options: NeutralOptions,
    progress: Progress,
    template: Template,
    corrections: Corrections | None = None,
) -> Neutral:
    """
    The person's neutral head; `corrections` holds contours that the user has drawn on photos.

    Raises InputError where too few photos show the face well enough to place the model.
    """
    photos = capture.photos
    placed = placed_photos(cameras.model, [f"{name}.jpg" for name in photos.names])
    trusted = photos.trusted(options.presence, options.max_yaw)
    seen = sightings(placed, photos.landmarks, photos.pose, trusted)
    if len(seen.photo) < LEAST_PHOTOS:
        raise InputError(
            f"{len(seen.photo)} placed photos show the face well (up to {options.max_yaw:g} degrees from the front): "
            f"{LEAST_PHOTOS} are needed; photograph the face from the front and from both sides of it"
        )
    seen, unused = as_drawn(seen, placed, photos, corrections.photo if corrections is not None else {})
    schedule = stiffnesses(options)
    rounds = len(BY_LANDMARKS) + len(COARSE_CLOUD) + FIXED_STEPS + sum(line.rounds for line in schedule)
    with progress.task("Fitting the head", rounds) as task:
        model, target = fit_model(template, seen, points, options, task.advance)
        head = model.head(template)
        held = pins(template, seen, head, options.landmark_sd, options.rim_sd, options.lip_border_sd, options.slide_sd)
        count = template.parts["skin"].vertices.stop
        triangles = template.triangles[template.parts["skin"].triangles]
        trust = listening(template)[:count]
        skin, found = shell.register(head[:count], triangles, target, trust, held, schedule, task.advance)
    made = assemble(template, capture, placed, trusted, model, target, skin, found.weight * trust)
    if seen.drawn:
        made = replace(made, figures=made.figures | {"contours_drawn": len(seen.drawn)})
    return replace(made, warnings=made.warnings + unused)


def fit_model(
    template: Template, seen: Sightings, points: Cloud, options: NeutralOptions, told: morphable.Told
) -> tuple[Placement, Target]:
    """The morphable model in the cloud's frame, and the cloud weighed for it."""
    trust = listening(template) * np.where(template.regions["face"], 1.0, BEYOND_FACE)
    spread = np.full(478, options.model_landmark_sd)
    now = morphable.fit(template, seen, None, trust, spread, BY_LANDMARKS, morphable.start(template, seen), told)
    believed = cloud_trust(points.points, points.normals, points.colours, now.head(template), template)
    keep = believed > 0.05
    target = Target.of(points.points[keep], points.normals[keep], believed[keep])
    last = [Step(100, options.model_landmarks, options.model_prior, 6)] * FIXED_STEPS
    return morphable.fit(template, seen, target, trust, spread, COARSE_CLOUD + last, now, told), target


def listening(template: Template) -> np.ndarray:
    """(n,) in [0, 1]: how far each vertex may follow the cloud; nothing inside mouth and sockets, less on ears."""
    trust = np.zeros(template.vertex_count)
    trust[template.parts["skin"].vertices] = 1.0
    trust[template.regions["ears"]] = 0.5
    trust[template.regions["mouth"] | template.regions["sockets"]] = 0.0
    return trust


def stiffnesses(options: NeutralOptions) -> list[Stiffness]:
    """From a stiff shell to the options' soft one."""
    s, b = options.stretching, options.bending
    return [
        Stiffness(1000, 1e5, 10, 2),
        Stiffness(100, 1e4, 6, 3),
        Stiffness(10, 1e3, 4, 3),
        Stiffness(max(1.0, s), max(100.0, b), 3, 3),
        Stiffness(s, b, options.reach, 4),
    ]


def assemble(
    template: Template,
    capture: Capture,
    placed: Placed,
    trusted: np.ndarray,
    model: Placement,
    target: Target,
    skin: np.ndarray,
    weight: np.ndarray,
) -> Neutral:
    """Eyes, lids, teeth and tongue for the registered skin (v, 3), and everything in the head frame."""
    photos = capture.photos
    turn = model.rotation
    ahead = turn[:, 2]
    views = Photos(
        placed, photos.landmarks, trusted, photos.pose[:, 0], photos.sharpness, lambda i: photos.images[i].rgb()
    )
    balls = eyeballs(views, skin, template, model.coefficients, ahead)
    warnings = []
    figures: dict[str, object] = {"photos_trusted": int(trusted[placed.index].sum())}
    if balls is None:
        centres, radius = model.place(template.eye_positions(model.coefficients)), np.full(2, 12.0)
        texture = np.full((64, 64, 3), 200, np.uint8)
    else:
        centres, radius = balls.centres, balls.radius
        skin = settle_lids(skin, centres, radius, template, ahead, weight)
        fit = lid_fit(skin, centres, radius, template, ahead)
        figures |= {
            "eye_radius_mm": round(float(radius.mean()), 2),
            "eyes_follow_camera": round(balls.follow, 2),
            "lid_gap_mm": round(max(fit.contact, fit.rim), 3),
        }
        painted = eye_texture(views, balls, skin, template)
        texture = painted.texture
        if not painted.patches:
            warnings.append(
                "no photo shows an iris clearly: the eyes have a usual one's colour; add a sharp frontal photo"
            )
    inner = inner_parts(template, model.coefficients, skin, centres, radius, turn)
    vertices = inner.vertices

    middle = centres.mean(axis=0)
    to_head = np.eye(4)
    to_head[:3, :3], to_head[:3, 3] = turn.T, -turn.T @ middle
    place = lambda x: (x - middle) @ turn  # noqa: E731
    n = template.vertex_count
    seen, distance = np.zeros(n), np.full(n, np.nan)
    count = len(skin)
    seen[:count] = np.clip(weight, 0, 1)
    triangles = template.triangles[template.parts["skin"].triangles]
    normals = meshes.vertex_normals(skin[:count], triangles)
    last = counterparts(skin[:count], normals, target, MEASURED)
    use = (last.weight > 0) & (listening(template)[:count] > 0)
    distance[:count][use] = np.einsum("ni,ni->n", normals, last.place - skin[:count])[use]
    face = use & template.regions["face"][:count]
    off = np.abs(distance[:count][face])
    figures |= {
        "model_scale": round(model.scale, 4),
        "model_sd": round(float(np.sqrt((model.coefficients**2).mean())), 2),
        "face_to_cloud_mm_median": round(float(np.median(off)), 3) if len(off) else None,
        "face_to_cloud_mm_p90": round(float(np.percentile(off, 90)), 3) if len(off) else None,
        "face_seen": round(float(face.sum() / max(template.regions["face"].sum(), 1)), 3),
        "teeth_behind_lips_mm": round(float(inner.lips), 2),
    }
    if face.sum() < 0.5 * template.regions["face"].sum():
        warnings.append(
            "the cloud shows less than half of the face: the rest is the average head's; take more photos of it"
        )
    return Neutral(
        place(vertices),
        template.triangles,
        model.coefficients,
        place(model.head(template)),
        place(centres),
        np.asarray(radius, float),
        to_head,
        seen,
        distance,
        texture,
        figures,
        warnings,
    )

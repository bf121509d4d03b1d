"""Stage albedo: the photos fused into the template's texture, and the light divided out of it.

Source: method, section 3.
"""

from __future__ import annotations

import difflib

import numpy as np

from avatarbuild.artefacts import Albedo, Cameras, Capture, Cloud, Neutral, Views
from avatarbuild.errors import InputError
from avatarbuild.options import AlbedoOptions
from avatarbuild.progress import Progress
from avatarbuild.registration.eye_white import eye_whites
from avatarbuild.sfm.metric import placed_photos
from avatarbuild.template import Template
from avatarbuild.texture import completion, illumination, static_detail
from avatarbuild.texture.fused import Fused
from avatarbuild.texture.fusion import fuse
from avatarbuild.texture.photos import linear_picture, placed_in_head, srgb_picture
from avatarbuild.texture.template_skin import skin_texture

LEAST_PHOTOS = 3
_DARK = 0.15  # of the light: in the nose, less than that is the inside of a nostril
_SURE = 0.2  # how well a texel is seen from which its fused colour stands alone


def run(
    capture: Capture,
    cameras: Cameras,
    points: Cloud,
    neutral: Neutral,
    options: AlbedoOptions,
    progress: Progress,
    template: Template,
) -> Albedo:
    """
    The person's skin without the light.

    Raises InputError where `leave_out` names no photo, or leaves too few.
    """
    placed = placed_photos(cameras.model, [f"{name}.jpg" for name in capture.photos.names])
    out = left_out(capture.photos, options.leave_out)
    photos = [p for p in placed_in_head(capture.photos, placed, neutral.head_from_cloud) if p.photo not in out]
    if len(photos) < LEAST_PHOTOS:
        raise InputError(
            f"{len(photos)} placed photos remain for the texture: {LEAST_PHOTOS} are needed; leave out fewer of them"
        )
    still = capture.neutral[[photo.photo for photo in photos]]
    eyes = (neutral.eye_centres, neutral.eye_radius)
    with progress.task("Fusing the photos", 1.0) as task:
        fused, choice, figures = fuse(
            template, neutral.vertices, neutral.seen, photos, still, options.size, options.blend, eyes, task.advance
        )
    with progress.task("Taking the light out", 3) as task:
        gain = {photo.placed: factor for photo, factor in zip(photos, choice.gains)}
        cards = eye_whites(capture.photos, placed, neutral, template)
        whites = [(card.eye, card.colour * gain[card.placed]) for card in cards if card.placed in gain]
        light = illumination.factor(fused, template, neutral, whites=whites)
        task.advance()
        skin = skin_texture(template, options.size)
        shown = fused.seen * light.skin  # no collar, no hair: there the skin is completed
        nostrils = template.regions["nose"] & (light.open < _DARK)
        albedo = completion.complete(light.albedo, shown, template, skin, linear_picture(neutral.eye_texture), nostrils)
        del skin
        lit = completed_lit(fused, shown, albedo, light.shading)
        task.advance()
        turn, shift = neutral.head_from_cloud[:3, :3], neutral.head_from_cloud[:3, 3]
        cloud, size = points.points @ turn.T + shift, min(options.detail_size, options.size)
        detail = static_detail.maps(template, neutral.vertices, cloud, albedo, shown, light.open, size=size)
        task.advance()
    gains = np.ones((len(placed.index), 3))
    gains[[photo.placed for photo in photos]] = choice.gains
    brightest = np.percentile(light.shading[fused.seen > 0], 99) if (fused.seen > 0).any() else 1.0
    names = [capture.photos.names[i] for i in sorted(out)]
    warnings = [f"left out of the texture, as asked: {', '.join(names)}"] if names else []
    return Albedo(
        albedo=srgb_picture(albedo),
        fused=srgb_picture(lit),
        illumination=srgb_picture(light.shading / max(float(brightest), 1e-6)),
        coverage=np.round(255 * np.clip(shown, 0, 1)).astype(np.uint8),
        normal=detail.normal,
        occlusion=detail.occlusion,
        harmonics=light.harmonics,
        skin_colour=light.skin_colour,
        gains=gains,
        figures=figures | {"left_out": names},
        warnings=warnings,
    )


def left_out(photos: Views, names: str) -> set[int]:
    """Rows of the photos named in a list with commas. Raises InputError for a name that no photo has."""
    rows = {name: i for i, name in enumerate(photos.names)}
    out = set()
    for name in (part.strip() for part in names.split(",") if part.strip()):
        stem = name if name in rows else name.rsplit(".", 1)[0]
        if stem not in rows:
            close = difflib.get_close_matches(stem, list(rows), 1)
            hint = f"did you mean '{close[0]}'?" if close else f"names look like '{photos.names[0]}'"
            raise InputError(f"leave_out names '{name}', but there is no such photo; {hint}")
        out.add(rows[stem])
    return out


def completed_lit(fused: Fused, shown: np.ndarray, albedo: np.ndarray, shading: np.ndarray) -> np.ndarray:
    """(s, s, 3) the fused colours; where `shown` (s, s) says that no photo saw the skin, the completed albedo under the
    light; other parts as they are in the albedo."""
    skin = fused.part <= 1  # and the gutter around it
    sure = np.clip(shown * (1 / _SURE), 0, 1)[..., None]
    lit = sure * fused.colour + (1 - sure) * albedo * shading
    return np.where(skin[..., None], lit, albedo)

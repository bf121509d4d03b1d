"""What the report says: the scale, the verdict, the warnings with what to do, and a sentence for every figure."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np

from avatarbuild.artefacts import Cameras, Neutral
from avatarbuild.template import Template


class Figure(NamedTuple):
    """How a figure is shown: its label, its unit, and what it means to a user."""

    label: str
    unit: str
    sentence: str


class Caution(NamedTuple):
    """A stage's warning: what was found and what to do."""

    stage: str
    found: str
    advice: str


FIGURES: dict[str, dict[str, Figure]] = {
    "capture": {
        "photos": Figure("Photos", "", "Pictures that could be read; 50 to 80 are good."),
        "photos_with_face": Figure("With a face", "", "Photos in which the detector found the subject's face."),
        "photos_trusted": Figure("With trusted landmarks", "", "The face is sure and not turned away too far."),
        "yaw_range": Figure("Turned from, to", "°", "How far the head is turned in them; −60 to +60 covers the face."),
        "lenses": Figure("Lenses", "", "Lenses, zooms or picture sizes; one is best."),
        "face_pixels_per_mm": Figure("Pixels a millimetre", "px/mm", "On the face; 2.5 and more show the skin."),
        "video": Figure("Video", "", "The film that expressions are learnt from."),
        "video_seconds": Figure("Its length", "s", "20 to 60 s hold enough expressions."),
        "frames": Figure("Its frames", "", "All pictures of the video."),
        "frames_processed": Figure("Frames looked at", "", "The sharpest one in each slice of time."),
    },
    "cameras": {
        "photos": Figure("Photos", "", "Those of the capture."),
        "placed": Figure("Photos placed", "", "Photos whose standpoint is known; the others are left out."),
        "points": Figure("Common points", "", "Spots recognised in several photos; they hold the cameras together."),
        "reprojection_px": Figure("Reprojection error", "px", "How well these spots agree; below 1 is good."),
        "focal_px": Figure("Focal length", "px", "Of each lens, as it came out."),
        "features": Figure("Placed by", "", "All of the picture, or the head alone where it turned against the room."),
        "head_px": Figure(
            "Head against room", "px", "Misfit of the head's points before and after letting the head move on its own."
        ),
        "landmark_spread_mrad": Figure("Landmarks agree within", "mrad", "Of the sight lines; 1 is 0.5 mm at 50 cm."),
        "iris_mm": Figure("Iris", "mm", "Its width at the scale that is used; people's are 11.7 ± 0.5 wide."),
        "scale_source": Figure("Scale from", "", "What says how large the head is."),
        "scale_relative_sd": Figure("Scale's standard error", "", "A share: 0.04 is 6 mm on a head 150 mm wide."),
    },
    "points": {
        "points": Figure("Points", "", "Of the surface that photos agree on; a face takes some 300,000."),
        "views": Figure("Photos used", "", "Those with a known standpoint."),
        "reference_views": Figure("Depth maps", "", "Photos that gave a depth of every pixel."),
        "median_agreeing_views": Figure("Photos agreeing", "", "On half of the points so many photos agree, or more."),
        "spacing": Figure("Spacing", "mm", "From a point to its neighbour."),
    },
    "neutral": {
        "photos_trusted": Figure("Photos with landmarks", "", "Photos whose landmarks held the head in place."),
        "face_to_cloud_mm_median": Figure(
            "Distance to the points", "mm", "Half of the face is nearer; far below the photos' own noise is no merit."
        ),
        "face_to_cloud_mm_p90": Figure("Of nine tenths", "mm", "Nine tenths of the face are nearer than this."),
        "face_seen": Figure("Face seen", "", "Share of the face that points decided; the rest is experience's."),
        "model_scale": Figure("Size", "", "Against the template's mean head, which is 1."),
        "model_sd": Figure("Unlikeness", "", "From the mean head, in people's standard deviations; above 1.5 is rare."),
        "eye_radius_mm": Figure("Eyeballs' radius", "mm", "People's are 11.5 to 12.5."),
        "eyes_follow_camera": Figure("Eyes follow the camera", "", "0: they kept looking ahead; 1: into each photo."),
        "lid_gap_mm": Figure("Lids off the eyeballs", "mm", "The largest gap between a lid's rim and the eyeball."),
        "teeth_behind_lips_mm": Figure("Teeth behind the lips", "mm", "Room between the front teeth and the lips."),
    },
    "blendshapes": {
        "lid_gap_mm": Figure("Closed lids off their place", "mm", "Where eyeBlink at 1 does not lie on the eyeball."),
        "lid_sunk_mm": Figure("Eyeballs through lids", "mm", "How far an eyeball shows through a closing lid."),
        "lips_off_mm": Figure("Sealed lips part", "mm", "Gap or overlap where lips should stay closed."),
        "teeth_out_mm": Figure("Teeth before lips", "mm", "How far teeth stand out in any expression."),
        "teeth_out_at_rest_mm": Figure("At rest", "mm", "The same with the mouth closed."),
    },
    "tracking": {
        "frames": Figure("Frames", "", "Pictures of the video; each has weights and a pose."),
        "processed": Figure("Tracked in full", "", "Frames that the shapes are learnt from, if they are good."),
        "good": Figure("Good", "", "Of these, frames whose tracking can be trusted."),
        "rounds": Figure("Rounds", "", "Of tracking and learning in turn."),
        "moved_mm": Figure("Last round moved", "mm", "How far the last round still moved the shapes."),
        "focal": Figure("Focal length", "px", "Of the video's camera, as it came out."),
        "shapes_learnt": Figure("Shapes learnt", "", "Those that the video, and not the template, decided."),
    },
    "refinement": {
        "frames": Figure("Frames", "", "Whose light on the skin was read."),
        "offset_mm": Figure("Depth beyond the shapes", "mm", "What shading asked of the tracked surface, mean."),
        "moved_mm": Figure("Largest change of a shape", "mm", "Anywhere on the face."),
        "neutral_moved_mm": Figure("Largest change at rest", "mm", "Of the neutral head."),
    },
    "details": {
        "frames": Figure("Frames", "", "That wrinkles were taken from."),
        "keyframes": Figure("Keyframes", "", "That every expression's wrinkles are mixed from."),
        "tilt_degrees": Figure("Wrinkles tilt the skin by", "degrees", "Mean over all frames and the face."),
        "misfit_degrees": Figure("Mixed wrinkles are off by", "degrees", "From the frames' own, mean."),
    },
    "avatar": {
        "glb_mb": Figure("Size of avatar.glb", "MB", "Opens in any viewer of glTF."),
        "shapes": Figure("Shapes that move", "", "Of the 52."),
        "head_vertices": Figure("Vertices of the head", "", "Without eyes and teeth; seams count twice."),
        "left_out_mm": Figure("Left out", "mm", "The largest motion that was too small to be stored."),
    },
}

_VERBS = (
    *("take", "walk", "step", "add", "keep", "lock", "use", "turn", "film", "remove", "name", "give", "shoot", "copy"),
    *("the largest face", "the avatar has", "hold", "try", "check", "click", "look", "see", "move", "photograph"),
    *("convert", "put", "set", "run", "mark", "leave", "open", "tie", "wear", "let", "retake"),
)
# warnings that come without advice: what they say -> what to do
_ADVICE = (
    (r"could not be placed", "Shoot in small steps, about 5 degrees apart, sharp, in a room with texture."),
    (r"head turned against the room", "Nothing is lost; next time sit still and let the photographer walk."),
    (r"focal length", "Use the phone's original files, without zoom or cropping; capture.toml may state the lens."),
    (r"no iris is clear", "Give a known length in capture.toml, or take sharp frontal photos with the eyes open."),
    (r"known length", "Mark its ends in two or more photos that are sharp and show the head."),
    (r"no dense points", "Nothing, unless the cloud has holes there: then take these photos again."),
    (r"left out", "Copy the file again or remove it."),
    (r"skin colour", "Take more photos of the face from the front, in even light."),
    (r"before the closed lips", "Look at the mouth from the side; photos with the lips closed and relaxed help."),
    (r"the video used is", "Name the right one in capture.toml if this is not it."),
    (r"the video .* not used", "Nothing, unless it is the one that you meant: then name it in capture.toml."),
    (r"hair|scalp", "Tie long hair back, or wear a tight cap, where the head's own shape matters."),
    (r"neck|below the chin", "Add a row of photos from below the chin."),
)
_USUAL_ADVICE = {
    "capture": "See the capture guide; run `avatarbuild check` on a new attempt before the long run.",
    "cameras": "Take more photos in smaller steps, in a room with texture.",
    "points": "Take more sharp photos of the region, 10 to 15 degrees apart.",
    "neutral": "Look at the heat map and the overlays; photos of the region in question mend most faults.",
}
_ELSE = "Look at the pictures; if they are fine, nothing."


def scale_words(cameras: Cameras) -> tuple[str, str]:
    """Where the scale comes from, and how far it may be off, each a sentence."""
    source, sd = cameras.scale.get("source"), cameras.scale.get("relative_sd")
    if source == "iris":
        count = cameras.scale.get("iris_count")
        seen = f", measured {count} times" if count else ""
        said = f"Scale from the iris{seen}: it is {cameras.scale.get('iris_mm', 11.7):g} mm wide in nearly everybody."
    elif source == "known length":
        said = "Scale from the known length that you marked."
    elif source == "mean face":
        said = "Scale of a mean face, because no iris was clear enough."
    else:
        return "The scale is not known.", "Sizes mean nothing."
    if sd is None:
        return said, "Its error is not known."
    better = "" if source == "known length" else " A known length in capture.toml makes it exact."
    return said, f"Standard error {100 * sd:.1f} %, which is {150 * sd:.1f} mm on a head 150 mm wide.{better}"


def fit(neutral: Neutral, template: Template) -> dict[str, float]:
    """median and p90 of |distance| (mm) over the face, and the share of the face where the cloud says something."""
    inner = template.regions["sockets"] | template.regions["mouth"]
    off = np.abs(neutral.distance[template.regions["face"] & ~inner])
    known = off[np.isfinite(off)]
    if not len(known):
        return {"median": np.nan, "p90": np.nan, "share": 0.0}
    return {
        "median": float(np.median(known)),
        "p90": float(np.quantile(known, 0.9)),
        "share": len(known) / max(len(off), 1),
    }


def verdict(found: dict[str, float], cautions: int) -> tuple[str, str]:
    """('good' | 'fair' | 'poor', one line)."""
    if not found["share"]:
        return "poor", "No point of the photos’ surface lies on the face: this head is a guess."
    said = (
        f"half of the face lies within {found['median']:.2f} mm of the photos’ surface, nine tenths within "
        f"{found['p90']:.2f} mm; {100 * found['share']:.0f} % of it was seen"
    )
    if found["median"] <= 0.4 and found["p90"] <= 1.2 and found["share"] >= 0.8:
        grade, opening = "good", "A close fit"
    elif found["median"] <= 0.9 and found["share"] >= 0.5:
        grade, opening = "fair", "A fair fit"
    else:
        grade, opening = "poor", "A loose fit"
    more = "" if not cautions else f" {cautions} thing{'s' * (cautions > 1)} to look at below."
    return grade, f"{opening}: {said}.{more}"


def cautions(stages: list[dict[str, Any]]) -> list[Caution]:
    """Every stage's warnings, what was found apart from what to do."""
    return [
        Caution(stage["stage"], *split(text, stage["stage"]))
        for stage in stages
        for text in stage.get("warnings") or []
    ]


def split(text: str, stage: str) -> tuple[str, str]:
    """'found; advice' where an imperative's verb follows '; ' or ': '; advice of our own where none does."""
    verbs = "|".join(re.escape(verb) for verb in _VERBS)
    opening = re.search(rf"[;:] (?=(?:{verbs})\b)", text)
    if opening is not None:
        return _sentence(text[: opening.start()]), _sentence(text[opening.end() :])
    for pattern, advice in _ADVICE:
        if re.search(pattern, text):
            return _sentence(text), advice
    return _sentence(text), _USUAL_ADVICE.get(stage, _ELSE)


def value(number: Any, unit: str = "") -> str:
    """A figure as a person reads it: three digits that count, thousands apart."""
    if number is None:
        return "—"
    if isinstance(number, bool):
        return "yes" if number else "no"
    if isinstance(number, list | tuple):
        joint = " to " if len(number) == 2 else ", "
        return _with(joint.join(value(v) for v in number), unit) if number else "—"
    if isinstance(number, dict):
        return ", ".join(f"{name} {value(v)}" for name, v in number.items()) or "—"
    if isinstance(number, int):
        text = f"{number:,}".replace(",", "\u202f") if abs(number) >= 10_000 else str(number)
    elif isinstance(number, float):
        if not np.isfinite(number):
            return "—"
        digits = max(0, 2 - int(np.floor(np.log10(abs(number))))) if number else 0
        text = f"{number:.{digits}f}" if digits else f"{round(number):,}".replace(",", "\u202f")
        text = text.rstrip("0").rstrip(".") if "." in text else text
    else:
        text = str(number)
    text = text.replace("-", "−") if isinstance(number, int | float) else text
    return _with(text, unit)


def _with(text: str, unit: str) -> str:
    return f"{text}\u202f{unit}" if unit == "°" else f"{text} {unit}".strip()


def _sentence(text: str) -> str:
    text = text.strip()
    return (text[:1].upper() + text[1:]).rstrip(".") + "." if text else text

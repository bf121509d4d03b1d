"""The options of every stage: one frozen dataclass a stage; a field's default, unit and sentence document it."""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass, field
from typing import Any

from avatarbuild.errors import InputError

QUALITIES = ("draft", "standard", "high")
NAMES = "names"  # the unit of a text that is no word of a list
ALIASES = {"capture.leave_out": "albedo.leave_out"}  # leaving photos out is about the capture, and touches no camera


def option(default: Any, unit: str, sentence: str, *, draft: Any = None, high: Any = None, least: Any = None) -> Any:
    """A field that is an option: `default` at standard quality, `draft` and `high` where they differ."""
    about = {"unit": unit, "sentence": sentence, "draft": draft, "high": high, "least": least}
    return field(default=default, metadata=about)


@dataclass(frozen=True)
class CaptureOptions:
    """Reading photos and video, landmarks."""

    frame_rate: float = option(
        3.0, "Hz", "Video frames processed a second; sharp ones are preferred.", high=6.0, least=0.1
    )
    max_megapixels: float = option(
        16.0, "megapixels", "Larger photos are scaled down to this size.", draft=4.0, least=0.5
    )
    jpeg_quality: int = option(97, "1-100", "JPEG quality of the upright copies kept in the project.", least=50)
    presence: float = option(
        0.9, "probability", "Least presence score at which a face's landmarks are trusted.", least=0.0
    )
    max_yaw: float = option(60.0, "degrees", "Largest head yaw at which landmarks are trusted.", least=10.0)


@dataclass(frozen=True)
class CamerasOptions:
    """Structure from motion."""

    max_image_size: int = option(
        2400, "pixels", "Longest side of the images that features are found in.", draft=1200, least=320
    )
    max_features: int = option(
        4096, "features", "SIFT features kept an image, largest first.", draft=3000, high=8192, least=500
    )
    exhaustive_up_to: int = option(40, "photos", "Sets up to this size are matched pair by pair, all of them.", least=2)
    overlap: int = option(6, "photos", "Neighbours in shooting order that each photo is matched with.", least=2)
    loop_pairs: int = option(
        6, "photos", "Photos further off in order, alike in view, that each is matched with.", least=0
    )
    iris_diameter: float = option(
        11.7, "mm", "Horizontal visible iris diameter that gives the metric scale.", least=9.0
    )
    features: str = option(
        "auto", "auto, all, head", "Which features place the cameras: all, the head's alone, or the better."
    )


@dataclass(frozen=True)
class PointsOptions:
    """Dense multi-view stereo."""

    backend: str = option("auto", "auto, cpu, cuda", "PatchMatch on the processor, or COLMAP's on a CUDA card.")
    max_image_size: int = option(
        1152, "pixels", "Longest side of the images that are matched.", draft=576, high=1600, least=200
    )
    sources: int = option(4, "photos", "Source photos each photo is matched against.", least=2)
    window: int = option(5, "pixels", "Half width of the matching window.", least=2)
    min_views: int = option(3, "photos", "Photos that must agree on a point, the reference among them.", least=2)
    tolerance: float = option(0.7, "pixels", "Largest distance of the surfaces of two photos that agree.", least=0.1)
    spread: float = option(8.0, "degrees", "Angle that the photos that agree on a point must span.", least=0.0)
    doubt: float = option(0.2, "ratio", "Photos that see through a point, allowed for each that agrees.", least=0.0)
    least_piece: int = option(200, "points", "Smaller separate pieces of the cloud are dropped.", least=1)
    eyeballs: bool = option(False, "", "Keep the points between the lids; eyes shine and turn between photos.")


@dataclass(frozen=True)
class BlendshapesOptions:
    """Transfer of the template's 52 expressions."""

    contacts: bool = option(
        True, "", "Keep lids on the eyes, closed lips closed and teeth behind lips; otherwise as transferred."
    )


@dataclass(frozen=True)
class NeutralOptions:
    """Registration of the template to the cloud."""

    presence: float = option(0.9, "probability", "Least presence score of photos whose landmarks count.", least=0.0)
    max_yaw: float = option(60.0, "degrees", "Largest head yaw of photos whose landmarks count.", least=10.0)
    model_prior: float = option(
        0.32, "mm^2 / 100 sd^2", "Weight of the morphable model's prior against the cloud.", least=0.0
    )
    model_landmarks: float = option(0.05, "ratio", "Weight of landmarks beside the cloud, in the last fit.", least=0.0)
    model_landmark_sd: float = option(2.5, "mm", "Standard deviation of landmarks on the morphable model.", least=0.1)
    landmark_sd: float = option(6.0, "mm", "Standard deviation of single landmarks on the thin shell.", least=0.1)
    rim_sd: float = option(0.3, "mm", "Standard deviation across the lids' rims and the seam of the lips.", least=0.05)
    lip_border_sd: float = option(1.0, "mm", "Standard deviation across the lips' border and the brows.", least=0.05)
    slide_sd: float = option(4.0, "mm", "Standard deviation along all these rims.", least=0.05)
    stretching: float = option(0.3, "mm^2", "Stretching stiffness of the thin shell at the end.", least=0.0)
    bending: float = option(3.0, "mm^4", "Bending stiffness of the thin shell at the end.", least=1e-6)
    reach: float = option(2.0, "mm", "Points farther from the thin shell are ignored at the end.", least=0.1)


@dataclass(frozen=True)
class AlbedoOptions:
    """Texture from the photos, and the light taken out of it."""

    size: int = option(4096, "texels", "Side of the textures.", draft=2048, least=256)
    leave_out: str = option(
        "", NAMES, "Photos kept out of the texture alone (names with commas between them), to render them as a check."
    )
    detail_size: int = option(2048, "texels", "Side of the normal and occlusion maps.", draft=1024, least=64)
    blend: float = option(8.0, "mm", "Distance over which a step between two photos' patches fades.", least=0.5)


@dataclass(frozen=True)
class TrackingOptions:
    """Tracking the video, and the person's own shapes learnt from it."""

    rounds: int = option(7, "rounds", "Tracking and modelling in turn, at most.", draft=2, least=0)
    lit_rounds: int = option(
        3,
        "rounds",
        "The same again, once the light on the skin has told of depth; 0: it is not asked.",
        draft=1,
        least=0,
    )
    settled: float = option(0.02, "mm", "It ends when a round moves the posed face by less than this.", least=0.0)
    leave_out: int = option(
        0,
        "frames",
        "Every so many-th processed frame teaches nothing, to check the shapes on it; 0: all teach.",
        least=0,
    )


@dataclass(frozen=True)
class RefinementOptions:
    """Shape from shading on the tracked frames, and the shapes refined against it."""

    pixel: float = option(1.0, "mm", "What a pixel of the depth maps covers on the face.", draft=2.0, least=0.25)
    worth: float = option(0.2, "1/mm^2", "Of the depth maps beside closeness to the tracked shapes.", least=0.0)


@dataclass(frozen=True)
class DetailsOptions:
    """Wrinkles of every frame, and what makes them for any expression."""

    pixel: float = option(0.5, "mm", "What a pixel of the relief covers on the face.", draft=1.0, least=0.1)
    side: int = option(1024, "texels", "Side of the detail maps: a multiple of 16.", draft=512, least=64)
    keyframes: int = option(6, "frames", "Expressions that all details are mixed from.", least=1)
    save_frames: str = option(
        "", NAMES, "Frames of the video (numbers with commas between them) whose normals are saved at its full size."
    )


@dataclass(frozen=True)
class AvatarOptions:
    """avatar.glb and avatar.json."""

    albedo_quality: int = option(92, "1-100", "JPEG quality of the albedo inside avatar.glb.", least=50)
    least_motion: float = option(0.004, "mm", "Smaller displacements of a vertex in a shape are left out.", least=0.0)
    least_turn: float = option(0.2, "degrees", "Smaller turns of a vertex's normal in a shape are left out.", least=0.0)


STAGE_OPTIONS: dict[str, type] = {
    "capture": CaptureOptions,
    "cameras": CamerasOptions,
    "points": PointsOptions,
    "neutral": NeutralOptions,
    "albedo": AlbedoOptions,
    "blendshapes": BlendshapesOptions,
    "tracking": TrackingOptions,
    "refinement": RefinementOptions,
    "details": DetailsOptions,
    "avatar": AvatarOptions,
}


def nearest(word: str, words: list[str]) -> str:
    """A hint for a misspelt word: "did you mean 'X'?", or the list of what there is."""
    close = difflib.get_close_matches(word, words, n=1, cutoff=0.4)
    return f"did you mean '{close[0]}'?" if close else f"there are: {', '.join(words)}"


def _parse(key: str, text: str, default: Any, least: Any) -> Any:
    try:
        if isinstance(default, bool):
            value: Any = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}[text.lower()]
        elif isinstance(default, int):
            value = int(text)
        elif isinstance(default, float):
            value = float(text)
        else:
            value = text
    except (ValueError, KeyError):
        raise InputError(f"option {key} is '{text}': a value like {default} is needed") from None
    if least is not None and not value >= least:
        raise InputError(f"option {key} is {value}: at least {least} is needed")
    return value


def stage_options(quality: str = "standard", settings: dict[str, str] | None = None) -> dict[str, Any]:
    """
    The options of all stages for a quality and the user's `stage.option -> text` settings.

    Raises InputError for an unknown stage, option or quality (naming the nearest real one) and for a value of the
    wrong kind.
    """
    if quality not in QUALITIES:
        raise InputError(f"no quality '{quality}', {nearest(quality, list(QUALITIES))}")
    values: dict[str, dict[str, Any]] = {}
    for stage, kind in STAGE_OPTIONS.items():
        values[stage] = {
            f.name: f.metadata[quality]
            for f in dataclasses.fields(kind)
            if quality != "standard" and f.metadata.get(quality) is not None
        }
    for key, text in (settings or {}).items():
        stage, _, name = ALIASES.get(key, key).partition(".")
        if stage not in STAGE_OPTIONS:
            raise InputError(f"no stage '{stage}' in option {key}, {nearest(stage, list(STAGE_OPTIONS))}")
        values[stage][name] = parse_field(STAGE_OPTIONS[stage], name, text, f"{stage}.")
    return {stage: kind(**values[stage]) for stage, kind in STAGE_OPTIONS.items()}


def parse_field(kind: type, name: str, text: str, prefix: str = "") -> Any:
    """
    The value of an options dataclass's field from the user's text.

    Raises InputError for an unknown field (naming the nearest real one) and for a value of the wrong kind.
    """
    fields = {f.name: f for f in dataclasses.fields(kind)}
    if name not in fields:
        hint = nearest(name, list(fields)).replace("did you mean '", f"did you mean '{prefix}")
        raise InputError(f"no option '{prefix}{name}', {hint}")
    about = fields[name].metadata
    value = _parse(prefix + name, text, fields[name].default, about["least"])
    if isinstance(value, str) and about["unit"] != NAMES:
        words = [w.strip() for w in about["unit"].split(",")]
        if value not in words:
            raise InputError(f"option {prefix}{name} is '{value}', {nearest(value, words)}")
    return value


def described() -> list[dict[str, Any]]:
    """Every option as {option, default, draft, high, unit, sentence}."""
    rows = []
    for stage, kind in STAGE_OPTIONS.items():
        for f in dataclasses.fields(kind):
            row = {"option": f"{stage}.{f.name}", "default": f.default}
            for quality in ("draft", "high"):
                value = f.metadata[quality]
                row[quality] = f.default if value is None else value
            rows.append(row | {"unit": f.metadata["unit"], "sentence": f.metadata["sentence"]})
    return rows

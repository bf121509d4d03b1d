"""What a survey means for the avatar: a verdict on each property of a capture, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avatarbuild.artefacts import Views
from avatarbuild.capture_folder import CaptureFolder
from avatarbuild.faces import ANOTHER
from avatarbuild.portrait import handedness, likeness
from avatarbuild.survey import Survey
from avatarbuild.template import ARKIT_NAMES

GOOD, USABLE, RESHOOT = "good", "usable", "re-shoot"

MIN_PHOTOS = 8
# a face is there if this many photos, and this share of them, show one that can be trusted: a bust, a drawing or a
# pattern deceives the detector now and then, a person sitting for photos is found in most of them
_FACE_PHOTOS, _FACE_SHARE = 8, 0.25
_BIN = 15.0  # degrees of yaw that need a photo each
_STEEP = 10.0  # degrees above or below the middle at which a photo is one from above or below
_ALIKE = 12.0  # degrees between photos that see the face alike, whose light is compared
_ACTIVE = 0.5  # a score from which an expression is plainly there
_CHANGED = 0.5  # a score this far from the photos' median is another expression

_MIRRORED, _MIRRORED_LIKE = (
    0.3,
    0.6,
)  # asymmetries that disagree by as much, in portraits that agree when one is flipped

# The score network's outputs that no arrangement of the points raises; it has no tongueOut at all.
SILENT = (
    "jawForward",
    "cheekPuff",
    "cheekSquintLeft",
    "cheekSquintRight",
    "noseSneerLeft",
    "noseSneerRight",
    "tongueOut",
)
_SPEAKING = np.array([name not in SILENT for name in ARKIT_NAMES])
_BLINK = [ARKIT_NAMES.index("eyeBlinkLeft"), ARKIT_NAMES.index("eyeBlinkRight")]
# scores that a turn of the head hardly moves
_STEADY = np.array(
    [
        name.startswith(("eyeBlink", "jaw", "mouth", "browDown"))
        and not name.startswith(("mouthShrug", "mouthRoll", "mouthPress", "mouthClose", "mouthDimple"))
        for name in ARKIT_NAMES
    ]
)


@dataclass(frozen=True)
class Finding:
    """A line of the check: the property's name, what was found, a verdict, and what to do ('' where it is good)."""

    name: str
    found: str
    verdict: str
    advice: str
    values: dict[str, Any]


def has_face(photos: Survey, presence: float, max_yaw: float) -> bool:
    """Whether enough photos show a face for a head in millimetres."""
    sure = int(photos.views.trusted(presence, max_yaw).sum())
    return sure >= _FACE_PHOTOS and sure >= _FACE_SHARE * len(photos.views)


def neutral(views: Views, trusted: np.ndarray) -> np.ndarray:
    """
    (k,) bool: photos whose expression is the common one, with open eyes.

    No score that stays put under turns of the head may lie further than 0.5 from the median of trusted photos, nor
    may both blinks exceed 0.5.
    """
    if not trusted.any():
        return np.zeros(len(views), bool)
    return trusted & (_change(views, trusted) <= _CHANGED) & ~_shut(views)


def judge(
    photos: Survey, frames: Survey | None, seconds: float, folder: CaptureFolder, presence: float, max_yaw: float
) -> list[Finding]:
    """All findings, photos first; `frames` are samples of a video of `seconds`."""
    trusted = photos.views.trusted(presence, max_yaw)
    findings = [_count(photos), _face(photos, trusted, presence, max_yaw)]
    if has_face(photos, presence, max_yaw):
        findings += [
            _yaw(photos, trusted),
            _pitch(photos, trusted),
            _size(photos, trusted),
            _blur(photos, trusted),
            _exposure(photos, trusted),
            _white_balance(photos, trusted),
            _light(photos, trusted),
            _expression(photos, trusted),
            _eyes(photos, trusted),
            _others(photos, "photos"),
            _same_person(photos),
        ]
    findings += [_lens(photos), _copies(folder)]
    if frames is None:
        advice = "film 20 to 60 s of expressions from the front; without it the avatar has generic expressions"
        return [*findings, _finding("video", "none with a face", USABLE, advice, seconds=0.0)]
    findings += [_video(frames, seconds, presence), _others(frames, "video")]
    return findings + _same_video(photos, frames) + _shown(frames, presence)


def _count(photos: Survey) -> Finding:
    n = len(photos.views)
    verdict = GOOD if n >= 40 else USABLE if n >= 16 else RESHOOT
    return _finding("photos", f"{n} photos", verdict, "take 50 to 80 in a slow sweep about the head", count=n)


def _face(photos: Survey, trusted: np.ndarray, presence: float, max_yaw: float) -> Finding:
    n, sure = len(trusted), int(trusted.sum())
    found = f"seen well in {sure} of {n} photos"
    if not has_face(photos, presence, max_yaw):
        advice = "take photos in which one person's face is large and unobstructed; without it there is no avatar"
        return _finding("face", found, RESHOOT, advice, trusted=sure)
    return _finding("face", found, GOOD if sure >= 0.4 * n else USABLE, "take more photos from the front", trusted=sure)


def _yaw(photos: Survey, trusted: np.ndarray) -> Finding:
    """Every 15 degrees from -60 to 60 need a photo, and each profile one."""
    yaw = photos.views.pose[:, 0]
    edges = np.arange(-60.0, 60.0, _BIN)
    lacking = [(e, e + _BIN) for e in edges if not (trusted & (yaw >= e) & (yaw < e + _BIN)).any()]
    with np.errstate(invalid="ignore"):
        profiles = [bool((yaw > 60).any()), bool((yaw < -60).any())]
    words = [_from_side(*bounds) for bounds in lacking]
    words += [f"the profile of their {side} side" for side, seen in zip(("right", "left"), profiles) if not seen]
    seen = yaw[trusted]
    found = f"{seen.min():+.0f} to {seen.max():+.0f} degrees" + (f"; no view of {', '.join(words)}" if words else "")
    verdict = GOOD if not words else USABLE if len(lacking) <= 2 else RESHOOT
    advice = "walk the whole half circle from ear to ear, a photo every 5 degrees"
    lacks = [list(bounds) for bounds in lacking]
    return _finding(
        "yaw coverage", found, verdict, advice, lacking=lacks, profile_right=profiles[0], profile_left=profiles[1]
    )


def _from_side(low: float, high: float) -> str:
    """In words: the subject who looks to their left shows their right side."""
    if low < 0 < high:
        return "the front"
    side = "right" if low >= 0 else "left"
    a, b = sorted((abs(low), abs(high)))
    return f"their {side} side at {a:.0f}-{b:.0f} degrees"


def _pitch(photos: Survey, trusted: np.ndarray) -> Finding:
    pitch = photos.views.pose[trusted, 1]
    off = pitch - np.median(pitch)
    above, below = int((off < -_STEEP).sum()), int((off > _STEEP).sum())
    verdict = GOOD if min(above, below) >= 3 else USABLE
    found = f"{above} photos from above, {below} from below"
    advice = "add a row of photos from above the forehead and one from below the chin"
    return _finding("pitch coverage", found, verdict, advice, above=above, below=below)


def _size(photos: Survey, trusted: np.ndarray) -> Finding:
    resolution = float(np.median(photos.resolution[trusted]))
    verdict = GOOD if resolution >= 2.5 else USABLE if resolution >= 1.2 else RESHOOT
    found = f"{resolution:.1f} pixels a millimetre"
    return _finding(
        "face size", found, verdict, "step closer, until the head fills half the picture", resolution=resolution
    )


def _blur(photos: Survey, trusted: np.ndarray) -> Finding:
    """A photo is blurred where an edge spreads over 0.5 mm, or half as far again as in the photos' median."""
    blur = photos.blur
    usual = float(np.median(blur[trusted]))
    limit = max(0.2, min(0.5, 1.5 * usual))
    bad = trusted & (blur > limit)
    share = bad.sum() / trusted.sum()
    verdict = RESHOOT if usual > 0.6 or share > 0.4 else USABLE if usual > 0.35 or share > 0.1 else GOOD
    found = f"edges spread {usual:.2f} mm" + _named(photos.views, bad, "; blurred: ")
    advice = "keep the phone still for each photo, or give it more light"
    return _finding("blur", found, verdict, advice, blur_mm=usual, blurred=_names(photos.views, bad))


def _exposure(photos: Survey, trusted: np.ndarray) -> Finding:
    drift = _drift(photos.views, trusted, np.log2(np.maximum(photos.views.exposure, 1e-4))[:, None])
    low, high = np.percentile(photos.views.exposure[trusted], [5, 95])
    clipped = float(np.median(photos.views.clipped[trusted]))
    verdict = RESHOOT if drift > 1.5 or clipped > 0.1 or high < 0.02 else USABLE
    if drift <= 0.5 and clipped <= 0.02 and low >= 0.02:
        verdict = GOOD
    found = f"drifts by {drift:.1f} stops; skin at {100 * low:.0f} to {100 * high:.0f} %; {100 * clipped:.1f} % clipped"
    advice = "lock exposure (hold a finger on the face), and keep windows and lamps out of the picture"
    return _finding(
        "exposure", found, verdict, advice, drift_stops=drift, clipped=clipped, skin=[float(low), float(high)]
    )


def _white_balance(photos: Survey, trusted: np.ndarray) -> Finding:
    drift = _drift(photos.views, trusted, photos.views.white_balance)
    verdict = GOOD if drift <= 0.12 else USABLE if drift <= 0.35 else RESHOOT
    found = f"drifts by {100 * np.expm1(drift):.0f} %"
    return _finding(
        "white balance", found, verdict, "use one kind of light, and lock the camera's settings", drift=drift
    )


def _light(photos: Survey, trusted: np.ndarray) -> Finding:
    """By frontal photos: how unlike the cheeks are lit, and how far highlights rise over the skin's shade."""
    front = trusted & (np.abs(photos.views.pose[:, 0]) < 25) & np.isfinite(photos.side_light)
    if not front.any():
        return _finding(
            "light", "no frontal photo to judge it by", USABLE, "take photos from the front", side_stops=None
        )
    side, contrast = float(np.median(photos.side_light[front])), float(np.median(photos.contrast[front]))
    worst = max(abs(side), contrast - 0.5)
    verdict = GOOD if worst <= 1.0 else USABLE if worst <= 2.0 else RESHOOT
    brighter = "left" if side > 0 else "right"
    found = f"their {brighter} cheek is {abs(side):.1f} stops brighter; {contrast:.1f} stops from shade to highlight"
    advice = "turn so that soft light, such as a cloudy window or open shade, falls on the face from the front"
    return _finding("light", found, verdict, advice, side_stops=side, contrast_stops=contrast)


def _expression(photos: Survey, trusted: np.ndarray) -> Finding:
    views = photos.views
    changed = trusted & (_change(views, trusted) > _CHANGED)
    common = np.median(views.scores[trusted], axis=0)
    active = [n for n, v, steady in zip(ARKIT_NAMES, common, _STEADY) if steady and v > _ACTIVE]
    share = changed.sum() / trusted.sum()
    verdict = RESHOOT if share > 0.5 else USABLE if share > 0.15 or active else GOOD
    found = "the same in all photos" if not changed.any() else "changes" + _named(views, changed, " in ")
    if active:
        found += f"; not neutral: {', '.join(active)}"
    advice = "keep one relaxed face, mouth closed, for all photos"
    return _finding("expression", found, verdict, advice, changed=_names(views, changed), active=active)


def _eyes(photos: Survey, trusted: np.ndarray) -> Finding:
    shut = trusted & _shut(photos.views)
    share = shut.sum() / trusted.sum()
    verdict = GOOD if not shut.any() else USABLE if share <= 0.3 else RESHOOT
    found = "open" if not shut.any() else "closed" + _named(photos.views, shut, " in ")
    return _finding(
        "eyes", found, verdict, "keep the eyes open and look at one point", closed=_names(photos.views, shut)
    )


def _others(survey: Survey, where: str) -> Finding:
    more = survey.others > 0
    found = "nobody else" if not more.any() else "another person" + _named(survey.views, more, " in ")
    verdict = GOOD if not more.any() else USABLE
    advice = "the largest face is followed; keep other people and portraits out of the picture"
    return _finding(f"other people in {where}", found, verdict, advice, pictures=_names(survey.views, more))


def _lens(photos: Survey) -> Finding:
    lenses = len(np.unique(photos.views.lens))
    assumed = int(photos.assumed.sum())
    found = "one" if lenses == 1 else f"{lenses} lenses, zooms or picture sizes"
    if assumed:
        found += f"; no focal length in {assumed} photos, a phone's main camera is assumed"
    verdict = GOOD if lenses == 1 and not assumed else USABLE
    return _finding(
        "lens", found, verdict, "use one lens without zoom, and the original files", lenses=lenses, assumed=assumed
    )


def _copies(folder: CaptureFolder) -> Finding:
    out = folder.left_out
    found = "none" if not out else f"{len(out)} left out: " + _short([f"{f} ({why})" for f, why in out])
    return _finding("copies", found, GOOD, "", left_out=[[f.as_posix(), why] for f, why in out])


def _same_person(photos: Survey) -> Finding:
    """By the frontal photos; the others cannot be compared."""
    with np.errstate(invalid="ignore"):
        other = photos.unlike > ANOTHER
    compared = int(np.isfinite(photos.unlike).sum())
    share = other.sum() / max(compared, 1)
    found = f"the frontal photos ({compared}) are alike" + _named(photos.views, other, "; another's, not used: ")
    verdict = GOOD if not other.any() else USABLE if share <= 0.3 else RESHOOT
    advice = "make sure that all photos show one person, with the same hair, glasses and make-up"
    return _finding("person", found, verdict, advice, unlike=_names(photos.views, other))


def _video(frames: Survey, seconds: float, presence: float) -> Finding:
    with np.errstate(invalid="ignore"):
        seen = float((frames.views.presence >= presence).mean())
    verdict = GOOD if seconds >= 20 and seen >= 0.9 else USABLE if seconds >= 5 and seen >= 0.5 else RESHOOT
    if seconds > 90:
        verdict = USABLE
    file = frames.views.files[0]
    found = f"{file}: {seconds:.0f} s, the face in {100 * seen:.0f} % of frames"
    advice = "film 20 to 60 s of expressions from the front, the face always in view"
    return _finding("video", found, verdict, advice, file=file, seconds=seconds, face_share=seen)


def _same_video(photos: Survey, frames: Survey) -> list[Finding]:
    """Whether photos and video seem to show one person, the same way round."""
    if photos.identity is None or frames.identity is None:
        return []
    a, b = photos.identity.portrait, frames.identity.portrait
    hand = handedness(a, b)
    mirrored = hand < -_MIRRORED and likeness(a, b[:, ::-1]) > max(_MIRRORED_LIKE, likeness(a, b))
    unlike = float(np.nanmedian(frames.unlike))
    other = unlike > ANOTHER and not mirrored
    found = "seems to be another person than in the photos" if other else "seems to be the person in the photos"
    advice = "make sure that photos and video show one person, with the same hair, glasses and make-up"
    person = _finding("person in video", found, RESHOOT if other else GOOD, advice, unlikeness=unlike)
    found = "the video seems to be a mirror image of the photos" if mirrored else "no"
    advice = "switch off mirroring of the front camera in the phone's settings, or use the back camera"
    return [person, _finding("mirrored", found, RESHOOT if mirrored else GOOD, advice, handedness=hand)]


def _shown(frames: Survey, presence: float) -> list[Finding]:
    """An expression counts as shown when the odds of its score once rise tenfold over the video's median."""
    with np.errstate(invalid="ignore"):
        seen = frames.views.presence >= presence
    if seen.sum() < 2:
        return []
    scores = np.clip(frames.views.scores[seen][:, _SPEAKING], 1e-6, 1 - 1e-6)
    odds = np.log(scores / (1 - scores))
    rise = odds.max(0) - np.median(odds, axis=0)
    names = np.array(ARKIT_NAMES)[_SPEAKING]
    never = [str(name) for name in names[rise < np.log(10.0)]]
    verdict = GOOD if len(never) <= 8 else USABLE if len(never) <= 24 else RESHOOT
    found = f"{len(names) - len(never)} of {len(names)} shown" + (f"; never: {_short(never, 12)}" if never else "")
    advice = "film these too, slowly and one by one; the avatar has generic shapes for what is never shown"
    return [_finding("expressions", found, verdict, advice, never=never, cannot_be_judged=list(SILENT))]


def _change(views: Views, trusted: np.ndarray) -> np.ndarray:
    """(k,) the largest distance of a steady score from the trusted photos' median."""
    scores = views.scores[:, _SPEAKING & _STEADY]
    change = np.abs(scores - np.median(scores[trusted], axis=0)).max(1)
    return np.where(np.isfinite(change), change, np.inf)


def _shut(views: Views) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.asarray((views.scores[:, _BLINK] > _ACTIVE).all(1))


def _drift(views: Views, trusted: np.ndarray, value: np.ndarray) -> float:
    """The 90th percentile of |value_i - value_j| over photos that see the face from nearly one direction."""
    index = np.flatnonzero(trusted)
    near = np.abs(views.pose[index, None, :2] - views.pose[None, index, :2]).max(2) < _ALIKE
    i, j = np.nonzero(np.triu(near, 1))
    if not len(i):
        return 0.0
    return float(np.percentile(np.abs(value[index[i]] - value[index[j]]).max(1), 90))


def _finding(name: str, found: str, verdict: str, advice: str, **values: Any) -> Finding:
    return Finding(name, found, verdict, "" if verdict == GOOD else advice, values)


def _names(views: Views, chosen: np.ndarray) -> list[str]:
    return [views.names[i] for i in np.flatnonzero(chosen)]


def _named(views: Views, chosen: np.ndarray, before: str) -> str:
    return before + _short(_names(views, chosen)) if chosen.any() else ""


def _short(names: Sequence[str], most: int = 6) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more

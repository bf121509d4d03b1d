"""
Trials of stage tracking on a simulated capture with its truth; `benchmarks/tracking.py` runs them.

faults       10 % of the frames blurred, 1 s behind a hand, 1 s without the face: when the tracking is back, and what it
             does to the shapes
corrections  the detector's points of 30 processed frames disturbed by 8 pixels, 5 of them corrected by hand
unseen       shapes that the video never showed: how far from the truth, beside the transferred ones
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from avatarbuild.artefacts import Albedo, Blendshapes, Cameras, Capture, Clip, Neutral, Performance, Views
from avatarbuild.footage import read_clip
from avatarbuild.formats import video
from avatarbuild.formats.clip import encode_clip
from avatarbuild.formats.corrections import Corrections, corrections_bytes, read_corrections
from avatarbuild.new_footage import identity
from avatarbuild.options import CaptureOptions, TrackingOptions
from avatarbuild.progress import Silent
from avatarbuild.stages import tracking
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.tracking.lens import Lens

BLURRED, HIDDEN, GONE = 0.1, 1.0, 1.0  # share of the frames; seconds; seconds
BLUR = 0.12  # of the face's width: the way of the hand's shake
BACK = 1.5  # times the undisturbed frame's own error, plus 0.3 mm: the tracking is back
DISTURBED, SHIFT, CORRECTED = 30, 8.0, 5
GROUPS = ((0, 17), (17, 27), (27, 36), (36, 48), (48, 68))  # jaw, brows, nose, eyes, mouth of the 68 points
UNSEEN = 0.02  # of a weight, true: a shape that the video does not show
FAINT = 0.1  # evidence
LEAST_MM = 0.5  # shapes that move less are not judged


def inputs(project: Path) -> dict[str, Any]:
    kinds = {"01-capture": Capture, "02-cameras": Cameras, "04-neutral": Neutral, "05-albedo": Albedo}
    kinds["06-blendshapes"] = Blendshapes
    return {name[3:]: kind.load(project / name) for name, kind in kinds.items()}


def tracked(given: dict[str, Any], template: Template, source: Path, told: Corrections | None = None) -> Performance:
    more = {"template": template, "source": source, "corrections": told}
    return tracking.run(**given, options=TrackingOptions(), progress=Silent(), **more)


def beginning(capture: Capture, seconds: float) -> Capture:
    """The capture with the first seconds of its clip."""
    clip = capture.clip
    assert clip is not None
    f = int(np.searchsorted(clip.times, seconds))
    j = int(np.searchsorted(clip.processed, f))
    return replace(
        capture,
        clip=replace(
            clip, times=clip.times[:f], processed=clip.processed[:j], frames=chosen(clip.frames, np.arange(j))
        ),
    )


def chosen(views: Views, which: np.ndarray) -> Views:
    lists = {name: [getattr(views, name)[i] for i in which] for name in ("names", "files", "images")}
    arrays = {k: v[which] for k, v in vars(views).items() if isinstance(v, np.ndarray)}
    return Views(**lists, **arrays)


# faults


def spoilt(clip: Clip, source: Path, out: Path, seed: int = 0) -> dict[str, list[int]]:
    """Writes the clip with its faults to `out`; the decoded frames of each."""
    rng = np.random.default_rng(seed)
    f = len(clip.times)
    length = max(1, round(clip.fps * HIDDEN))
    hidden = list(range(f // 3, f // 3 + length))
    gone = list(range(2 * f // 3, 2 * f // 3 + max(1, round(clip.fps * GONE))))
    free = [i for i in range(f) if i not in hidden and i not in gone]
    blurred = sorted(rng.choice(free, round(BLURRED * f), replace=False).tolist())
    seen = np.flatnonzero(np.isfinite(clip.frames.presence))

    def picture(i: int, rgb: np.ndarray) -> np.ndarray:
        near = seen[np.abs(clip.processed[seen] - i).argmin()]
        face = clip.frames.landmarks[near, :468, :2]
        if i in hidden:
            return behind_a_hand(rgb, face, (i - hidden[0]) / length)
        if i in gone:
            return without_the_face(rgb, rng)
        return shaken(rgb, BLUR * float(np.ptp(face[:, 0])), rng.uniform(0, np.pi)) if i in blurred else rgb

    path = out / clip.file
    path.parent.mkdir(parents=True, exist_ok=True)
    encode_clip(path, (picture(i, rgb) for i, _, rgb in video.decode_frames(source / clip.file, range(f))), clip.fps)
    return {"blurred": blurred, "hidden": hidden, "gone": gone}


def shaken(rgb: np.ndarray, way: float, angle: float) -> np.ndarray:
    """A picture exposed while the camera moved by `way` pixels."""
    n = 2 * int(way / 2) + 1
    kernel = np.zeros((n, n), np.float32)
    ends = [np.array([n // 2, n // 2]) + side * n / 2 * np.array([np.cos(angle), np.sin(angle)]) for side in (-1, 1)]
    cv2.line(kernel, *(tuple(int(v) for v in np.round(end)) for end in ends), 1.0)
    return cv2.filter2D(rgb, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


def behind_a_hand(rgb: np.ndarray, face: np.ndarray, share: float) -> np.ndarray:
    """A hand of the face's own colour, palm and four fingers, that crosses the face from one side to the other."""
    out = rgb.copy()
    middle, size = face.mean(axis=0), np.ptp(face, axis=0)
    x, y = face[[50, 280]].mean(axis=0).astype(int)
    skin = np.median(rgb[max(y - 8, 0) : y + 8, max(x - 8, 0) : x + 8].reshape(-1, 3), axis=0)
    palm = middle + size * ((share - 0.5) * 0.8, 0.25)
    cv2.ellipse(out, _point(palm), _point(size * (0.36, 0.3)), 20, 0, 360, (0.92 * skin).tolist(), -1, cv2.LINE_AA)
    for k in range(4):
        start, end = palm + size * (0.2 * (k - 1.5), -0.15), palm + size * (0.24 * (k - 1.5), -0.62)
        width = max(2, int(0.15 * size[0]))
        cv2.line(out, _point(start), _point(end), ((0.98 - 0.05 * (k % 2)) * skin).tolist(), width, cv2.LINE_AA)
        cv2.circle(out, _point(end), width // 3, (0.8 * skin + 40).tolist(), -1, cv2.LINE_AA)
    return out


def without_the_face(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The wall at the picture's edges, where the person was."""
    left, right = rgb[:, :8].mean(axis=1), rgb[:, -8:].mean(axis=1)
    share = np.linspace(0, 1, rgb.shape[1])[None, :, None]
    wall = cv2.GaussianBlur((1 - share) * left[:, None] + share * right[:, None], (0, 0), 9)
    return np.clip(wall + rng.normal(0, 3, rgb.shape), 0, 255).astype(np.uint8)


def _point(at: np.ndarray) -> tuple[int, int]:
    return int(at[0]), int(at[1])


def faults(project: Path, source: Path, judge: Any, template: Template, out: Path, seconds: float) -> None:
    given = inputs(project)
    given["capture"] = beginning(given["capture"], seconds)
    clip = given["capture"].clip
    plain = tracked(given, template, source)
    when = spoilt(clip, source, out)
    known = identity(given["capture"], CaptureOptions().presence)
    film = video.open_video(out / clip.file)
    bad, _ = read_clip(film, Path(clip.file), clip.focal, known, CaptureOptions(), Silent(), copies=True)
    hurt = tracked(given | {"capture": replace(given["capture"], clip=bad)}, template, out)
    errors = {
        "without": point_errors(judge, plain, range(len(clip.times))),
        "with": point_errors(judge, hurt, range(len(clip.times))),
    }
    fine = errors["with"] < BACK * errors["without"] + 0.3
    faulty = sorted(i for frames in when.values() for i in frames)
    clear = np.setdiff1d(np.arange(len(clip.times)), faulty)
    print("quality:", ", ".join(f"{what} {hurt.quality[i].mean():.2f}" for what, i in {**when, "clear": clear}.items()))
    for what in ("hidden", "gone"):
        after = [i for i in hurt.processed if i > when[what][-1]]
        print(f"{what}: right again in processed frame {1 + next(n for n, i in enumerate(after) if fine[i])} after it")
    for name, e in errors.items():
        print(f"points {name} faults: clear frames {e[clear].mean():.3f} mm, blurred {e[when['blurred']].mean():.3f}")
    moving = np.linalg.norm(plain.deltas, axis=2) > LEAST_MM
    apart = np.linalg.norm(hurt.deltas - plain.deltas, axis=2)[moving]
    taught = np.linalg.norm(plain.deltas - given["blendshapes"].deltas, axis=2)[moving]
    for name, off in (("with and without faults", apart), ("learnt and transferred", taught)):
        print(f"shapes {name}, where they move: {off.mean():.3f} mm apart, 95 % {np.quantile(off, 0.95):.3f}")
    for name, made in (("without", plain), ("with", hurt)):
        rig = replace(plain, deltas=made.deltas, neutral=made.neutral)
        e = point_errors(judge, rig, plain.processed)
        print(f"processed frames' points with the shapes learnt {name} faults: {e.mean():.3f} mm")


def point_errors(judge: Any, made: Performance, frames: Iterable[int]) -> np.ndarray:
    """(f,) mm: corresponding points."""
    return np.array([row[1] for row in judged(judge, made, frames)])


def judged(judge: Any, made: Performance, frames: Iterable[int]) -> list[Any]:
    judge.lens = Lens(made.focal, made.k1, made.size)
    deltas = made.deltas.astype(float)
    posed = (made.neutral + np.tensordot(made.weights[f], deltas, 1) for f in frames)
    return [judge.frame(f, x, made.rotation[f], made.translation[f]) for f, x in zip(frames, posed, strict=True)]


# corrections


def disturbed(clip: Clip, template: Template, seed: int = 0) -> tuple[Clip, np.ndarray]:
    """The clip whose detector is off by SHIFT pixels in DISTURBED frames, each part of the face its own way; which."""
    rng = np.random.default_rng(seed)
    seen = np.flatnonzero(np.isfinite(clip.frames.presence))
    first = (len(seen) - DISTURBED) // 2
    which = seen[first : first + DISTURBED]
    marks = clip.frames.landmarks.copy()
    middle = marks[which[0], :468, :2]
    groups = [template.landmarks68[a:b] for a, b in GROUPS]
    nearest = np.argmin([np.linalg.norm(middle[:, None] - middle[g], axis=2).min(axis=1) for g in groups], axis=0)
    angles = rng.uniform(0, 2 * np.pi, len(groups))
    way = SHIFT * np.stack([np.cos(angles), np.sin(angles)], axis=1)[nearest]
    marks[which[:, None], np.arange(468), :2] += way
    return replace(clip, frames=replace(clip.frames, landmarks=marks)), which


def corrections(project: Path, source: Path, judge: Any, template: Template, seconds: float) -> None:
    given = inputs(project)
    given["capture"] = beginning(given["capture"], seconds)
    clip = given["capture"].clip
    bad, which = disturbed(clip, template)
    hand = which[np.linspace(0, len(which) - 1, CORRECTED).round().astype(int)]
    true, shown = judge.truth.v["landmarks68"], judge.truth.v["landmarks68_visible"]
    numbers = clip.processed[hand].tolist()
    told = Corrections(
        {i: {k: true[i, k].astype(float) + 0.5 for k in np.flatnonzero(shown[i]).tolist()} for i in numbers}
    )
    told = read_corrections(corrections_bytes(told), "corrections.json")  # as the page of corrections saves them
    hurt = given | {"capture": replace(given["capture"], clip=bad)}
    found = {
        "sound points": tracked(given, template, source),
        "disturbed": tracked(hurt, template, source),
        "corrected": tracked(hurt, template, source, told),
    }
    frames = clip.processed[which]
    means = {}
    for name, made in found.items():
        rows = judged(judge, made, frames)
        means[name] = np.array([[row[1], row[4]] for row in rows]).mean(axis=0)
        print(f"{name:13s} points {means[name][0]:.3f} mm, landmarks {means[name][1]:.2f} px")
    gone = 1 - (means["corrected"] - means["sound points"]) / (means["disturbed"] - means["sound points"])
    print(f"of what the disturbance did {100 * gone[0]:.0f} % (points), {100 * gone[1]:.0f} % (landmarks) is gone")


# shapes that the video did not show


def unseen(judge: Any, made: Performance, transferred: Blendshapes, frames: np.ndarray) -> None:
    """`frames`: those that could have taught."""
    truth = judge.truth
    most = {name: float(np.max(w[frames])) for name, w in truth.arkW.items()}
    rows = []
    for j, name in enumerate(truth.ark):
        true = truth.true[j][judge.points]
        if name not in ARKIT_NAMES or np.linalg.norm(true, axis=1).max() < LEAST_MM:
            continue
        i = ARKIT_NAMES.index(name)
        off = [np.linalg.norm(judge.moved(deltas[i].astype(float)) - true, axis=1) for deltas in
               (transferred.deltas, made.deltas)]  # fmt: skip
        share = judge.area / judge.area.sum()
        rows.append((most.get(name, 0.0) < UNSEEN, made.evidence[i], *(float(np.sqrt(share @ o**2)) for o in off)))
    table = np.array(rows, float)
    hidden, faint = table[:, 0] > 0, table[:, 1] < FAINT
    for label, some in (("never shown", hidden), ("shown", ~hidden), (f"of evidence < {FAINT}", faint)):
        if some.any():
            before, after = table[some, 2].mean(), table[some, 3].mean()
            worst = (table[some, 3] - table[some, 2]).max()
            told = f"transferred {before:.3f} mm, own {after:.3f}, worst change {worst:+.3f}"
            print(f"{int(some.sum()):2d} shapes {label}: {told}")

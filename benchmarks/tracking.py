"""
How near the tracked performance is to the truth, and what learning the person's own shapes is worth.

python benchmarks/tracking.py PROJECT --truth TRUTH --scorer score.py
AVATARBUILD_BENCHMARK=FOLDER stands for --truth FOLDER/truth_b --scorer FOLDER/score.py. Stage tracking must have run;
with `--set tracking.leave_out=3` the frames that taught nothing are shown apart. Rows: surface after a rigid motion a
frame, corresponding points after one (and its parts across and along the line of sight), five skin points' drift in
pixels; for the person's own shapes, the transferred ones at the same weights, the refined ones where stage refinement
has run, and no expression at all.

Trials (tracking_trials.py), each of which runs the stage several times and writes nothing into the project:
python benchmarks/tracking.py PROJECT --truth TRUTH --scorer score.py --trial faults --capture CAPTURE [--seconds 34]
… --trial corrections --capture CAPTURE; … --trial unseen (of 07-tracking as it is)
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import tracking_trials
from scoring import arguments, load_scorer, scored

from avatarbuild.artefacts import Blendshapes, Capture, Performance, Refinement
from avatarbuild.geometry.raster import project
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.tracking.lens import Lens

EVERY = 4  # frame of the whole clip
LEAST = 0.2  # channels of the truth that move by less are not judged


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--trial", choices=("faults", "corrections", "unseen"))
    parser.add_argument("--capture", type=Path, help="the capture's folder, for faults and corrections")
    parser.add_argument("--seconds", type=float, default=1e9, help="of the clip, from its beginning")
    a = scored(parser)
    scorer, template = load_scorer(a.scorer), Template.load()
    truth = scorer.GT(str(a.truth))
    if a.trial in ("faults", "corrections"):
        rest, clip = Blendshapes.load(a.project / "06-blendshapes").neutral, Capture.load(a.project / "01-capture").clip
        assert clip is not None
        sight = Judge(scorer, truth, template, rest, Lens(clip.focal, 0.0, clip.size))
        if a.trial == "corrections":
            tracking_trials.corrections(a.project, a.capture, sight, template, a.seconds)
        else:
            with tempfile.TemporaryDirectory() as folder:
                tracking_trials.faults(a.project, a.capture, sight, template, Path(folder), a.seconds)
        return
    made = Performance.load(a.project / "07-tracking")
    transferred = Blendshapes.load(a.project / "06-blendshapes")
    sight = Judge(scorer, truth, template, transferred.neutral, Lens(made.focal, made.k1, made.size))
    if a.trial == "unseen":
        tracking_trials.unseen(sight, made, transferred, made.processed[made.modelled])
        return
    groups = {"processed": made.processed, "all": np.arange(0, len(made.times), EVERY)}
    if not made.modelled.all():
        groups["left out"] = made.processed[~made.modelled]
    rigs = {
        "own shapes": (made.neutral, made.deltas.astype(float)),
        "transferred": (transferred.neutral, transferred.deltas.astype(float)),
        **refined(a.project / "08-refinement"),
        "no expression": (made.neutral, np.zeros_like(made.deltas, float)),
    }
    print(f"{'':26s} surface   90 %  corresponding (across, along)  drift 50 %, 95 %  landmarks, px")
    for group, frames in groups.items():
        for name, (neutral, deltas) in rigs.items():
            rows = [
                sight.frame(
                    f, neutral + np.tensordot(made.weights[f], deltas, 1), made.rotation[f], made.translation[f]
                )
                for f in frames
            ]
            surface, point, across, along, marks = (np.array([row[k] for row in rows]) for k in range(5))
            drift = np.array([row[5] for row in rows])
            print(
                f"{group + ', ' + name:26s} {surface.mean():7.3f} {np.quantile(surface, 0.9):6.3f} {point.mean():9.3f}"
                f" ({across.mean():.3f}, {along.mean():.3f}) {np.median(drift):15.2f} {np.quantile(drift, 0.95):6.2f}"
                f" {marks.mean():14.2f}",
                flush=True,
            )
    weights(truth, made)


def refined(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Neutral and shapes as stage refinement leaves them, where it has run."""
    if not (folder / "stamp.json").is_file():
        return {}
    made = Refinement.load(folder)
    return {"refined": (made.neutral, made.deltas.astype(float))}


def weights(truth: Any, made: Performance) -> None:
    """Correlation with the true weights of each channel that moves."""
    found = {}
    for name, true in truth.arkW.items():
        if name in ARKIT_NAMES and np.ptp(true) >= LEAST:
            own = made.weights[: len(true), ARKIT_NAMES.index(name)]
            found[name] = float(np.corrcoef(true[: len(own)], own)[0, 1]) if own.std() > 1e-6 else 0.0
    worst = ", ".join(f"{name} {value:.2f}" for name, value in sorted(found.items(), key=lambda item: item[1])[:10])
    print(f"weights: median correlation {np.median(list(found.values())):.2f} of {len(found)} channels; worst {worst}")


class Judge:
    """The truth's skin points on the avatar: fixed once, on the heads at rest."""

    def __init__(self, scorer: ModuleType, truth: Any, template: Template, neutral: np.ndarray, lens: Lens) -> None:
        self.scorer, self.truth, self.lens = scorer, truth, lens
        self.skin = template.triangles[template.parts["skin"].triangles].astype(np.int64)
        marks = template.landmarks(neutral / 1000)[template.landmarks68]
        head = {"V": neutral / 1000, "F": self.skin, "UV": None, "morph": {}}
        (size, R, t), _, _ = scorer.align_neutral(head, truth, marks, False)
        self.size, self.turn = size / 1000, R
        self.points = np.unique(np.concatenate([truth.narrow[::3], truth.lm[17:]]))
        surface = scorer.Surface(self.size * neutral @ R.T + t, self.skin)
        _, self.triangle, self.share, _ = surface.closest(truth.V[self.points])
        self.area = scorer.varea(truth.V, truth.F)[self.points]
        self.marks = np.searchsorted(self.points, truth.lm[17:])
        lm = truth.V[truth.lm]
        five = (
            (lm[36] + lm[48]) / 2 + (0, 0, 12),  # cheeks
            (lm[45] + lm[54]) / 2 + (0, 0, 12),
            (lm[21] + lm[22]) / 2 + (0, 25, 0),  # forehead
            (lm[57] + lm[8]) / 2,  # chin
            lm[27],  # bridge of the nose
        )
        self.five = [int(np.linalg.norm(truth.V[self.points] - p, axis=1).argmin()) for p in five]

    def moved(self, deltas: np.ndarray) -> np.ndarray:
        """Displacements (n, 3) of the avatar at the truth's points, in the truth's axes."""
        own = (deltas[self.skin[self.triangle]] * self.share[..., None]).sum(axis=1)
        return self.size * own @ self.turn.T

    def frame(
        self, f: int, posed: np.ndarray, R: np.ndarray, t: np.ndarray
    ) -> tuple[float, float, float, float, float, np.ndarray]:
        """Surface, corresponding points, their parts across and along the sight, landmarks, the five points' drift."""
        scorer, truth = self.scorer, self.truth
        true = scorer.apply(truth.head2cam(f), truth.frame(f))[self.points]
        own = (posed[self.skin[self.triangle]] * self.share[..., None]).sum(axis=1)
        pixels = self.lens.project(own @ R.T + t)[0] - 0.5
        seen, _ = project(true, truth.v["K"], truth.v["dist"], np.eye(3), np.zeros(3))
        off = np.linalg.norm(pixels - seen, axis=1)
        visible = truth.v["landmarks68_visible"][f][17:]
        marks = np.linalg.norm(pixels[self.marks] - truth.v["landmarks68"][f][17:], axis=1)[visible].mean()
        metric = self.size * own @ R.T
        _, turn, shift = scorer.umeyama(metric, true, self.area, scale=False)
        left = metric @ turn.T + shift - true
        share = self.area / self.area.sum()
        surface = scorer.rigid_p2plane((true - shift) @ turn, scorer.Surface(self.size * posed @ R.T, self.skin))
        return (
            float(share @ surface),
            float(share @ np.linalg.norm(left, axis=1)),
            float(share @ np.linalg.norm(left[:, :2], axis=1)),
            float(share @ np.abs(left[:, 2])),
            float(marks),
            off[self.five],
        )


if __name__ == "__main__":
    main()

"""
How well details synthesised from the expression alone match frames that took no part in the training.

python benchmarks/left_out_details.py PROJECT --capture CAPTURE --truth TRUTH --scorer score.py
AVATARBUILD_BENCHMARK=FOLDER stands for --capture FOLDER/capture_b --truth FOLDER/truth_b --scorer FOLDER/score.py.
Every stage must have run. Stage details runs again, in memory, without the processed frames within AWAY seconds of the
truth's frames of normals. Printed, for each of those: degrees to the true normals of the mesh alone, of the frame's own
relief, and of the synthesised details, over the face and where wrinkles tilt the skin by more than 8 degrees (which
needs the scorer's open3d).
"""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
from scoring import arguments, benchmark, load_scorer, scored

from avatarbuild import pipeline
from avatarbuild.artefacts import Albedo, Capture, Performance, Refinement
from avatarbuild.formats.details import read_details
from avatarbuild.options import DetailsOptions
from avatarbuild.progress import Silent
from avatarbuild.project import Project
from avatarbuild.shading import maps
from avatarbuild.shading.clip import posed
from avatarbuild.shading.observation import at_uv
from avatarbuild.shading.surface import draw, fine_skin
from avatarbuild.stages import details
from avatarbuild.template import Template
from avatarbuild.tracking.lens import Lens

AWAY = 0.5  # seconds between what is judged and what taught


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--capture", type=Path, default=benchmark("capture_b"))
    a = scored(parser)
    scorer, template, project = load_scorer(a.scorer), Template.load(), Project(a.project)
    truth = scorer.GT(str(a.truth))
    keys = [np.load(path) for path in sorted(a.truth.glob("normals_*.npz"))]
    numbers = [int(key["frame"]) for key in keys]
    names = ("capture", "albedo", "tracking", "refinement")
    capture, albedo, performance, refinement = (pipeline.load_artefact(project, name) for name in names)
    assert isinstance(capture, Capture)
    assert isinstance(albedo, Albedo)
    assert isinstance(performance, Performance)
    assert isinstance(refinement, Refinement)
    times = performance.times[performance.processed]
    near = np.abs(times[:, None] - performance.times[numbers]).min(axis=1) < AWAY
    teaching = replace(performance, modelled=performance.modelled & ~near)
    wanted = DetailsOptions(save_frames=",".join(map(str, numbers)))
    made = details.run(capture, albedo, teaching, refinement, wanted, Silent(), template, a.capture)
    synthesis = read_details({n: b for n, b in made.files.items() if not n.startswith("frames/")}, template)
    head = replace(performance, neutral=refinement.neutral, deltas=refinement.deltas)
    lens, skin = Lens(head.focal, head.k1, head.size), fine_skin(template, albedo.albedo)
    chart = maps.face_chart(template, synthesis.side)
    rows = []
    for key, number in zip(keys, numbers, strict=True):
        view = posed(head, number, 0)
        drawn = draw(skin, view.vertices, lens, view.R, view.t, 1, whole=True)
        axes = maps.frames(chart, view.vertices)
        local = synthesis.evaluate(synthesis.strain_of(view.vertices)).reshape(-1, 4)[chart.flat, :3]
        bent = local[:, :1] * axes.tangent + local[:, 1:2] * axes.bitangent + local[:, 2:] * axes.normal
        change = chart.map((bent - axes.normal) @ view.R.T, 0.0).astype(np.float32)
        own = np.load(io.BytesIO(made.files[f"frames/normals_{number:04d}.npz"]))["normal"].astype(np.float64)
        shown = {"mesh": drawn.normal, "own": own, "synthesised": drawn.normal + at_uv(change, drawn.uv)}
        box, mask = key["bbox"], key["mask"]
        true = unit(key["normal"].astype(np.float64))
        smooth = scorer.gt_coarse_normals(truth, number, box)
        mask = mask & (np.abs(smooth).sum(-1) > 0.5)
        cut = {name: unit(n[box[0] : box[1], box[2] : box[3]]) for name, n in shown.items()}
        for n in cut.values():
            mask = mask & (np.abs(n).sum(-1) > 0.5)
        folded = mask & (scorer.ang(true, smooth) > 8)
        off = {name: scorer.ang(true, n) for name, n in cut.items()}
        rows.append([[float(e[where].mean()) for e in off.values()] for where in (mask, folded)])
        print(f"frame {number}: " + _told(np.array(rows[-1])))
    mean = np.mean(rows, axis=0)
    print(f"{int(near.sum())} of {len(near)} processed frames left out; mean: {_told(mean)}")


def _told(row: np.ndarray) -> str:
    return "; ".join(
        f"{where}: mesh {mesh:.2f}, own {own:.2f}, synthesised {new:.2f} degrees (x {new / own:.2f})"
        for where, (mesh, own, new) in zip(("face", "wrinkles"), row, strict=True)
    )


def unit(n: np.ndarray) -> np.ndarray:
    """(…, 3); zero where nothing is known."""
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    return np.where(length > 0.5, n / np.maximum(length, 1e-9), 0)


if __name__ == "__main__":
    main()

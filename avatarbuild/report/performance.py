"""The page's section of the video: the head over its frames, weights over time, what the video taught."""

from __future__ import annotations

from dataclasses import replace
from html import escape

import numpy as np

from avatarbuild.artefacts import Blendshapes, Capture, Performance
from avatarbuild.report import diagrams, footage, overlay
from avatarbuild.report.heads import Figure
from avatarbuild.report.html import paragraph, picture, row, section
from avatarbuild.template import ARKIT_NAMES, Template

_FRAME = (480, 576)
_FRAMES, _PLOTTED, _COMPARED = 6, 12, 5
_LEARNT, _TRANSFERRED = 0.5, 0.1  # evidence from which a shape is the video's, below which it is the template's


def performance_section(
    capture: Capture, performance: Performance, blendshapes: Blendshapes, figure: Figure, template: Template
) -> str:
    """The section; figure wears the performance's rig, blendshapes are the transferred ones."""
    seen = footage.footage(capture, performance)
    plotted = footage.most_active(performance, _PLOTTED)
    lost = int((performance.quality <= 0).sum())
    said = (
        f"{len(performance.times)} frames in {performance.times[-1]:.1f} s, {len(performance.processed)} of them "
        f"tracked in full, {int(performance.modelled.sum())} of these used to learn the shapes. "
        + ("The face was found in every frame." if not lost else f"The face was lost in {lost} of all.")
    )
    pictures = _over_frames(capture, performance, seen, figure, template)
    plot = f'<div class="card">{diagrams.weights(performance, plotted)}</div>' if plotted else ""
    return section(
        "performance",
        "Performance",
        paragraph(escape(said))
        + (row(pictures, "grid3 photos") if pictures else "")
        + "<h3>Weights over time</h3>"
        + paragraph(
            f"The {len(plotted)} shapes that move the face most, each from 0 to 1, over the seconds of the video."
            + (" Tinted: the face was lost, the weights are held." if lost else "")
        )
        + plot
        + _before_and_after(capture, performance, blendshapes, seen, figure, template)
        + _evidence(performance),
    )


def _over_frames(
    capture: Capture, performance: Performance, seen: footage.Footage, figure: Figure, template: Template
) -> list[str]:
    lines, made = overlay.lines_of(template), []
    for k in footage.spread(performance, seen, _FRAMES):
        i = int(seen.numbers[k])
        crop = overlay.mesh_over_photo(
            _image(capture, int(seen.places[k])),
            footage.shot(performance, i),
            _posed(figure, performance, i)[: template.vertex_count],
            template,
            lines,
            _FRAME,
        )
        made.append(picture(crop.image, f"The head over frame {i}", _moment(performance, i)))
    return made


def _before_and_after(
    capture: Capture,
    performance: Performance,
    blendshapes: Blendshapes,
    seen: footage.Footage,
    figure: Figure,
    template: Template,
) -> str:
    if not len(seen.numbers):
        return ""
    transferred = replace(figure, blendshapes=blendshapes)
    rows = []
    for name in footage.most_active(performance, _COMPARED, pairs=False):
        j = ARKIT_NAMES.index(name)
        k = int(performance.weights[seen.numbers, j].argmax())
        i = int(seen.numbers[k])
        at = footage.shot(performance, i)
        before, after = _posed(transferred, performance, i), _posed(figure, performance, i)
        rgb = _image(capture, int(seen.places[k]))
        crop = footage.about(rgb, at, after[: template.vertex_count], performance.deltas[j], template)
        face = np.flatnonzero(template.regions["face"])
        off = float(np.linalg.norm(after[face] - before[face], axis=1).max())
        drawn = [footage.through(at, crop, x, figure.triangles, figure.paint) for x in (before, after)]
        weight = f"{name} at {performance.weights[i, j]:.2f}, frame {i}"
        rows.append(
            picture(crop.image, f"{name} in frame {i}", weight)
            + picture(drawn[0], f"{name} as transferred", "As transferred")
            + picture(drawn[1], f"{name} as learnt", f"As learnt: up to {off:.1f} mm away")
        )
    return (
        "<h3>Before and after learning</h3>"
        + paragraph(
            "The shapes that move the face most, where each is strongest: the frame, the head with the template’s "
            "shapes transferred to it, and with the shapes that the video taught, all with the same weights."
        )
        + "".join(row([three], "grid3 photos") for three in rows)
    )


def _evidence(performance: Performance) -> str:
    """Two tables side by side: shape, its most weight, and how far the video decided it."""
    most = performance.weights.max(axis=0)
    order = np.argsort(-performance.evidence, kind="stable")
    cells = [
        f'<tr><th scope="row"><code>{ARKIT_NAMES[j]}</code></th><td class="number">{most[j]:.2f}</td>'
        f'<td class="number">{performance.evidence[j]:.2f}</td><td>{_source(float(performance.evidence[j]))}</td></tr>'
        for j in order
    ]
    head = "<tr><th>Shape</th><th>Most shown</th><th>Evidence</th><th>Comes from</th></tr>"
    half = (len(cells) + 1) // 2
    tables = [f'<table class="evidence">{head}{"".join(part)}</table>' for part in (cells[:half], cells[half:])]
    return (
        "<h3>What the video taught</h3>"
        + paragraph(
            "For each shape its largest weight in the video, and the evidence: 1 where the video decided it, 0 where "
            "the video hardly shows it and it stays as transferred. To teach a shape, show it in the video by itself."
        )
        + f'<div class="plans">{"".join(tables)}</div>'
    )


def _source(evidence: float) -> str:
    if evidence >= _LEARNT:
        return "the video"
    return "both" if evidence >= _TRANSFERRED else "the template"


def _posed(figure: Figure, performance: Performance, frame: int) -> np.ndarray:
    weights = performance.weights[frame]
    return figure.posed({name: float(w) for name, w in zip(ARKIT_NAMES, weights, strict=True)})


def _image(capture: Capture, place: int) -> np.ndarray:
    assert capture.clip is not None
    return capture.clip.frames.images[place].rgb()


def _moment(performance: Performance, frame: int) -> str:
    return f"Frame {frame}, at {performance.times[frame]:.1f} s, quality {performance.quality[frame]:.2f}"

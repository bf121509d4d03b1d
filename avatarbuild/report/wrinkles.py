"""The page's section of the details: the keyframes' expressions, without and with what comes and goes with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatarbuild.animation.picture import exposed, frame, model
from avatarbuild.artefacts import Albedo, Blendshapes, Details, Performance
from avatarbuild.formats.details import read_details
from avatarbuild.report.html import paragraph, picture, row, section
from avatarbuild.report.rendering import View
from avatarbuild.template import Template

_SHOWN = 3
_VIEW = View(size=(300, 340), height=210.0, centre=(0.0, -12.0, 0.0), distance=800.0)


def wrinkles_section(
    details: Details, performance: Performance, albedo: Albedo, rig: Blendshapes, template: Template
) -> str:
    """The section; empty without details."""
    if not details.files:
        return ""
    synthesis = read_details(details.files, template)
    without = model(template, rig, albedo, None)
    wearing = replace(without, details=synthesis)
    light = exposed(albedo.harmonics)
    pictures = []
    depth = [float(np.arccos(np.clip(synthesis.evaluate(key)[..., 2], -1, 1)).mean()) for key in synthesis.keys.strain]
    for number in synthesis.keys.rows[np.argsort(depth)[::-1][:_SHOWN]]:
        weights = performance.weights[int(number)]
        for made, said in ((without, "without"), (wearing, "with details")):
            drawn = frame(made, weights, np.eye(3), _VIEW, light)
            pictures.append(picture(drawn, f"The expression of frame {number}, {said}", f"Frame {number}, {said}"))
    return section(
        "details",
        "Wrinkles",
        paragraph(
            f"{synthesis.keys.count} keyframes of the video hold the wrinkles of every expression and their shadows; "
            "here are the deepest. What all frames have in common is in the avatar's own normal map."
        )
        + row(pictures, "pair"),
    )

"""The rig of stage blendshapes for the viewer's page, beside the personalised one."""

from __future__ import annotations

import cv2
import numpy as np

from avatarbuild.artefacts import Blendshapes
from avatarbuild.formats import avatar_glb
from avatarbuild.project import Project
from avatarbuild.template import Template

_LEAST_MOTION, _LEAST_TURN = 0.02, 0.6  # mm, degrees: less than this the rig leaves out
_PIXEL = np.full((1, 1, 3), 128, np.uint8)


def transferred(project: Project, template: Template) -> bytes:
    """The rig of stage blendshapes, transferred from the template, as a GLB with the same meshes and no pictures."""
    rig = project.read("blendshapes", Blendshapes)
    pixel = cv2.imencode(".png", _PIXEL)[1].tobytes()
    grey = cv2.imencode(".png", _PIXEL[..., 0])[1].tobytes()
    shapes = avatar_glb.Rig(rig.neutral, rig.deltas, rig.eye_centres, _LEAST_MOTION, _LEAST_TURN)
    return avatar_glb.write(template, shapes, avatar_glb.Pictures(pixel, pixel, pixel, grey), {}).glb

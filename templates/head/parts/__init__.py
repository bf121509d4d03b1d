"""Eyeballs, teeth, gums and tongue of the head template, made by formula."""

from .colours import colours
from .eyeball import eyeball, eyeball_radius
from .gums import gums
from .hinge import Rigid, fit_rigid, jaw_opening
from .part import Part
from .teeth import crowns, teeth
from .tongue import tongue

__all__ = [
    "Part",
    "Rigid",
    "colours",
    "crowns",
    "eyeball",
    "eyeball_radius",
    "fit_rigid",
    "gums",
    "jaw_opening",
    "teeth",
    "tongue",
]

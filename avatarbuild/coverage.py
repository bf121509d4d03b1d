"""The capture doctor's picture: from where the photos see the face, how sharply, and where views are lacking."""

from __future__ import annotations

import cv2
import numpy as np

from avatarbuild.formats.images import encode_png
from avatarbuild.survey import Survey

_WIDTH, _HEIGHT = 1200, 720
_LEFT, _TOP, _RIGHT, _BOTTOM = 70, 60, 1180, 640  # the plot's frame
_YAW, _PITCH = 95.0, 45.0  # degrees at its edges
_FONT = cv2.FONT_HERSHEY_SIMPLEX

_INK, _PALE, _PAPER = (60, 60, 60), (225, 225, 225), (255, 255, 255)
_SHARP, _SOFT, _BLURRED, _LACK = (40, 140, 60), (230, 160, 30), (210, 50, 40), (250, 222, 218)


def draw(photos: Survey | None, max_yaw: float) -> bytes:
    """
    A PNG: a dot for each photo in which a face was found, at the direction that it is seen from (as one stands before
    the subject: their right side on the left), green, orange or red by blur; hollow where landmarks are not trusted.
    Columns of 15 degrees without a trusted photo are tinted.
    """
    canvas = np.full((_HEIGHT, _WIDTH, 3), _PAPER, np.uint8)
    pose = np.zeros((0, 3)) if photos is None else photos.views.pose
    blur = np.zeros(0) if photos is None else photos.blur
    found = np.isfinite(pose[:, 0]) if len(pose) else np.zeros(0, bool)
    trusted = np.zeros(0, bool) if photos is None else photos.views.trusted(0.9, max_yaw)
    for low in np.arange(-60.0, 60.0, 15.0):
        if not (trusted & (pose[:, 0] >= low) & (pose[:, 0] < low + 15)).any():
            cv2.rectangle(canvas, (_x(low + 15), _TOP), (_x(low), _BOTTOM), _LACK, -1)
    for yaw in range(-90, 91, 15):
        cv2.line(canvas, (_x(yaw), _TOP), (_x(yaw), _BOTTOM), _PALE, 1, cv2.LINE_AA)
        _write(canvas, f"{abs(yaw)}", (_x(yaw), _BOTTOM + 22), 0.45)
    for pitch in range(-45, 46, 15):
        cv2.line(canvas, (_LEFT, _y(pitch)), (_RIGHT, _y(pitch)), _PALE, 1, cv2.LINE_AA)
        _write(canvas, f"{abs(pitch)}", (_LEFT - 22, _y(pitch) + 5), 0.45)
    cv2.rectangle(canvas, (_LEFT, _TOP), (_RIGHT, _BOTTOM), _INK, 1)
    _write(canvas, "their right side", (_x(75), _TOP + 22), 0.5)
    _write(canvas, "their left side", (_x(-75), _TOP + 22), 0.5)
    _write(canvas, "from above", (_x(0), _TOP + 22), 0.5)
    _write(canvas, "from below", (_x(0), _BOTTOM - 12), 0.5)
    usual = float(np.median(blur[trusted])) if trusted.any() else 1.0
    for i in np.flatnonzero(found):
        colour = _SHARP if blur[i] <= 1.25 * usual else _SOFT if blur[i] <= 1.6 * usual else _BLURRED
        at = (_x(pose[i, 0]), _y(pose[i, 1]))
        cv2.circle(canvas, at, 8, colour, -1 if trusted[i] else 2, cv2.LINE_AA)
    total = len(found)
    title = f"{total} photos, a face in {int(found.sum())}, landmarks trusted in {int(trusted.sum())}"
    _write(canvas, title, (_WIDTH // 2, 36), 0.7)
    keys = [("sharp", _SHARP, -1), ("softer", _SOFT, -1), ("blurred", _BLURRED, -1), ("not trusted", _INK, 2)]
    for j, (word, colour, fill) in enumerate(keys):
        cv2.circle(canvas, (150 + 190 * j, 694), 8, colour, fill, cv2.LINE_AA)
        cv2.putText(canvas, word, (166 + 190 * j, 700), _FONT, 0.5, _INK, 1, cv2.LINE_AA)
    cv2.rectangle(canvas, (908, 684), (930, 704), _LACK, -1)
    cv2.putText(canvas, "no photo from here", (938, 700), _FONT, 0.5, _INK, 1, cv2.LINE_AA)
    return encode_png(canvas)


def _x(yaw: float) -> int:
    """The subject who looks to their left (positive) is seen from their right, which is on a viewer's left."""
    return round(_LEFT + (_YAW - float(np.clip(yaw, -_YAW, _YAW))) / (2 * _YAW) * (_RIGHT - _LEFT))


def _y(pitch: float) -> int:
    """A subject who looks down (negative) is seen from above."""
    return round(_TOP + (_PITCH + float(np.clip(pitch, -_PITCH, _PITCH))) / (2 * _PITCH) * (_BOTTOM - _TOP))


def _write(canvas: np.ndarray, text: str, centre: tuple[int, int], size: float) -> None:
    (width, _), _ = cv2.getTextSize(text, _FONT, size, 1)
    cv2.putText(canvas, text, (centre[0] - width // 2, centre[1]), _FONT, size, _INK, 1, cv2.LINE_AA)

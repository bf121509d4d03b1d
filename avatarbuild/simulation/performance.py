"""The expression video: every family of shapes in turn, asymmetric and combined, with blinks, gaze and head motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatarbuild.geometry.rotations import rotation
from avatarbuild.simulation.photographs import look_at
from avatarbuild.simulation.rendering import Camera
from avatarbuild.template import ARKIT_NAMES, PIVOT

# Each event: shapes and their weights at its height; tails L and R stand for Left and Right.
_EVENTS: tuple[dict[str, float], ...] = (
    {"browInnerUp": 0.9, "browOuterUpLeft": 0.8, "browOuterUpRight": 0.8, "eyeWideLeft": 0.5, "eyeWideRight": 0.5},
    {"browDownLeft": 0.9, "browDownRight": 0.9, "eyeSquintLeft": 0.3, "eyeSquintRight": 0.3},
    {"browOuterUpLeft": 0.8},
    {"eyeLookOutLeft": 0.7, "eyeLookInRight": 0.7},
    {"eyeLookInLeft": 0.7, "eyeLookOutRight": 0.7},
    {"eyeLookUpLeft": 0.6, "eyeLookUpRight": 0.6},
    {"eyeLookDownLeft": 0.6, "eyeLookDownRight": 0.6},
    {"eyeSquintLeft": 0.9, "eyeSquintRight": 0.9, "cheekSquintLeft": 0.7, "cheekSquintRight": 0.7},
    {"mouthSmileLeft": 0.9, "mouthSmileRight": 0.9, "cheekSquintLeft": 0.5, "cheekSquintRight": 0.5},
    {"mouthSmileLeft": 0.8, "mouthDimpleLeft": 0.3},
    {"mouthSmileRight": 0.8, "mouthDimpleRight": 0.4, "browDownRight": 0.3},
    {"jawOpen": 0.8},
    {"jawOpen": 0.5, "mouthSmileLeft": 0.8, "mouthSmileRight": 0.8},
    {"mouthFrownLeft": 0.8, "mouthFrownRight": 0.8, "mouthShrugLower": 0.5},
    {"mouthPucker": 0.9},
    {"mouthFunnel": 0.8, "jawOpen": 0.3},
    {"mouthLeft": 0.7},
    {"mouthRight": 0.7},
    {"jawLeft": 0.6, "jawOpen": 0.15},
    {"jawRight": 0.6, "jawOpen": 0.15},
    {"noseSneerLeft": 0.9, "noseSneerRight": 0.9, "mouthUpperUpLeft": 0.4, "mouthUpperUpRight": 0.4},
    {"cheekPuff": 0.8, "mouthPressLeft": 0.3, "mouthPressRight": 0.3},
    {"mouthStretchLeft": 0.7, "mouthStretchRight": 0.7, "mouthLowerDownLeft": 0.5, "mouthLowerDownRight": 0.5},
    {"mouthPressLeft": 0.8, "mouthPressRight": 0.8, "mouthDimpleLeft": 0.4, "mouthDimpleRight": 0.4},
    {"mouthRollLower": 0.7, "mouthRollUpper": 0.7},
    {"mouthShrugUpper": 0.6, "mouthShrugLower": 0.6},
    {"jawForward": 0.7},
    {"mouthUpperUpLeft": 0.8, "noseSneerLeft": 0.6, "cheekSquintLeft": 0.5},
    {"jawOpen": 0.5, "mouthClose": 0.4},
    {"jawOpen": 0.6, "browInnerUp": 0.8, "eyeWideLeft": 0.7, "eyeWideRight": 0.7, "browOuterUpLeft": 0.4},
    {"eyeBlinkLeft": 1.0, "cheekSquintLeft": 0.4},
    {"eyeBlinkRight": 1.0, "mouthSmileRight": 0.3},
)


@dataclass(frozen=True)
class Performance:
    """weights (f, 52); head_pose (f, 4, 4): world from head, mm; cameras, one a frame; fps."""

    weights: np.ndarray
    head_pose: np.ndarray
    cameras: list[Camera]
    fps: float


NO_PERFORMANCE = Performance(np.zeros((0, len(ARKIT_NAMES))), np.zeros((0, 4, 4)), [], 0.0)


def perform(rng: np.random.Generator, seconds: float, fps: float, size: tuple[int, int]) -> Performance:
    """A clip of `seconds` at `fps`, `size` (w, h); the subject starts at rest."""
    f = max(round(seconds * fps), 1)
    time = np.arange(f) / fps
    weights = np.zeros((f, len(ARKIT_NAMES)))
    index = {name: i for i, name in enumerate(ARKIT_NAMES)}
    order = rng.permutation(len(_EVENTS))
    rest = min(0.35, 0.1 * seconds)
    gap = (seconds - 2 * rest) / len(_EVENTS)
    for place, k in enumerate(order):
        width = max(1.5 * gap, 0.5) * rng.uniform(0.9, 1.2)
        centre = rest + (place + 0.5) * gap
        lift = np.cos(np.pi * np.clip((time - centre) / width, -0.5, 0.5)) ** 2
        lift = np.where(np.abs(time - centre) < width / 2, np.clip(1.25 * lift, 0, 1), 0)
        for name, height in _EVENTS[k].items():
            column = weights[:, index[name]]
            np.maximum(column, height * rng.uniform(0.85, 1.08) * lift, out=column)
    for blink in np.arange(1.1, seconds, 2.7) + rng.uniform(-0.3, 0.3):
        closed = np.exp(-(((time - blink) / 0.075) ** 2))
        for name in ("eyeBlinkLeft", "eyeBlinkRight"):
            column = weights[:, index[name]]
            np.maximum(column, closed, out=column)
    weights = _smooth(weights, fps * 0.035)
    weights[:, index["mouthClose"]] = np.minimum(weights[:, index["mouthClose"]], weights[:, index["jawOpen"]])
    ramp = np.clip(time / 0.5, 0, 1)[:, None]
    turn = np.radians([8.0, 11.0, 4.5]) * _wander(rng, time, 3) * ramp
    shift = np.array([5.0, 4.0, 6.0]) * _wander(rng, time, 3) * ramp
    pose = np.tile(np.eye(4), (f, 1, 1))
    for i in range(f):
        R = rotation(turn[i])
        pose[i, :3, :3] = R
        pose[i, :3, 3] = PIVOT - R @ PIVOT + shift[i]
    return Performance(np.clip(weights, 0, 1), pose, _handheld(rng, time, size), fps)


def _handheld(rng: np.random.Generator, time: np.ndarray, size: tuple[int, int]) -> list[Camera]:
    """A phone held in front of the face at 42 cm, trembling by millimetres."""
    focal = 1.373 * size[0] * rng.uniform(0.985, 1.015)
    K = np.array(
        [[focal, 0, size[0] / 2 + rng.uniform(-3, 3)], [0, focal, size[1] / 2 + rng.uniform(-5, 5)], [0, 0, 1]]
    )
    dist = np.array([0.03, -0.06, 2e-4, 1e-4, 0.02]) * rng.uniform(0.7, 1.2)
    tremble = _wander(rng, time, 3) * [4, 4, 6]
    aim = _wander(rng, time, 3) * [2.5, 2.5, 0]
    start = np.array([rng.uniform(-25, 25), rng.uniform(-25, 15), 415.0])
    cameras = []
    for eye, target in zip(start + tremble, np.array([0.0, -32.0, -10.0]) + aim, strict=True):
        R = look_at(eye, target, 0.0)
        cameras.append(Camera(K, dist, R, -R @ eye, size))
    return cameras


def _wander(rng: np.random.Generator, time: np.ndarray, columns: int) -> np.ndarray:
    """(f, columns) smooth motion within about +-1: sines of 0.1 to 0.7 Hz."""
    out = np.zeros((len(time), columns))
    for c in range(columns):
        for rate, size in ((0.13, 0.55), (0.31, 0.3), (0.67, 0.12)):
            rate *= rng.uniform(0.8, 1.25)
            phase = rng.uniform(0, 2 * np.pi)
            out[:, c] += size * np.sin(2 * np.pi * rate * time + phase)
    return out


def _smooth(values: np.ndarray, frames: float) -> np.ndarray:
    reach = max(int(3 * frames), 1)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(frames, 0.3)) ** 2)
    kernel /= kernel.sum()
    padded = np.pad(values, ((reach, reach), (0, 0)), "edge")
    return np.stack([np.convolve(column, kernel, "valid") for column in padded.T], axis=1)

"""
The written form of a synthesis: details.json and pictures that a fragment shader can use; docs/formats.md.

A picture's first row is v = 1. All of them are 8-bit RGB without alpha, so that a browser hands on their bytes as they
are; positions take two bytes a number, one below the other. Letters: k keyframes, e edges, s texels along a side.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from avatarbuild.details.synthesis import Keyframes, Synthesis, grid
from avatarbuild.errors import InputError
from avatarbuild.formats.images import decode_png, encode_png
from avatarbuild.formats.rounding import rounded
from avatarbuild.template import Template
from avatarbuild.texture.chart import continued

DETAILS_VERSION = 1
JSON_FILE, POSITIONS_FILE = "details.json", "positions.png"
_ZERO, _MOST = 128, 127  # the byte that stands for nil, and the largest step from it
_BORDER = 4.0  # texels that the weights go on beyond the chart, for bilinear reading
_TAIL = 0.99999  # share of the weights that are written without being cut


def details_files(made: Synthesis) -> dict[str, bytes]:
    """File name -> bytes: details.json, positions.png, weights_*.png, and each keyframe's own normals and occlusion."""
    centre = _centres(made)
    pictures, scales = _weights(made, centre)
    low, step, positions = _positions(made.keys.positions)
    files = {POSITIONS_FILE: encode_png(positions)}
    for name, picture in pictures.items():
        files[name] = encode_png(picture)
    for k, strain in enumerate(made.keys.strain):
        map_ = made.evaluate(strain)
        normal = np.clip(np.round(map_[..., :3] * 127.5 + 127.5), 0, 255)
        files[f"key_{k}_normal.png"] = encode_png(normal.astype(np.uint8))
        files[f"key_{k}_occlusion.png"] = encode_png(np.round(map_[..., 3] * 255).astype(np.uint8))
    about = {
        "version": DETAILS_VERSION,
        "template": {"name": made.template.name, "version": made.template.version},
        "side": made.side,
        "layers": ["normal_x", "normal_y", "normal_z", "occlusion"],
        "edges": made.edges.tolist(),
        "rest_mm": rounded(made.rest, 5),
        "strain_low": rounded(made.low, 6),
        "strain_high": rounded(made.high, 6),
        "strain_spread": rounded(made.spread, 6),
        "beta_per_mm": made.beta,
        "keyframes": [
            {
                "frame": int(made.keys.rows[k]),
                "strain": rounded(made.keys.strain[k], 6),
                "centre": centre[k],
                "ends_mm": rounded(made.keys.ends[k].reshape(-1, 6), 4),
                "normal": f"key_{k}_normal.png",
                "occlusion": f"key_{k}_occlusion.png",
            }
            for k in range(made.keys.count)
        ],
        "positions": {
            "file": POSITIONS_FILE,
            "side": made.keys.positions.shape[1],
            "low_mm": low.tolist(),
            "step_mm": step.tolist(),
        },
        "weights": [
            {"file": name, "scale": scale, "holds": holds}
            for (name, scale), holds in zip(scales.items(), _holds(made.keys.count), strict=True)
        ],
    }
    files[JSON_FILE] = (json.dumps(about, ensure_ascii=False, allow_nan=False) + "\n").encode()
    return files


def details_in(folder: Path) -> dict[str, bytes]:
    """File name -> bytes of the details that lie in a folder, as `read_details` takes them; empty where none do."""
    if not (folder / JSON_FILE).is_file():
        return {}
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


def read_details(files: Mapping[str, bytes], template: Template) -> Synthesis:
    """
    The synthesis that files hold, as exact as they are.

    Raises InputError where a file is missing or damaged, of a later version, or made for another template.
    """
    try:
        about = json.loads(files[JSON_FILE])
        if about["version"] != DETAILS_VERSION:
            raise InputError(
                f"{JSON_FILE} has version {about['version']}, {DETAILS_VERSION} is needed: make the avatar's details "
                "again with this program"
            )
        if about["template"] != {"name": template.name, "version": template.version}:
            named = f"'{about['template']['name']}' {about['template']['version']}"
            raise InputError(
                f"{JSON_FILE} was made for the template {named}, not '{template.name}' {template.version}: details "
                "move between avatars of one template only"
            )
        return _read(about, files, template)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise InputError(
            f"{JSON_FILE} or a picture beside it is missing or damaged ({error}): make the details again"
        ) from error


def _read(about: dict[str, Any], files: Mapping[str, bytes], template: Template) -> Synthesis:
    keyframes, side = about["keyframes"], int(about["side"])
    centre = np.array([key["centre"] for key in keyframes])
    positions = decode_png(files[about["positions"]["file"]]).astype(np.float32)
    p = int(about["positions"]["side"])
    values = (256 * positions[:p] + positions[p:]).reshape(p, len(keyframes), p, 3).transpose(1, 0, 2, 3)
    low, step = (np.array(about["positions"][key], np.float32)[:, None, None] for key in ("low_mm", "step_mm"))
    keys = Keyframes(
        np.array([key["frame"] for key in keyframes], np.int64),
        np.array([key["strain"] for key in keyframes]),
        np.array([key["ends_mm"] for key in keyframes]).reshape(len(keyframes), -1, 2, 3),
        low + step * values,
    )
    skin = grid(template, side)
    slices = [decode_png(files[row["file"]]).reshape(-1, 3)[skin.flat] for row in about["weights"]]
    used = np.zeros(len(skin.flat), bool)
    terms = len(keyframes) + 1
    weights = np.zeros((len(skin.flat), terms, 4), np.float32)
    for j, (picture, row) in enumerate(zip(slices, about["weights"], strict=True)):
        scale = np.array(row["scale"], np.float32)
        used |= (picture != _flat_bytes(j, terms, scale)).any(axis=1)
        value = scale * (picture.astype(np.float32) - _ZERO)
        if j < terms:
            weights[:, j, :3] = value
        else:
            some = min(3, terms - 3 * (j - terms))
            weights[:, 3 * (j - terms) : 3 * (j - terms) + some, 3] = value[:, :some]
    weights = weights[used]
    weights[:, 0] -= np.einsum("k,tkl->tl", centre, weights[:, 1:]).astype(np.float32)
    return Synthesis(
        template,
        side,
        edges=np.array(about["edges"], np.int64),
        rest=np.array(about["rest_mm"]),
        low=np.array(about["strain_low"]),
        high=np.array(about["strain_high"]),
        spread=np.array(about["strain_spread"]),
        beta=float(about["beta_per_mm"]),
        keys=keys,
        texels=skin.flat[used],
        weights=weights,
    )


def _centres(made: Synthesis) -> list[float]:
    """
    (k,) m_k, about which phi_k is written: l = (l_0 + sum eta_k m_k) + sum eta_k (phi_k - m_k). The terms are smaller,
    and so is what their bytes lose. The mean over the keyframes' strains.
    """
    corners = np.unique(made.grid.corners)
    if not made.keys.count or not len(corners):
        return [0.0] * made.keys.count
    mean = np.mean([made.distances(strain)[corners].mean(axis=0) for strain in made.keys.strain], axis=0)
    return [round(float(m), 6) for m in mean]


def _weights(made: Synthesis, centre: list[float]) -> tuple[dict[str, np.ndarray], dict[str, list[float]]]:
    """The pictures, and the scale of each one's channels: weight = scale (byte - 128)."""
    weights = made.weights.astype(np.float64)
    weights[:, 0] += np.einsum("k,tkl->tl", centre, weights[:, 1:])
    terms = weights.shape[1]
    slices = [weights[:, j, :3] for j in range(terms)]
    for first in range(0, terms, 3):
        some = weights[:, first : first + 3, 3]
        slices.append(np.pad(some, ((0, 0), (0, 3 - some.shape[1]))))
    inside = np.zeros((made.side, made.side), bool)
    inside.reshape(-1)[grid(made.template, made.side).flat] = True
    pictures, scales = {}, {}
    for j, values in enumerate(slices):
        most = np.quantile(np.abs(values), _TAIL, axis=0) if len(values) else np.zeros(3)
        rest = _flat_values(j, terms)
        scale = np.maximum(np.maximum(most, rest), 1e-6) / _MOST
        scale = np.array([float(f"{x:.8g}") for x in scale])
        picture = np.tile(_flat_bytes(j, terms, scale), (made.side * made.side, 1))
        steps = np.round(values / scale)
        picture[made.texels] = np.clip(steps, -_MOST, _MOST).astype(np.int64) + _ZERO
        name = f"weights_{j:02d}.png"
        pictures[name] = continued(picture.reshape(made.side, made.side, 3), inside, _BORDER)
        scales[name] = scale.tolist()
    return pictures, scales


def _flat_values(slice_: int, terms: int) -> np.ndarray:
    """(3,) what a picture holds where the skin has no details: z = 1 of l_0, occlusion 1 of l_0."""
    if slice_ == 0:
        return np.array([0.0, 0.0, 1.0])
    return np.array([1.0, 0.0, 0.0]) if slice_ == terms else np.zeros(3)


def _flat_bytes(slice_: int, terms: int, scale: np.ndarray) -> np.ndarray:
    return (np.round(_flat_values(slice_, terms) / scale) + _ZERO).astype(np.uint8)


def _holds(keyframes: int) -> list[list[str]]:
    """Of every picture, what its channels are the weights of."""
    names = ["constant", *(f"keyframe {k}" for k in range(keyframes))]
    rows = [[f"{axis} of {name}" for axis in ("normal_x", "normal_y", "normal_z")] for name in names]
    for first in range(0, len(names), 3):
        rows.append([f"occlusion of {name}" for name in names[first : first + 3]])
    return rows


def _positions(maps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """low (k, 3), step (k, 3) mm, and the picture (2 p, k p, 3): high bytes above, low bytes below."""
    k, p = maps.shape[:2]
    low, high = maps.min(axis=(1, 2), initial=1e9), maps.max(axis=(1, 2), initial=-1e9)
    low = np.round(low.astype(np.float64), 4)
    step = np.round((high - low) / 65535 + 1e-7, 9)
    counts = np.clip(np.round((maps - low[:, None, None]) / step[:, None, None]), 0, 65535).astype(np.int64)
    flat = counts.transpose(1, 0, 2, 3).reshape(p, k * p, 3)
    return low, step, np.concatenate([flat // 256, flat % 256]).astype(np.uint8)

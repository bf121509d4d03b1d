"""Identity: a few thousand random heads over the source's modifiers, aligned on the face, and their principal modes.

Sampling, one head (sd in units of a full modifier; "wide", which fits scanned heads best; PEOPLE then makes a standard
deviation of it one of people):
  gender Beta(0.5, 0.5); age: old Beta(1.1, 2.2) x 0.85, in a tenth of the heads child U(0, 0.5) instead;
  ethnicity Dirichlet(0.6, 0.6, 0.6); muscle and weight N(0.5, 0.2) in [0, 1];
  each face modifier N(0, 0.35), each of skull, ears and neck N(0, 0.20), in [-1, 1], left and right apart by
  N(0, 0.06); one-sided head shapes |N| x 0.8; each of the source's asymmetries N(0, 0.15).
Heads are aligned by similarities on the face. Mirroring every head too makes the mean symmetric and each mode either
symmetric or antisymmetric, so that both kinds are found apart, at half the size. Source of the mean: method section on
linear models; the modes are weighted principal components: argmin sum_i |W (y_i - mean - B c_i)|^2.
"""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from scipy.linalg import eigh
from source import Source

from avatarbuild.template import Template

HEADS = 2400
SEED = 11
FACE_SD, SKULL_SD = 0.35, 0.20
COMPONENTS = 100
ROUNDS = 3
PEOPLE = 0.8
"""
A standard deviation of people in one of the sampled heads, by the proportions of faces that anthropometry reports, in
percent of their means (sources in benchmarks/template.py, which prints all this by `indices`):

  proportion                     sampled heads   times 0.8   people
  face, height to width               9.2           7.3      6.3; 7.5 to 7.8; 9.2 to 9.4
  nose, width to height              13.4          10.7      9.2 to 10.8; 10.2 to 10.6
  pupils' distance to the width       6.0           4.8      5.4
  pupils' distance to the height      9.6           7.7      7.3

The four ask for 0.85, 0.76, 0.90 and 0.76; the survey of 6068 people alone for 0.68, 0.90 and 0.76.
"""
FLIP = np.array([-1.0, 1.0, 1.0])
_OPPOSITES = {
    "decr": "incr",
    "down": "up",
    "in": "out",
    "backward": "forward",
    "concave": "convex",
    "compress": "uncompress",
}
_PEOPLES = ("african", "asian", "caucasian")


def sample_heads(source: Source, matrix: sp.csr_matrix, count: int = HEADS) -> np.ndarray:
    """(count, c, 3) mm random heads on the cage; `matrix` (c, v) takes base vertices to the cage."""
    names = sorted(source.targets)
    index = {name: i for i, name in enumerate(names)}
    table = np.stack([(matrix @ source.targets[name]).ravel() for name in names])
    rng = np.random.default_rng(SEED)
    groups, sided = _modifier_groups(names)
    amounts = np.zeros((count, len(names)))
    for row in amounts:
        _draw_person(rng, row, index)
        _draw_modifiers(rng, row, index, groups)
        for pair in sided:
            x = rng.normal(0, 0.15)
            row[index[pair[0] if x > 0 else pair[1]]] += abs(x)
    heads = amounts @ table + (matrix @ source.base).ravel()
    return heads.reshape(count, -1, 3)


def _draw_person(rng: np.random.Generator, row: np.ndarray, index: dict[str, int]) -> None:
    male = rng.beta(0.5, 0.5)
    old = rng.beta(1.1, 2.2) * 0.85
    child = rng.uniform(0, 0.5) if rng.random() < 0.1 else 0.0
    old = 0.0 if child else old
    peoples = rng.dirichlet([0.6] * 3)
    muscle, weight = np.clip(rng.normal(0.5, 0.2, 2), 0, 1)
    for gender, g in (("male", male), ("female", 1 - male)):
        for age, a in (("young", 1 - old - child), ("old", old), ("child", child)):
            for people, share in zip(_PEOPLES, peoples, strict=True):
                row[index[f"macrodetails/{people}-{gender}-{age}"]] += g * a * share
            for m, mw in _levels(muscle):
                for w, ww in _levels(weight):
                    row[index[f"macrodetails/universal-{gender}-{age}-{m}muscle-{w}weight"]] += g * a * mw * ww


def _levels(x: float) -> list[tuple[str, float]]:
    return [("min", max(0.0, 1 - 2 * x)), ("average", 1 - abs(2 * x - 1)), ("max", max(0.0, 2 * x - 1))]


def _modifier_groups(names: list[str]) -> tuple[dict[str, list[tuple[str | None, str]]], list[tuple[str, str]]]:
    """group -> its (negative, positive) target pairs, left and right in one group; and the asymmetry pairs."""
    groups: dict[str, list[tuple[str | None, str]]] = defaultdict(list)
    positive = set(_OPPOSITES.values())
    for name in names:
        folder, stem = name.split("/")
        if folder in ("macrodetails", "asym"):
            continue
        root, _, word = stem.rpartition("-")
        group = f"{folder}/{re.sub('^[lr]-', '', root)}"
        if word in _OPPOSITES:
            groups[group].append((name, f"{folder}/{root}-{_OPPOSITES[word]}"))
        elif word not in positive:
            groups[name.replace("/l-", "/").replace("/r-", "/")].append((None, name))
    sided = [(n, n[:-2] + "-r") for n in names if n.startswith("asym/asym-") and n.endswith("-l")]
    return dict(sorted(groups.items())), sided


def _draw_modifiers(
    rng: np.random.Generator,
    row: np.ndarray,
    index: dict[str, int],
    groups: dict[str, list[tuple[str | None, str]]],
) -> None:
    for group, pairs in groups.items():
        skull = group.startswith(("neck/", "ears/", "head/head-back", "head/head-scale", "forehead/forehead-scale"))
        sd = SKULL_SD if skull else FACE_SD
        one_sided = pairs[0][0] is None
        x = max(0.0, rng.normal(0, 0.8 * sd)) if one_sided else float(np.clip(rng.normal(0, sd), -1, 1))
        for negative, positive in pairs:
            y = x + (rng.normal(0, 0.06) if len(pairs) > 1 else 0.0)
            if y >= 0:
                row[index[positive]] += y
            elif negative is not None:
                row[index[negative]] -= y


def align(heads: np.ndarray, weights: np.ndarray, mirror: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Heads (k, c, 3) under the similarities that bring each closest to their symmetric mean, vertices weighted (c,).

    `start` (c, 3) is the first target. An asymmetric target would add a sideways shift to every head.
    """
    w = weights / weights.sum()
    aligned, mean = heads, start
    for _ in range(ROUNDS):
        mean = (mean + mean[mirror] * FLIP) / 2
        target = mean - w @ mean
        centred = heads - np.einsum("c,kcx->kx", w, heads)[:, None]
        u, s, vt = np.linalg.svd(np.einsum("c,kcx,cy->kxy", w, centred, target))
        sign = np.ones_like(s)
        sign[:, 2] = np.sign(np.linalg.det(u @ vt))
        scale = (s * sign).sum(axis=1) / np.einsum("c,kcx,kcx->k", w, centred, centred)
        aligned = scale[:, None, None] * (centred @ ((u * sign[:, None]) @ vt)) + w @ mean
        mean = aligned.mean(axis=0)
    return aligned


def modes(heads: np.ndarray, weights: np.ndarray, mirror: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(mean (c, 3), components (count, c, 3) mm per standard deviation), of the heads and their mirror images."""
    mean = heads.mean(axis=0)
    mean = (mean + mean[mirror] * FLIP) / 2
    deviation = heads - mean
    reflected = deviation[:, mirror] * FLIP
    w = np.sqrt(weights)[:, None]
    k = len(heads)
    found = []
    for parity in (1.0, -1.0):
        flat = ((deviation + parity * reflected) / 2 * w).reshape(k, -1)
        values, vectors = eigh(flat @ flat.T, subset_by_index=[k - count, k - 1])
        for value, vector in zip(values, vectors.T, strict=True):
            shape = (vector @ flat).reshape(-1, 3) / w / np.sqrt(k)
            big = np.argmax(np.abs(shape).max(axis=1) * weights)
            found.append((value, shape * np.sign(shape[big, np.argmax(np.abs(shape[big]))])))
    found.sort(key=lambda item: -item[0])
    return mean, np.stack([shape for _, shape in found[:count]])


def as_people_vary(template: Template) -> Template:
    """
    The same linear head with coefficient 1 a standard deviation of people: every component times PEOPLE.

    Last of all, since the heads that lids, lips, landmarks and the mouth were made fit for are the wider ones.
    """
    assert template.cage_identity is not None
    return replace(
        template,
        identity=PEOPLE * template.identity,
        sigma=PEOPLE * template.sigma,
        eye_centre_basis=PEOPLE * template.eye_centre_basis,
        cage_identity=PEOPLE * template.cage_identity,
    )

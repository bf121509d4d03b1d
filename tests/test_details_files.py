"""The written details: there and back, faults, the schema, and the shader against Python in a browser."""

from __future__ import annotations

import json
from pathlib import Path

import chromium
import cv2
import jsonschema
import numpy as np
import pytest

from avatarbuild.details.synthesis import Synthesis, train
from avatarbuild.errors import InputError
from avatarbuild.formats.details import details_files, read_details
from avatarbuild.formats.images import decode_png
from avatarbuild.template import Template

ROOT = Path(__file__).resolve().parents[1]
SIDE, FRAMES = 256, 10


@pytest.fixture(scope="module")
def template() -> Template:
    return Template.load()


@pytest.fixture(scope="module")
def made(template) -> Synthesis:
    """Smooth random maps of ten random expressions, steeper than wrinkles are."""
    rng = np.random.default_rng(5)
    weights = rng.uniform(0, 1, (FRAMES, 52)) * (rng.uniform(size=(FRAMES, 52)) < 0.15)
    heads = np.stack([template.pose(template.mean, template.allowed(w)) for w in weights])
    maps = []
    for _ in range(FRAMES):
        slopes = cv2.resize(0.3 * rng.standard_normal((SIDE // 8, SIDE // 8, 2)), (SIDE, SIDE))
        normal = np.concatenate([slopes, np.ones((SIDE, SIDE, 1))], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        shade = cv2.resize(rng.uniform(0.5, 1, (SIDE // 8, SIDE // 8)), (SIDE, SIDE))[..., None]
        maps.append(np.concatenate([normal, shade], axis=-1).astype(np.float32))
    rows, columns = np.mgrid[:SIDE, :SIDE]
    sure = (np.hypot(rows - SIDE / 2, columns - SIDE / 2) < 0.3 * SIDE).astype(np.float32)
    return train(maps, [sure] * FRAMES, heads, template.mean, template)


@pytest.fixture(scope="module")
def files(made) -> dict[str, bytes]:
    return details_files(made)


def _strains(made: Synthesis) -> np.ndarray:
    rng = np.random.default_rng(8)
    return np.stack([rng.uniform(made.low, made.high), made.keys.strain[1], np.zeros(len(made.edges)), made.high + 1])


def test_there_and_back(made, files, template):
    back = read_details(files, template)
    assert back.side == made.side
    assert np.array_equal(back.edges, made.edges)
    assert np.allclose(back.keys.positions, made.keys.positions, atol=0.004)
    for strain in _strains(made):
        apart = np.abs(back.evaluate(strain) - made.evaluate(strain)) * [0.5, 0.5, 0.5, 1]
        assert 0 < apart.mean() < 0.4 / 255
        assert np.quantile(apart, 0.99) < 3 / 255
        assert apart.max() < 10 / 255


def test_the_same_bytes_every_time(made, files):
    assert details_files(made) == files


def test_details_json_fits_its_schema(files):
    schema = json.loads((ROOT / "docs" / "schemas" / "details.schema.json").read_text())
    about = json.loads(files["details.json"])
    jsonschema.validate(about, schema)
    named = {about["positions"]["file"], *(row["file"] for row in about["weights"])}
    named |= {key[part] for key in about["keyframes"] for part in ("normal", "occlusion")}
    assert named == set(files) - {"details.json"}


def test_pictures_of_the_keyframes(made, files):
    map_ = made.evaluate(made.keys.strain[0])
    normal = decode_png(files["key_0_normal.png"]) / 127.5 - 1
    assert np.abs(normal - map_[..., :3]).max() < 0.01
    assert np.abs(decode_png(files["key_0_occlusion.png"]) / 255 - map_[..., 3]).max() < 0.003


def test_a_later_version_another_template_and_damage_are_refused(files, template):
    about = json.loads(files["details.json"])
    for change in ({"version": 2}, {"template": {"name": "other", "version": "1"}}):
        with pytest.raises(InputError, match=r"version 2|template 'other'"):
            read_details({**files, "details.json": json.dumps(about | change).encode()}, template)
    with pytest.raises(InputError, match="missing or damaged"):
        read_details({name: data for name, data in files.items() if name != "weights_03.png"}, template)
    with pytest.raises(InputError, match="missing or damaged"):
        read_details({**files, "details.json": b"{"}, template)


def test_reads_of_a_fragment_stay_within_the_budget(files):
    about = json.loads(files["details.json"])
    assert 8 * len(about["keyframes"]) + len(about["weights"]) <= 64
    assert 2 * 16 * len(about["keyframes"]) * len(about["edges"]) <= 16384  # bytes of a uniform block


@pytest.mark.parametrize("kind, share", [("NEAREST", 1.0), ("LINEAR", 0.99)])
def test_the_shader_agrees_with_python(made, files, template, kind, share):
    """Within 1/255 everywhere; 99 % of it where a software filter of a few bits mixes neighbours at texel centres."""
    back = read_details(files, template)
    strain = _strains(made)[0]
    skin = template.parts["skin"].triangles
    uv = np.round(template.uv * [1, -1] + [0, 1], 7)
    triangles = template.uv_triangles[skin]
    scene = {"strain": strain.tolist(), "uv": uv.tolist(), "triangles": triangles.tolist(), "filter": kind}
    page = {
        "index.html": (ROOT / "tests" / "synthesis_page.html").read_bytes(),
        "synthesis.glsl": (ROOT / "avatarbuild" / "details" / "synthesis.glsl").read_bytes(),
        "scene.json": json.dumps(scene).encode(),
    }
    drawn = np.frombuffer(chromium.answer(page | files), np.float32).reshape(SIDE, SIDE, 4)
    mine = back.evaluate(strain)
    both = drawn[..., 3] >= 0
    used = np.zeros(SIDE * SIDE, bool)
    used[back.texels] = True
    assert (both | ~used.reshape(SIDE, SIDE)).mean() > 0.999
    apart = np.abs(drawn - mine)[both & used.reshape(SIDE, SIDE)] * [0.5, 0.5, 0.5, 1]
    assert 0 < np.quantile(apart, share) < 1 / 255

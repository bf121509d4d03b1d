"""Verbs animate and transfer-details: tables of weights, bent normals, small clips, details on another avatar."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from avatarbuild.animation import picture
from avatarbuild.animation.clip import animate, own_details
from avatarbuild.animation.skin_light import bent, shading
from avatarbuild.artefacts import Albedo, Avatar, Blendshapes
from avatarbuild.details.edges import lengths
from avatarbuild.details.synthesis import train
from avatarbuild.details.transfer import transfer_details
from avatarbuild.energies import harmonics
from avatarbuild.errors import InputError
from avatarbuild.formats.details import details_files
from avatarbuild.formats.video import decode_frames
from avatarbuild.formats.weights import head_rotations, read_weights
from avatarbuild.geometry.head_pose import head_angles
from avatarbuild.progress import Silent
from avatarbuild.project import Project
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.template_files import resolve

ROOT = Path(__file__).resolve().parents[1]
SIDE = 128
SMALL = (96, 120)


@pytest.fixture(scope="module")
def template() -> Template:
    return Template.load()


def _table(place: Path, header: list[str], rows: list[list[float]]) -> Path:
    with place.open("w", newline="") as f:
        csv.writer(f).writerows([header, *rows])
    return place


def _stamp(stage: str) -> dict:
    return {"stage": stage, "key": "k", "figures": {}, "warnings": [], "timing": {"seconds": 1}}


@pytest.fixture(scope="module")
def details(template) -> dict[str, bytes]:
    rng = np.random.default_rng(2)
    weights = rng.uniform(0, 1, (8, 52)) * (rng.uniform(size=(8, 52)) < 0.2)
    heads = np.stack([template.pose(template.mean, template.allowed(w)) for w in weights])
    slope = 0.8 * np.sin(np.arange(SIDE) * 1.3)
    maps = []
    for w in weights:
        normal = np.zeros((SIDE, SIDE, 3))
        normal[..., 1], normal[..., 2] = (w.sum() / 8 * slope)[:, None], 1
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        maps.append(np.concatenate([normal, np.full((SIDE, SIDE, 1), 0.8)], axis=-1).astype(np.float32))
    return details_files(train(maps, [np.ones((SIDE, SIDE))] * 8, heads, template.mean, template, count=3))


def _project(root: Path, template: Template, size: float, details: dict[str, bytes]) -> Project:
    project = Project(root)
    with project.lock():
        project.write_settings(root / "none", resolve("head"), "draft", {})
        rig = Blendshapes(size * template.mean, size * template.expressions, size * template.eye_centres)
        project.save("blendshapes", rig, _stamp("blendshapes"))
        plain = np.full((SIDE, SIDE, 3), 170, np.uint8)
        flat = np.tile(np.array([128, 128, 255], np.uint8), (SIDE, SIDE, 1))
        open_ = np.full((SIDE, SIDE), 255, np.uint8)
        y = np.zeros((9, 3))
        y[0], y[2], y[3] = 0.5, 0.3, 0.2
        albedo = Albedo(plain, plain, plain, open_, flat, open_, y, np.array([0.5, 0.35, 0.3]), np.ones((1, 3)))
        project.save("albedo", albedo, _stamp("albedo"))
        files = {"avatar.glb": b"glb", "albedo.png": b"png", **{f"details/{k}": v for k, v in details.items()}}
        about = {"files": {k: {"bytes": len(v), "sha256": hashlib.sha256(v).hexdigest()} for k, v in files.items()}}
        files["avatar.json"] = json.dumps(about).encode()
        project.save("avatar", Avatar(files), _stamp("avatar"))
    return project


def test_tables_are_read_by_name(tmp_path):
    header = ["Timecode", "mouthSmileLeft", "JAWOPEN", "HeadYaw", "HeadPitch", "HeadRoll"]
    place = _table(tmp_path / "w.csv", header, [["0", 0.25, 1.5, 0.1, 0.2, -0.3], ["1", 0, -0.5, 0, 0, 0]])
    table = read_weights(place)
    expected = np.zeros((2, 52))
    expected[0, ARKIT_NAMES.index("mouthSmileLeft")], expected[0, ARKIT_NAMES.index("jawOpen")] = 0.25, 1
    assert np.array_equal(table.weights, expected)
    assert table.head is not None
    camera = np.diag([1.0, -1, -1]) @ table.head[0]
    assert np.allclose(head_angles(camera), np.degrees([0.1, 0.2, -0.3]))
    assert np.allclose(table.head[1], np.eye(3))
    assert read_weights(_table(tmp_path / "v.csv", ["jawOpen"], [[0.5]])).head is None


def test_angles_there_and_back():
    rng = np.random.default_rng(0)
    yaw, pitch, roll = rng.uniform(-0.8, 0.8, (3, 20))
    back = [head_angles(np.diag([1.0, -1, -1]) @ R) for R in head_rotations(yaw, pitch, roll)]
    assert np.allclose(np.radians(back), np.column_stack([yaw, pitch, roll]))


@pytest.mark.parametrize(
    "text, said",
    [("", "no column"), ("a,b\n1,2\n", "no column"), ("jawOpen\n", "no frame"), ("jawOpen\n0.5\nx\n", "frame 2")],
)
def test_bad_tables_are_named(tmp_path, text, said):
    (tmp_path / "w.csv").write_text(text)
    with pytest.raises(InputError, match=said):
        read_weights(tmp_path / "w.csv")
    with pytest.raises(InputError, match="cannot be opened"):
        read_weights(tmp_path / "none.csv")


def test_relief_bends_normals_away_from_its_rise():
    smooth = np.tile(np.array([0, 0, 2], np.float32), (2, 2, 1))
    tangents = np.tile(np.array([1, 0, 0, 1], np.float32), (2, 2, 1))
    slopes = np.tile(np.array([0.5, -0.25], np.float32), (2, 2, 1))
    assert np.allclose(bent(smooth, tangents, slopes)[0, 0], np.array([-0.5, 0.25, 1]) / np.sqrt(1.3125), atol=1e-6)
    # a mirrored chart: v grows the other way across
    tangents[..., 3] = -1
    assert np.allclose(bent(smooth, tangents, slopes)[0, 0], np.array([-0.5, -0.25, 1]) / np.sqrt(1.3125), atol=1e-6)


def test_shading_is_equation_1():
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(4, 5, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    y = 0.1 * rng.normal(size=(9, 3)) + np.eye(9, 3)[:, :1]
    assert np.allclose(shading(normals.astype(np.float32), y), harmonics.shading(normals, y).clip(0.02), atol=1e-5)
    front = picture.exposed(y)
    assert np.isclose(harmonics.shading(np.array([0.0, 0, 1]), front).mean(), 0.78)


def test_a_clip_with_details_and_without(tmp_path, template, details):
    project = _project(tmp_path / "a.avatar", template, 1.0, details)
    rows = [[0.0] * 52, [0.7 if name in ("browInnerUp", "jawOpen") else 0.0 for name in ARKIT_NAMES]]
    table = _table(tmp_path / "w.csv", list(ARKIT_NAMES), rows)
    clips = {}
    for name, still in (("made", False), ("still", True)):
        out = tmp_path / f"{name}.mp4"
        assert animate(project, table, out, Silent(), size=SMALL, still=still) == 2
        clips[name] = [rgb.astype(int) for _, _, rgb in decode_frames(out)]
        assert [x.shape for x in clips[name]] == [(SMALL[1], SMALL[0], 3)] * 2
    assert np.abs(clips["made"][1] - clips["still"][1]).mean() > 0.3
    assert np.abs(clips["still"][0] - clips["still"][1]).max() > 20
    assert not [path for path in tmp_path.iterdir() if "partial" in path.name]


def test_lights_and_outputs_that_cannot_be_are_said(tmp_path, template):
    project = _project(tmp_path / "a.avatar", template, 1.0, {})
    table = _table(tmp_path / "w.csv", ["jawOpen"], [[0.5]])
    assert animate(project, table, tmp_path / "lamp.mp4", Silent(), size=SMALL, light="lamp") == 1
    (tmp_path / "y.json").write_text(json.dumps(np.eye(9, 3).tolist()))
    assert animate(project, table, tmp_path / "own.mp4", Silent(), size=SMALL, light=str(tmp_path / "y.json")) == 1
    for more, said in (
        ({"light": "sun"}, "--light sun"),
        ({"size": (95, 120)}, "even sides"),
        ({"fps": 0.0}, "fps"),
    ):
        with pytest.raises(InputError, match=said):
            animate(project, table, tmp_path / "x.mp4", Silent(), **{"size": SMALL, **more})
    for name, said in (("x.avi", "mp4"), ("none/x.mp4", "folder")):
        with pytest.raises(InputError, match=said):
            animate(project, table, tmp_path / name, Silent(), size=SMALL)
    empty = Project(tmp_path / "b.avatar")
    with empty.lock():
        empty.write_settings(tmp_path, resolve("head"), "draft", {})
    with pytest.raises(InputError, match="no albedo"):
        animate(empty, table, tmp_path / "x.mp4", Silent(), size=SMALL)


def test_details_move_between_avatars(tmp_path, template, details):
    source = _project(tmp_path / "a.avatar", template, 1.0, details)
    target = _project(tmp_path / "b.avatar", template, 1.1, {"old.png": b"old"})
    before = Avatar.load(target.folder("avatar")).files
    assert transfer_details(source, target) == len(details)
    after = Avatar.load(target.folder("avatar")).files
    assert {n for n in after if n.startswith("details/")} == {f"details/{n}" for n in details}
    assert all(after[n] == before[n] for n in ("avatar.glb", "albedo.png"))
    assert _facts(target) == _facts(source)
    about = json.loads(after["details/details.json"])
    jsonschema.validate(about, json.loads((ROOT / "docs" / "schemas" / "details.schema.json").read_text()))
    assert about["from"] == "a.avatar"
    listed = json.loads(after["avatar.json"])["files"]
    assert set(listed) == set(after) - {"avatar.json"}
    assert all(listed[n]["sha256"] == hashlib.sha256(after[n]).hexdigest() for n in listed)
    # a head a tenth larger has the same strain
    made, own = own_details(target, template), own_details(source, template)
    assert made is not None
    assert own is not None
    assert np.allclose(made.rest, 1.1 * lengths(template.mean, made.edges), atol=1e-4)
    posed = template.pose(template.mean, np.eye(52)[17])
    assert np.allclose(made.evaluate(made.strain_of(1.1 * posed)), own.evaluate(own.strain_of(posed)), atol=1e-3)


def test_transfers_that_cannot_be_are_said(tmp_path, template, details):
    source = _project(tmp_path / "a.avatar", template, 1.0, details)
    bare = _project(tmp_path / "b.avatar", template, 1.0, {})
    with pytest.raises(InputError, match="same project"):
        transfer_details(source, source)
    with pytest.raises(InputError, match="no details"):
        transfer_details(bare, source)
    unfinished = Project(tmp_path / "c.avatar")
    with unfinished.lock():
        unfinished.write_settings(tmp_path, resolve("head"), "draft", {})
    for pair in ((unfinished, bare), (source, unfinished)):
        with pytest.raises(InputError, match="no finished avatar"):
            transfer_details(*pair)
    about = json.loads(details["details.json"])
    other = details | {"details.json": json.dumps(about | {"template": {"name": "x", "version": "1"}}).encode()}
    strange = _project(tmp_path / "d.avatar", template, 1.0, other)
    before = Avatar.load(bare.folder("avatar")).files
    with pytest.raises(InputError, match="one template only"):
        transfer_details(strange, bare)
    assert Avatar.load(bare.folder("avatar")).files == before


def test_a_clip_of_a_lit_head_is_brighter_above(tmp_path, template):
    """Light from above: the forehead is lighter than the chin; turned upside down, the other way round."""
    project = _project(tmp_path / "a.avatar", template, 1.0, {})
    rig, albedo = Blendshapes.load(project.folder("blendshapes")), Albedo.load(project.folder("albedo"))
    drawn = picture.model(template, rig, albedo, None)
    view = picture.View(size=SMALL, height=300.0, centre=(0.0, -15.0, -20.0), distance=900.0)
    rows = []
    for light in (albedo.harmonics, albedo.harmonics * np.where(np.arange(9) == 2, -1, 1)[:, None]):
        shown = picture.frame(drawn, np.zeros(52), np.eye(3), view, picture.exposed(light))
        rows.append(shown[30:80, 44:52].astype(float).mean(axis=(1, 2)))
    assert rows[0][:10].mean() > rows[1][:10].mean() + 10


def _facts(project: Project) -> dict[str, Any]:
    """What the avatar's stamp says, but for its files."""
    return {key: value for key, value in (project.stamp("avatar") or {}).items() if key not in ("files", "seal")}

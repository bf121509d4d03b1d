"""Stage avatar: avatar.glb parsed back against the rig it was made of, the contract point by point, avatar.json."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import performances
import pycolmap
import pytest
import synthetic
import validator
from scipy.spatial.transform import Rotation

from avatarbuild import __version__
from avatarbuild.artefacts import (
    Albedo,
    Avatar,
    Blendshapes,
    Cameras,
    Capture,
    Clip,
    Cloud,
    Details,
    Neutral,
    Performance,
    Refinement,
    Views,
)
from avatarbuild.formats import avatar_glb, glb_performance
from avatarbuild.formats.gltf import Gltf, read_glb
from avatarbuild.formats.images import decode_png, encode_jpeg, encode_png
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.options import AvatarOptions
from avatarbuild.progress import Silent
from avatarbuild.simulation.subject import random_subject
from avatarbuild.stages import avatar
from avatarbuild.stages.refinement import untouched
from avatarbuild.template import ARKIT_NAMES, EYE_PARTS

SCHEMA = json.loads((Path(__file__).parent.parent / "docs" / "schemas" / "avatar.schema.json").read_text())
MORPHED = {"head": "skin", **{name: name for name in ("teeth_upper", "teeth_lower", "gums", "tongue")}}
SKIN = np.array([200, 150, 130], np.uint8)
OPTIONS = AvatarOptions()


def views(count: int, folder: str) -> Views:
    """Images of which nothing but names is known."""
    names = [f"IMG_{i:04d}" for i in range(count)]
    return synthetic.views(names, [f"{folder}/{name}.jpg" for name in names], (100, 100))


@cache
def person() -> tuple[Capture, Cameras, Cloud, Neutral, Albedo, Blendshapes, Performance]:
    """Artefacts of a random head, with a cloud of one colour that lies in another frame; a clip, of no use."""
    template = synthetic.template()
    subject = random_subject(template, np.random.default_rng(5))
    turn, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = turn * np.sign(np.linalg.det(turn)), (20, -30, 500)
    n = template.vertex_count
    skin = subject.neutral[template.parts["skin"].vertices]
    points = (skin - place[:3, 3]) @ place[:3, :3]  # the inverse of x -> R x + t
    colours = np.tile(SKIN, (len(points), 1))
    colours[template.regions["lips"][: len(points)]] = (255, 0, 0)
    cloud = Cloud(
        points.astype(np.float32), np.zeros_like(points, np.float32), colours, np.full(len(points), 3, np.uint8)
    )
    eye = np.random.default_rng(1).integers(0, 255, (32, 32, 3)).astype(np.uint8)
    neutral = Neutral(
        vertices=subject.neutral,
        triangles=template.triangles,
        coefficients=subject.identity,
        model=subject.neutral,
        eye_centres=subject.eye_centres,
        eye_radius=np.full(2, 12.0),
        head_from_cloud=place,
        seen=np.ones(n),
        distance=np.full(n, np.nan),
        eye_texture=eye,
        figures={"distance_mm": float("nan"), "rounds": np.int64(7)},
    )
    shapes = Blendshapes(subject.neutral, subject.expressions.astype(np.float32), subject.eye_centres)
    clip = Clip("video/MOV_0001.mp4", (100, 200), 30.0, np.arange(3) / 30, 100.0, np.arange(1), views(1, "video"))
    capture = Capture(views(3, "photos"), clip, 1, np.ones(3, bool), True, warnings=["light: uneven"])
    cameras = Cameras(pycolmap.Reconstruction(), True, {"source": "iris", "relative_sd": 0.043, "iris_mm": 11.7})
    plain = np.tile(SKIN, (64, 64, 1))
    level = np.full((32, 32, 3), (128, 128, 255), np.uint8)
    open_ = np.full((32, 32), 255, np.uint8)
    seen = np.full((64, 64), 90, np.uint8)
    albedo = Albedo(plain, plain, plain, seen, level, open_, np.zeros((9, 3)), np.full(3, 0.4), np.ones((3, 3)))
    return capture, cameras, cloud, neutral, albedo, shapes, performances.nothing(shapes)


@cache
def played() -> Performance:
    """What the same person's clip could have shown, were it longer."""
    return performances.performance(person()[5])


def refined() -> Refinement:
    return untouched(person()[6], [])


@cache
def built() -> Avatar:
    return avatar.run(*person(), refined(), Details({}), OPTIONS, Silent(), synthetic.template())


@cache
def animated() -> Avatar:
    """The same with a tracked clip, whose pictures are gone."""
    capture, *rest, _ = person()
    return avatar.run(
        dataclasses.replace(capture, clip=None),
        *rest,
        played(),
        untouched(played(), []),
        Details({}),
        OPTIONS,
        Silent(),
        synthetic.template(),
    )


def glb() -> Gltf:
    return read_glb(built().files["avatar.glb"])


def primitive(gltf: Gltf, mesh: str) -> dict[str, Any]:
    (one,) = gltf.named("meshes", mesh)["primitives"]
    return one


def attribute(gltf: Gltf, mesh: str, semantic: str) -> np.ndarray:
    return gltf.accessor(primitive(gltf, mesh)["attributes"][semantic])


def target(gltf: Gltf, mesh: str, shape: str, semantic: str = "POSITION") -> np.ndarray:
    return gltf.accessor(primitive(gltf, mesh)["targets"][ARKIT_NAMES.index(shape)][semantic])


def own(mesh: str) -> slice:
    """The template's vertices of a mesh."""
    return synthetic.template().parts[MORPHED.get(mesh, mesh)].vertices


def count(mesh: str) -> int:
    return own(mesh).stop - own(mesh).start


# the file as others see it


def test_validator() -> None:
    assert validator.issues(built().files["avatar.glb"]) == []


def test_pictures_and_tangents() -> None:
    *_, shapes, _ = person()
    rig = avatar_glb.Rig(shapes.neutral, shapes.deltas, shapes.eye_centres, 0.004, 0.2)
    flat = np.full((8, 8, 3), 128, np.uint8)
    level = np.full((8, 8, 3), (128, 128, 255), np.uint8)
    maps = avatar_glb.Pictures(encode_png(flat), encode_jpeg(flat, 90), encode_png(level), encode_png(flat + 1))
    made = avatar_glb.write(synthetic.template(), rig, maps, {})
    tree = read_glb(made.glb).tree
    skin = tree["materials"][primitive(read_glb(made.glb), "head")["material"]]
    assert "baseColorFactor" not in skin["pbrMetallicRoughness"]
    assert tree["images"][0]["mimeType"] == "image/jpeg"
    normals, tangents = (attribute(read_glb(made.glb), "head", name) for name in ("NORMAL", "TANGENT"))
    assert np.abs((normals * tangents[:, :3]).sum(axis=1)).max() < 1e-5
    assert (tangents[:, 3] == 1).mean() > 0.99  # the chart is not mirrored
    assert validator.issues(made.glb, worst=2) == []


def test_readers_that_leave_out_inner_parts_by_name_see_the_head_alone() -> None:
    inner = re.compile("eye(?!brow)|teeth|tooth|tongue|gum|lash|hair", re.IGNORECASE)
    nodes = [node for node in glb().tree["nodes"] if not inner.search(node["name"])]
    assert [node["name"] for node in nodes] == ["head"]


def test_size() -> None:
    assert len(built().files["avatar.glb"]) < 8e6


def test_same_bytes_twice() -> None:
    assert avatar.run(*person(), refined(), Details({}), OPTIONS, Silent(), synthetic.template()).files == built().files


# the contract


def test_asset_and_nodes() -> None:
    gltf = glb()
    assert gltf.tree["asset"] == {"version": "2.0", "generator": f"avatarbuild {__version__}"}
    assert "extensionsUsed" not in gltf.tree
    nodes = gltf.tree["nodes"]
    assert gltf.tree["scenes"][gltf.tree["scene"]]["nodes"] == [nodes.index(gltf.named("nodes", "head"))]
    children = {nodes[i]["name"] for i in gltf.named("nodes", "head")["children"]}
    assert children == {*MORPHED, *EYE_PARTS} - {"head"}
    for node in nodes:
        assert gltf.tree["meshes"][node["mesh"]]["name"] == node["name"]
        assert not {"rotation", "scale", "matrix"} & set(node)
        assert ("translation" in node) == (node["name"] in EYE_PARTS)


@pytest.mark.parametrize("mesh", MORPHED)
def test_52_targets_in_one_order(mesh: str) -> None:
    gltf = glb()
    about = gltf.named("meshes", mesh)
    assert tuple(about["extras"]["targetNames"]) == ARKIT_NAMES
    assert about["weights"] == [0] * 52
    assert [set(t) for t in primitive(gltf, mesh)["targets"]] == [{"POSITION", "NORMAL"}] * 52
    accessors = [gltf.tree["accessors"][i] for t in primitive(gltf, mesh)["targets"] for i in t.values()]
    assert all("sparse" in accessor and "bufferView" not in accessor for accessor in accessors)
    assert ("TANGENT" in primitive(gltf, mesh)["attributes"]) == (mesh == "head")


@pytest.mark.parametrize("mesh", MORPHED)
def test_metres_in_the_template_s_order(mesh: str) -> None:
    shapes = person()[-1]
    expected = shapes.neutral[own(mesh)] / 1000
    np.testing.assert_allclose(attribute(glb(), mesh, "POSITION")[: count(mesh)], expected, atol=2e-8)


def test_axes_and_origin() -> None:
    """+y up, face to +z, x to the subject's left, origin midway between the eyeballs; a head some 0.3 m high."""
    gltf = glb()
    head = attribute(gltf, "head", "POSITION")
    assert 0.2 < np.ptp(head[:, 1]) < 0.45
    left, right = (np.array(gltf.named("nodes", eye)["translation"]) for eye in EYE_PARTS)
    np.testing.assert_allclose(left + right, 0, atol=1e-9)
    assert 0.025 < left[0] < 0.04
    template = synthetic.template()
    nose = template.landmarks(person()[-1].neutral)[1] / 1000
    assert nose[2] > 0.03
    assert nose[1] < -0.01


@pytest.mark.parametrize("mesh", MORPHED)
def test_seams_join_copies_of_one_vertex(mesh: str) -> None:
    """Every corner of every triangle has the template's position and texture coordinate, v from the top."""
    template, gltf = synthetic.template(), glb()
    corners = gltf.accessor(primitive(gltf, mesh)["indices"]).reshape(-1, 3)
    where = template.parts[MORPHED[mesh]].triangles
    expected = person()[-1].neutral[template.triangles[where]] / 1000
    np.testing.assert_allclose(attribute(gltf, mesh, "POSITION")[corners], expected, atol=2e-8)
    if mesh == "head":
        uv = template.uv[template.uv_triangles[where]]
        expected_uv = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1)
        np.testing.assert_allclose(attribute(gltf, mesh, "TEXCOORD_0")[corners], expected_uv, atol=1e-7)
    assert len(np.unique(corners)) == len(attribute(gltf, mesh, "POSITION"))


@pytest.mark.parametrize("mesh", [*MORPHED, *EYE_PARTS])
def test_normals_are_the_unsplit_mesh_s(mesh: str) -> None:
    found = attribute(glb(), mesh, "NORMAL")
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    expected = vertex_normals(person()[-1].neutral, synthetic.template().triangles)[own(mesh)]
    np.testing.assert_allclose(found[: count(mesh)], expected, atol=1e-6)


@pytest.mark.parametrize("mesh", MORPHED)
def test_shapes(mesh: str) -> None:
    """What is left out is below the options' limits, and what is kept is kept to float32's rounding."""
    gltf, shapes, template = glb(), person()[-1], synthetic.template()
    rest = vertex_normals(shapes.neutral, template.triangles)
    for name, delta in zip(ARKIT_NAMES, shapes.deltas.astype(np.float64), strict=True):
        moved = target(gltf, mesh, name)[: count(mesh)] * 1000.0
        error = np.linalg.norm(moved - delta[own(mesh)], axis=1)
        assert error.max() <= OPTIONS.least_motion
        assert error[np.linalg.norm(moved, axis=1) > 0].max(initial=0) < 1e-5
        below = shapes.deltas[ARKIT_NAMES.index("jawOpen")] if name == "mouthClose" else np.zeros(3)
        turned = vertex_normals(shapes.neutral + below + delta, template.triangles)
        turned -= vertex_normals(shapes.neutral + below, template.triangles) if name == "mouthClose" else rest
        found = target(gltf, mesh, name, "NORMAL")[: count(mesh)]
        assert np.linalg.norm(found - turned[own(mesh)], axis=1).max() <= np.radians(OPTIONS.least_turn) + 1e-6


def test_copies_at_seams_move_together() -> None:
    gltf = glb()
    place, moved = attribute(gltf, "head", "POSITION"), target(gltf, "head", "jawOpen")
    n = count("head")
    original = {tuple(p): i for i, p in enumerate(place[:n].tolist())}
    sources = [original[tuple(p)] for p in place[n:].tolist()]
    assert len(sources) > 100
    np.testing.assert_array_equal(moved[n:], moved[sources])


def test_what_has_no_effect_is_declared() -> None:
    gltf = glb()
    for mesh in MORPHED:
        still = [name for name in ARKIT_NAMES if not target(gltf, mesh, name).any()]
        assert gltf.named("meshes", mesh)["extras"]["noEffect"] == still
    assert gltf.named("meshes", "head")["extras"]["noEffect"] == ["tongueOut"]
    lower = gltf.named("meshes", "teeth_lower")["extras"]["noEffect"]
    assert not {"jawOpen", "jawLeft", "jawRight", "jawForward"} & set(lower)
    assert "tongueOut" not in gltf.named("meshes", "tongue")["extras"]["noEffect"]


def test_eyes_turn_about_their_nodes() -> None:
    """The balls at a gaze, posed by `extras.eyeLook` alone as a viewer would, are where the rig says."""
    gltf, shapes, template = glb(), person()[-1], synthetic.template()
    weights = np.zeros(52)
    gaze = {"eyeLookUpLeft": 0.5, "eyeLookOutLeft": 0.8, "eyeLookDownRight": 1.0, "eyeLookInRight": 0.3}
    for name, weight in gaze.items():
        weights[ARKIT_NAMES.index(name)] = weight
    expected = template.pose(shapes.neutral, weights, shapes.eye_centres)
    look = gltf.tree["extras"]["eyeLook"]
    assert sorted(look) == sorted(name for name in ARKIT_NAMES if name.startswith("eyeLook"))
    for eye in EYE_PARTS:
        node = gltf.named("nodes", eye)
        turn = sum(
            (gaze.get(name, 0) * np.radians(about["degrees"]) * np.array(about["axis"]))
            for name, about in look.items()
            if about["node"] == eye
        )
        angle = np.linalg.norm(turn)
        x, y, z = turn / angle
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        ball = attribute(gltf, eye, "POSITION")[: count(eye)] @ rotation.T + node["translation"]
        np.testing.assert_allclose(ball * 1000, expected[own(eye)], atol=1e-4)
        assert node["extras"]["eyeLook"] == {name: about for name, about in look.items() if about["node"] == eye}
        assert "targets" not in primitive(gltf, eye)


def test_gaze_goes_where_the_names_say() -> None:
    gltf = glb()
    towards = {"Up": (0, 1), "Down": (0, -1)}
    for name, about in gltf.tree["extras"]["eyeLook"].items():
        side, left = name.removeprefix("eyeLook"), about["node"] == "eye_left"
        way = side.removesuffix("Left").removesuffix("Right")
        assert name.endswith("Left") == left
        # in: towards the nose, which is -x for the left eye
        expected = towards.get(way, (1 if (way == "Out") == left else -1, 0))
        gaze = np.cross(about["axis"], [0, 0, 1])[:2]  # where the axis begins to carry +z
        np.testing.assert_allclose(gaze, expected, atol=1e-9)


def test_both_eyes_wear_the_whole_eye_texture() -> None:
    gltf = glb()
    left, right = (attribute(gltf, eye, "TEXCOORD_0") for eye in EYE_PARTS)
    np.testing.assert_allclose(left, right, atol=1e-6)
    np.testing.assert_allclose([left.min(axis=0), left.max(axis=0)], [[0, 0], [1, 1]], atol=1e-6)
    ball = attribute(gltf, "eye_left", "POSITION")
    np.testing.assert_allclose(left[ball[:, 2].argmax()], 0.5, atol=0.01)  # the pupil in the middle
    ahead = np.where(ball[:, 2] > 0.009, ball[:, 1], -1).argmax()
    assert left[ahead, 1] < 0.3  # above the pupil: nearer to the picture's top
    material = gltf.tree["materials"][primitive(gltf, "eye_left")["material"]]
    assert material["name"] == "eye"
    texture = gltf.tree["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]
    image = gltf.tree["images"][texture["source"]]
    assert gltf.view(image["bufferView"]) == encode_png(person()[3].eye_texture)


def test_skin_wears_the_albedo() -> None:
    gltf = glb()
    skin = gltf.tree["materials"][primitive(gltf, "head")["material"]]
    surface = skin["pbrMetallicRoughness"]
    assert surface["metallicFactor"] == 0
    assert 0.4 <= surface["roughnessFactor"] <= 0.6
    albedo = person()[4]
    image = gltf.tree["images"][gltf.tree["textures"][surface["baseColorTexture"]["index"]]["source"]]
    assert gltf.view(image["bufferView"]) == encode_jpeg(albedo.albedo, OPTIONS.albedo_quality)
    assert {"normalTexture", "occlusionTexture"} <= set(skin)
    teeth = gltf.tree["materials"][primitive(gltf, "teeth_upper")["material"]]
    assert teeth["occlusionTexture"] == skin["occlusionTexture"]
    files = built().files
    assert np.array_equal(decode_png(files["albedo.png"]), albedo.albedo)
    assert np.array_equal(decode_png(files["coverage.png"]), albedo.coverage)


def test_extras_say_scale_and_limits() -> None:
    extras = glb().tree["extras"]
    assert extras["scale"]["source"] == "iris"
    assert extras["weightLimits"] == [{"shape": "mouthClose", "atMost": "jawOpen"}]


# avatar.json


def about(made: Avatar) -> dict[str, Any]:
    value = json.loads(made.files["avatar.json"])
    jsonschema.validate(value, SCHEMA)
    return value


def test_provenance() -> None:
    value = about(built())
    assert value["files"]["avatar.glb"]["sha256"] == hashlib.sha256(built().files["avatar.glb"]).hexdigest()
    assert value["capture"]["photos"] == [f"photos/IMG_{i:04d}.jpg" for i in range(3)]
    assert value["capture"]["frontal"] == "photos/IMG_0001.jpg"
    assert value["capture"]["video"] == "video/MOV_0001.mp4"
    assert value["scale"]["relative_sd"] == 0.043
    assert list(value["shapes"]) == list(ARKIT_NAMES)
    jaw = person()[-1].deltas[ARKIT_NAMES.index("jawOpen")]
    assert value["shapes"]["jawOpen"]["largest_mm"] == pytest.approx(np.linalg.norm(jaw, axis=1).max(), abs=1e-3)
    assert value["no_effect"]["meshes"]["head"] == ["tongueOut"]
    assert value["no_effect"]["anywhere"] == []
    assert value["figures"]["neutral"] == {"distance_mm": None, "rounds": 7}
    assert value["warnings"]["capture"] == ["light: uneven"]
    assert "timing" not in value


def test_photos_alone_give_a_whole_avatar() -> None:
    capture, *rest = person()
    made = avatar.run(
        dataclasses.replace(capture, clip=None), *rest, refined(), Details({}), OPTIONS, Silent(), synthetic.template()
    )
    assert made.files["avatar.glb"] == built().files["avatar.glb"]
    assert about(made)["capture"]["video"] is None


# the performance


def test_validator_on_an_animated_file() -> None:
    assert validator.issues(animated().files["avatar.glb"], worst=2) == []


def channel(gltf: Gltf, node: str, path: str) -> np.ndarray:
    """The keys of a node's only channel of a path, at the clip's times."""
    (animation,) = gltf.tree["animations"]
    index = gltf.tree["nodes"].index(gltf.named("nodes", node))
    (one,) = [c for c in animation["channels"] if c["target"] == {"node": index, "path": path}]
    sampler = animation["samplers"][one["sampler"]]
    assert sampler["interpolation"] == "LINEAR"
    np.testing.assert_allclose(gltf.accessor(sampler["input"]), played().times, atol=1e-7)
    return gltf.accessor(sampler["output"])


def test_every_mesh_with_shapes_plays_the_weights() -> None:
    gltf = read_glb(animated().files["avatar.glb"])
    for mesh in MORPHED:
        np.testing.assert_allclose(channel(gltf, mesh, "weights").reshape(-1, 52), played().weights, atol=1e-7)
    assert len(gltf.tree["animations"][0]["channels"]) == len(MORPHED) + 2 + 2


def test_the_eyes_play_the_gaze_of_the_weights() -> None:
    gltf = read_glb(animated().files["avatar.glb"])
    for side, eye in enumerate(EYE_PARTS):
        turned = Rotation.from_quat(channel(gltf, eye, "rotation")).as_matrix()
        expected = [synthetic.template().eye_rotation_matrices(w)[side] for w in played().weights]
        np.testing.assert_allclose(turned, expected, atol=1e-6)


def test_the_head_before_the_camera_is_where_the_video_saw_it() -> None:
    """inverse(camera's node) head's key = diag(1, -1, -1) pose; at rest, without a transform, the first good pose."""
    gltf, p = read_glb(animated().files["avatar.glb"]), played()
    head, node = gltf.named("nodes", "head"), gltf.named("nodes", "video_camera")
    roots = gltf.tree["scenes"][0]["nodes"]
    assert [gltf.tree["nodes"][i]["name"] for i in roots] == ["head", "video_camera"]
    assert not {"translation", "rotation", "matrix", "scale"} & set(head)
    C = Rotation.from_quat(node["rotation"]).as_matrix()
    turns = Rotation.from_quat(channel(gltf, "head", "rotation")).as_matrix()
    shifts = channel(gltf, "head", "translation")
    points = np.array([[0, 0, 0], [0.03, -0.04, 0.02]])
    for i in range(len(p.times)):
        placed = points @ turns[i].T + shifts[i]
        seen = (placed - node["translation"]) @ C * [1, -1, -1]  # to OpenCV's axes
        np.testing.assert_allclose(seen * 1000, points * 1000 @ p.rotation[i].T + p.translation[i], atol=1e-3)
    np.testing.assert_allclose(turns[1], np.eye(3), atol=1e-6)  # frame 0 is lost
    np.testing.assert_allclose(shifts[1], 0, atol=1e-8)


def test_the_camera_has_the_clip_s_lens() -> None:
    gltf, p = read_glb(animated().files["avatar.glb"]), played()
    about = gltf.tree["cameras"][gltf.named("nodes", "video_camera")["camera"]]
    assert about["perspective"]["aspectRatio"] == 0.5
    assert np.tan(about["perspective"]["yfov"] / 2) * p.focal == pytest.approx(100)
    assert about["extras"]["k1"] == p.k1


def test_quaternions_keep_their_sign() -> None:
    angles = np.linspace(0, 4 * np.pi, 60)
    turns = Rotation.from_rotvec(angles[:, None] * [0.0, 1.0, 0.0])
    found = glb_performance.quaternions(turns.as_matrix())
    assert (found[1:] * found[:-1]).sum(axis=1).min() > 0.9
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), turns.as_matrix(), atol=1e-12)


def test_the_rig_is_the_one_the_video_taught() -> None:
    moved = target(read_glb(animated().files["avatar.glb"]), "head", "jawOpen")[: count("head")]
    transferred = target(glb(), "head", "jawOpen")[: count("head")]
    far = np.linalg.norm(transferred, axis=1) > 1e-3
    np.testing.assert_allclose(moved[far], 1.1 * transferred[far], rtol=1e-5)
    assert read_glb(animated().files["avatar.glb"]).tree["extras"]["evidence"]["jawOpen"] == 0.85


def test_the_clip_in_the_provenance() -> None:
    value = about(animated())
    assert value["clip"]["file"] == "video/MOV_0001.mp4"
    assert value["clip"]["frames"] == {"decoded": 12, "processed": 4, "modelled": 3, "lost": 1}
    assert value["shapes"]["jawOpen"]["evidence"] == 0.85
    assert value["shapes"]["mouthPucker"]["evidence"] == 0
    assert value["figures"]["tracking"] == {"frames": 12}
    assert {"track.json", "track.csv"} <= set(value["files"]) & set(animated().files)
    assert json.loads(animated().files["track.json"])["video"] == "MOV_0001.mp4"


def test_without_frames_nothing_is_animated() -> None:
    gltf, value = glb(), about(built())
    assert not {"animations", "cameras"} & set(gltf.tree)
    assert not {"track.json", "track.csv"} & set(built().files)
    assert value["clip"] is None
    assert set(gltf.tree["extras"]["evidence"].values()) == {0}


def test_saved_and_loaded(tmp_path: Path) -> None:
    built().save(tmp_path / "avatar")
    assert sorted(path.name for path in (tmp_path / "avatar").iterdir()) == sorted(built().files)
    assert Avatar.load(tmp_path / "avatar").files == built().files


# cutting along seams


def test_two_triangles_cut_apart_in_the_texture() -> None:
    """A square of two triangles whose halves lie apart in the texture: the shared edge's corners are doubled."""
    triangles, uv_triangles = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 1, 2], [3, 4, 5]])
    uv = np.arange(12.0).reshape(6, 2) / 12
    split = avatar_glb.split_at_seams(triangles, uv_triangles, uv, 4)
    np.testing.assert_array_equal(split.sources, [0, 1, 2, 3, 0, 2])
    np.testing.assert_array_equal(split.triangles, [[0, 1, 2], [4, 5, 3]])
    np.testing.assert_array_equal(split.uv[split.triangles], uv[uv_triangles])


def test_without_seams_nothing_is_doubled() -> None:
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    split = avatar_glb.split_at_seams(triangles, triangles, np.zeros((4, 2)), 5)
    np.testing.assert_array_equal(split.sources, np.arange(5))
    np.testing.assert_array_equal(split.triangles, triangles)


def test_the_order_is_printed_in_the_documentation() -> None:
    text = (Path(__file__).parent.parent / "docs" / "formats.md").read_text(encoding="utf-8")
    printed = {int(number): name for number, name in re.findall(r"(\d+) `(\w+)` \|", text)}
    assert tuple(printed[i] for i in range(52)) == ARKIT_NAMES

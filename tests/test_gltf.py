"""GLB files: by hand, there and back, and before the Khronos validator."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import validator

from avatarbuild.formats.gltf import Gltf, Writer, read_glb
from avatarbuild.formats.images import encode_jpeg, encode_png

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
FRONT = np.tile([0.0, 0, 1], (3, 1))


def triangle() -> Writer:
    """A triangle with one morph target: its last corner goes up by 0.25; nothing else moves."""
    writer = Writer("tests")
    target = {"POSITION": writer.sparse(np.array([2]), np.array([[0, 0.25, 0]]), 3)}
    target["NORMAL"] = writer.sparse(np.zeros(0, int), np.zeros((0, 3)), 3)
    primitive = {
        "attributes": {
            "POSITION": writer.attribute(CORNERS, bounds=True),
            "NORMAL": writer.attribute(FRONT),
        },
        "indices": writer.indices(np.array([[0, 1, 2]])),
        "targets": [target],
    }
    mesh = writer.add("meshes", {"primitives": [primitive], "extras": {"targetNames": ["up"]}})
    node = writer.add("nodes", {"name": "face", "mesh": mesh})
    writer.tree |= {"scene": 0, "scenes": [{"nodes": [node]}]}
    return writer


def parsed() -> Gltf:
    return read_glb(triangle().glb())


def test_arrays_come_back() -> None:
    gltf = parsed()
    primitive = gltf.tree["meshes"][0]["primitives"][0]
    np.testing.assert_array_equal(gltf.accessor(primitive["attributes"]["POSITION"]), CORNERS)
    np.testing.assert_array_equal(gltf.accessor(primitive["indices"]), [0, 1, 2])
    np.testing.assert_array_equal(
        gltf.accessor(primitive["targets"][0]["POSITION"]), [[0, 0, 0], [0, 0, 0], [0, 0.25, 0]]
    )
    np.testing.assert_array_equal(gltf.accessor(primitive["targets"][0]["NORMAL"]), np.zeros((3, 3)))


def test_bytes_of_the_header_by_hand() -> None:
    data = triangle().glb()
    magic, version, length, size, kind = struct.unpack_from("<4sIIII", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), 0x4E4F534A)
    assert size % 4 == 0
    binary, kind = struct.unpack_from("<II", data, 20 + size)
    assert (binary % 4, kind) == (0, 0x004E4942)
    assert 20 + size + 8 + binary == len(data)


def test_bounds_count_the_rows_that_stay() -> None:
    tree = parsed().tree
    primitive = tree["meshes"][0]["primitives"][0]
    accessor = tree["accessors"][primitive["targets"][0]["POSITION"]]
    assert (accessor["min"], accessor["max"]) == ([0, 0, 0], [0, 0.25, 0])
    assert "bufferView" not in accessor

    every = Writer("tests")
    every.sparse(np.arange(3), np.array([[1.0, 2, 3], [2, 2, 2], [4, 5, 6]]), 3)
    assert every.tree["accessors"][0]["min"] == [1, 2, 2]


def test_equal_bytes_are_stored_once() -> None:
    writer = Writer("tests")
    for _ in range(2):
        writer.sparse(np.array([1]), np.array([[1.0, 0, 0]]), 3)
    assert len(writer.tree["bufferViews"]) == 2


def test_large_meshes_count_in_32_bit() -> None:
    writer = Writer("tests")
    few, many = writer.indices(np.array([[0, 1, 65534]])), writer.indices(np.array([[0, 1, 65535]]))
    assert writer.tree["accessors"][few]["componentType"] == 5123
    assert writer.tree["accessors"][many]["componentType"] == 5125


def test_strided_vertices_are_read() -> None:
    rows = np.arange(12, dtype="<f4").reshape(2, 6)
    view = {"buffer": 0, "byteLength": 48, "byteStride": 24}
    accessors = [{"bufferView": 0, "byteOffset": 12, "componentType": 5126, "count": 2, "type": "VEC3"}]
    gltf = Gltf({"bufferViews": [view], "accessors": accessors}, rows.tobytes())
    np.testing.assert_array_equal(gltf.accessor(0), rows[:, 3:])


@pytest.mark.parametrize("cut", [0, 11, 40, -4])
def test_broken_files_are_refused(cut: int) -> None:
    with pytest.raises(ValueError, match="glTF"):
        read_glb(triangle().glb()[:cut])


def test_files_with_buffers_elsewhere_are_refused() -> None:
    text = json.dumps({"asset": {"version": "2.0"}, "buffers": [{"byteLength": 3, "uri": "a.bin"}]}).encode()
    text += b" " * (-len(text) % 4)
    data = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text
    with pytest.raises(ValueError, match="other files"):
        read_glb(data)


def test_the_validator_finds_faults() -> None:
    """The oracle itself: it must not pass everything."""
    writer = triangle()
    writer.tree["accessors"][0]["max"] = [9, 9, 9]
    assert any("ACCESSOR_MAX_MISMATCH" in line for line in validator.issues(writer.glb()))


def test_valid() -> None:
    assert validator.issues(triangle().glb(), worst=2) == []


def test_pictures_cameras_and_animations_are_valid() -> None:
    writer = triangle()
    writer.tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = writer.attribute(CORNERS[:, :2])
    rgb = np.full((4, 4, 3), 200, np.uint8)
    colour, occlusion = writer.texture(encode_jpeg(rgb, 90), "colour"), writer.texture(encode_png(rgb), "occlusion")
    surface = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": colour}},
        "occlusionTexture": {"index": occlusion},
    }
    writer.tree["meshes"][0]["primitives"][0]["material"] = writer.add("materials", surface)
    lens = {"yfov": 0.6, "aspectRatio": 0.5625, "znear": 0.01}
    camera = writer.add("cameras", {"type": "perspective", "perspective": lens})
    writer.tree["scenes"][0]["nodes"].append(writer.add("nodes", {"name": "video_camera", "camera": camera}))
    times = writer.keys(np.arange(3) / 30, bounds=True)
    turn = np.tile([0.0, 0, 0, 1], (3, 1))
    values = {"weights": np.array([0, 0.5, 1]), "rotation": turn, "translation": np.zeros((3, 3))}
    samplers = [{"input": times, "output": writer.keys(array)} for array in values.values()]
    channels = [{"sampler": i, "target": {"node": 0, "path": path}} for i, path in enumerate(values)]
    writer.add("animations", {"name": "performance", "samplers": samplers, "channels": channels})
    glb = writer.glb()
    assert validator.issues(glb, worst=2) == []
    gltf = read_glb(glb)
    np.testing.assert_array_equal(gltf.accessor(samplers[0]["output"]), np.array([0, 0.5, 1], np.float32))
    assert gltf.view(gltf.tree["images"][1]["bufferView"]) == encode_png(rgb)

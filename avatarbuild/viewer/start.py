"""What the viewer's first picture shows: head and eyes at rest with a small albedo. Little is imported for it."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from avatarbuild.errors import InputError
from avatarbuild.formats.gltf import Gltf, Writer, read_glb
from avatarbuild.project import Project

_SIDE, _QUALITY = 1024, 90  # texels along a side at least, and JPEG quality, of the first picture's colours
_SHOWN = ("head", "eye_left", "eye_right")  # meshes of the first picture: what stands behind closed lips is not seen
_ATTRIBUTES = ("POSITION", "NORMAL", "TEXCOORD_0")


def opened(path: Path) -> Gltf:
    """An avatar.glb. Raises InputError where it is damaged."""
    try:
        return read_glb(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}): run stage avatar again") from error


def first(glb: Gltf) -> bytes:
    """Head and eyes of an avatar.glb at rest, without shapes, and their colours; the albedo of 1024 to 2047 texels."""
    tree, writer = glb.tree, Writer(glb.tree["asset"].get("generator", "avatarbuild"))
    pictures: dict[int, int] = {}  # texture of the file -> ours
    nodes = []
    for name in _SHOWN:
        node = glb.named("nodes", name)
        primitive = tree["meshes"][node["mesh"]]["primitives"][0]
        about = tree["materials"][primitive["material"]]
        colour = dict(about["pbrMetallicRoughness"])
        if "baseColorTexture" in colour:
            texture = colour["baseColorTexture"]["index"]
            if texture not in pictures:
                image = tree["images"][tree["textures"][texture]["source"]]
                data = glb.view(image["bufferView"])
                pictures[texture] = writer.texture(halved(data, _SIDE) or data, image.get("name", name))
            colour["baseColorTexture"] = {"index": pictures[texture]}
        attributes = {
            kind: writer.attribute(glb.accessor(primitive["attributes"][kind]), bounds=kind == "POSITION")
            for kind in _ATTRIBUTES
        }
        material = writer.add("materials", {"name": about["name"], "pbrMetallicRoughness": colour})
        part = {
            "attributes": attributes,
            "indices": writer.indices(glb.accessor(primitive["indices"])),
            "material": material,
        }
        mesh = writer.add("meshes", {"name": name, "primitives": [part]})
        place = {"translation": node["translation"]} if "translation" in node else {}
        nodes.append(writer.add("nodes", {"name": name, "mesh": mesh, **place}))
    head, *eyes = nodes
    writer.tree["nodes"][head]["children"] = eyes
    writer.tree |= {"scene": writer.add("scenes", {"nodes": [head]})}
    return writer.glb()


def photo_light(project: Project) -> list[list[float]] | None:
    """(9, 3) the photos' light; None where stage albedo has not been run."""
    try:
        with np.load(project.folder("albedo") / "light.npz") as arrays:
            return np.round(arrays["harmonics"], 5).tolist()
    except (OSError, KeyError, ValueError):
        return None


def halved(picture: bytes, side: int) -> bytes | None:
    """A JPEG of the picture, halved as often as its longer side stays `side` at least; None where it is not halved."""
    try:
        with Image.open(io.BytesIO(picture)) as image:
            times = 1
            while max(image.size) >= 2 * times * side:
                times *= 2
            if times == 1:
                return None
            whole = max(image.size)
            image.draft("RGB", (image.width // times, image.height // times))  # JPEG's blocks are decoded smaller
            left = times * max(image.size) // whole
            done = io.BytesIO()
            image.convert("RGB").reduce(left).save(done, "JPEG", quality=_QUALITY)
            return done.getvalue()
    except OSError:
        return None

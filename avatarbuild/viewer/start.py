"""
The avatar as the viewer's page gets it: head and eyes at rest with small pictures, then avatar.glb with a smaller
albedo.

Little is imported for it.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from avatarbuild.errors import InputError
from avatarbuild.formats.gltf import Gltf, Writer, read_glb, with_picture
from avatarbuild.formats.light import read_light
from avatarbuild.project import Project

_FIRST_SIDES = {"albedo": 1024, "eye": 512}  # least texels along the longer side of the first picture's colours
_SIDE = 2048  # and of the albedo that avatar.glb has on the page
_QUALITY = 90  # of all of them as JPEG
_SHOWN = ("head", "eye_left", "eye_right")  # meshes of the first picture: what stands behind closed lips is not seen
_ATTRIBUTES = ("POSITION", "NORMAL", "TEXCOORD_0")


def opened(path: Path) -> Gltf:
    """An avatar.glb. Raises InputError where it is damaged."""
    try:
        return read_glb(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}): run stage avatar again") from error


def first(glb: Gltf) -> bytes:
    """Head and eyes of an avatar.glb at rest, without shapes, and their colours made smaller."""
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
                data, title = glb.view(image["bufferView"]), image.get("name", "")
                pictures[texture] = writer.texture(halved(data, _FIRST_SIDES.get(title, _SIDE)) or data, title)
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


def lighter(glb: Gltf, path: Path) -> Path | bytes:
    """The file `path` of an avatar.glb, or what it becomes with an albedo of 2048 to 4095 texels where it has more."""
    made = halved(albedo(glb), _SIDE)
    return path if made is None else with_picture(glb, "albedo", made)


def albedo(glb: Gltf) -> bytes:
    """The albedo's file; b"" where there is none, as in files of early versions."""
    images = [image for image in glb.tree.get("images", []) if image.get("name") == "albedo"]
    return glb.view(images[0]["bufferView"]) if images else b""


def photo_light(project: Project) -> list[list[float]] | None:
    """(9, 3) the photos' light; None where stage albedo has not been run."""
    try:
        return np.round(read_light(project.folder("albedo"))["harmonics"], 5).tolist()
    except (OSError, KeyError, ValueError):
        return None


def is_large(picture: bytes) -> bool:
    """Whether avatar.glb has a smaller one on the page."""
    return _halvings(picture, _SIDE) > 0


def halved(picture: bytes, side: int) -> bytes | None:
    """A JPEG of the picture, halved as often as its longer side stays `side` at least; None where it is not halved."""
    times = 2 ** _halvings(picture, side)
    if times == 1:
        return None
    with Image.open(io.BytesIO(picture)) as image:
        whole = image.width
        image.draft("RGB", (image.width // times, image.height // times))  # a JPEG is decoded smaller
        done = io.BytesIO()
        image.convert("RGB").reduce(times * image.width // whole).save(done, "JPEG", quality=_QUALITY)
    return done.getvalue()


def _halvings(picture: bytes, side: int) -> int:
    try:
        with Image.open(io.BytesIO(picture)) as image:
            return max((max(image.size) // side).bit_length() - 1, 0)
    except OSError:
        return 0

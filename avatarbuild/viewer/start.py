"""
The avatar as the viewer's page first gets it: head and eyes at rest with a small albedo, then avatar.glb with a larger.

Nothing is imported here but what the first picture needs.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import numpy as np
from PIL import Image

from avatarbuild.errors import InputError
from avatarbuild.formats.gltf import Gltf, Writer, read_glb, with_picture
from avatarbuild.project import Project

_SIDE = 2048  # texels of the albedo that avatar.glb has on the page, at least
_FIRST_SIDE = 1024  # and of the first picture's
_QUALITY = 90  # of both as JPEG
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
                pictures[texture] = writer.texture(_smaller(data, _FIRST_SIDE) or data, image.get("name", name))
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


def lighter(glb: Gltf) -> bytes:
    """avatar.glb with an albedo of 2048 to 4095 texels along a side, where its own is larger."""
    made = _smaller(_albedo(glb), _SIDE)
    return with_picture(glb, None, b"") if made is None else with_picture(glb, "albedo", made)


def full_albedo(glb: Gltf) -> bytes | None:
    """The albedo's file where it is larger than the one of `lighter`."""
    data = _albedo(glb)
    with contextlib.suppress(OSError), Image.open(io.BytesIO(data)) as image:
        if max(image.size) >= 2 * _SIDE:
            return data
    return None


def photo_light(project: Project) -> list[list[float]] | None:
    """(9, 3) the photos' light; None where stage albedo has not been run."""
    try:
        with np.load(project.folder("albedo") / "light.npz") as arrays:
            return np.round(arrays["harmonics"], 5).tolist()
    except (OSError, KeyError, ValueError):
        return None


def _albedo(glb: Gltf) -> bytes:
    """The albedo's file; b"" where there is none, as in files of early versions."""
    images = [image for image in glb.tree.get("images", []) if image.get("name") == "albedo"]
    return glb.view(images[0]["bufferView"]) if images else b""


def _smaller(picture: bytes, side: int) -> bytes | None:
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

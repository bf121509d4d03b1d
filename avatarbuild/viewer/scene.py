"""
What the viewer's page is made of: address -> content, from a project's finished stages.

The page itself is small; the avatar comes as a lighter avatar.glb (albedo of 2048 texels), the full albedo, the other
rig, the performance and the video follow when they are asked for. docs/viewer.md lists the addresses.
"""

from __future__ import annotations

import functools
import io
import json
import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

from avatarbuild.artefacts import Blendshapes
from avatarbuild.errors import InputError
from avatarbuild.formats import avatar_glb
from avatarbuild.formats.gltf import Gltf, read_glb, with_picture
from avatarbuild.geometry.head_pose import head_angles
from avatarbuild.geometry.meshes import adjacency, border
from avatarbuild.project import Project
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.viewer import film
from avatarbuild.viewer.server import LIBRARY, Content, library, page_files

log = logging.getLogger(__name__)

SCENE_VERSION = 1
PAGE = (
    *("index.html", "viewer.css", "main.js", "stage.js", "avatar.js", "surface.js", "details.js", "environment.js"),
    *("light.js", "panel.js", "keys.js", "timeline.js", "shapes.js", "record.js", "live.js"),
    *("surface.vert.glsl", "surface.frag.glsl", "LICENSE-three.js.txt"),
)
_SYNTHESIS = Path(__file__).parents[1] / "details" / "synthesis.glsl"
_SIDE, _QUALITY = 2048, 90  # texels and JPEG quality of the albedo that the page starts with
_LEAST_MOTION, _LEAST_TURN = 0.02, 0.6  # mm, degrees: less than this the other rig leaves out
_FADE = 35.0  # mm from the rim of the neck over which the skin ends
_PIXEL = np.full((1, 1, 3), 128, np.uint8)


def files(project: Project, *, live: int | None) -> dict[str, Content]:
    """
    The page of a project with a finished avatar. live: the UDP port where messages are heard; None: nowhere.

    Raises InputError where there is no avatar, or three.js is not installed.
    """
    folder = project.folder("avatar")
    glb = folder / "avatar.glb"
    if not glb.is_file():
        raise InputError(f"{project.root} has no avatar yet: finish `avatarbuild run` first")
    table: dict[str, Content] = {**page_files(*PAGE), "synthesis.glsl": _SYNTHESIS, LIBRARY: library()}
    opened = functools.cache(lambda: _opened(glb))
    picture = _albedo(opened())
    template = functools.cache(lambda: project.template().load())
    about: dict[str, Any] = {
        "version": SCENE_VERSION,
        "title": project.root.resolve().name.removesuffix(".avatar"),
        "albedo": _side(picture) >= 2 * _SIDE,  # whether there is a larger one than avatar.glb has on the page
        "details": False,
        "performance": False,
        "video": False,
        "transferred": False,
        "live": live,
        "light": _light(project),
        "missing": {},
    }
    table["data/avatar.glb"] = lambda: lighter(opened())
    if about["albedo"]:
        table["data/albedo.jpg"] = picture
    table["data/traits.bin"] = lambda: traits(template(), opened())
    details = details_of(folder / "details")
    table |= details
    about["details"] = bool(details)
    if not details:
        about["missing"]["details"] = "This avatar has no details that follow the expression: no video showed any."
    track = folder / "track.json"
    about["performance"] = track.is_file()
    if about["performance"]:
        table["data/performance.json"] = lambda: json.dumps(performance(track), separators=(",", ":")).encode()
        video = film.source(project)
        about["video"] = video is not None
        if video is not None:
            table["data/video.mp4"] = lambda: film.for_page(video, project.clip_folder)
        else:
            about["missing"]["video"] = "The video is no longer where project.toml says that the capture is."
    else:
        about["missing"]["performance"] = "No video was tracked: load a table of weights, or use live input."
    if project.stamp("blendshapes") is not None:
        about["transferred"] = True
        table["data/transferred.glb"] = lambda: transferred(project, template())
    table["data/scene.json"] = json.dumps(about).encode()
    return table


def lighter(glb: Gltf) -> bytes:
    """avatar.glb with an albedo of 2048 to 4095 texels along a side, where its own is larger."""
    data = _albedo(glb)
    halves = _side(data) // _SIDE
    if halves < 2:
        return with_picture(glb, None, b"")
    steps = (cv2.IMREAD_REDUCED_COLOR_2, cv2.IMREAD_REDUCED_COLOR_4, cv2.IMREAD_REDUCED_COLOR_8)
    reduced = steps[min(halves.bit_length(), 4) - 2]
    smaller = cv2.imdecode(np.frombuffer(data, np.uint8), reduced)
    assert smaller is not None
    done, jpeg = cv2.imencode(".jpg", smaller, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    return with_picture(glb, "albedo", jpeg.tobytes())


def traits(template: Template, glb: Gltf) -> bytes:
    """
    What the template tells of mesh `head`. Two vertices (uint32, little-endian) whose distance is the gap between the
    lips; then four bytes a vertex: lips, inside of the mouth, scalp (0 or 255, softened over two rings), and the
    distance to the rim of the neck, 255 from 35 mm on. Plain skin where the template does not fit the file.
    """
    primitive = glb.named("meshes", "head")["primitives"][0]
    positions = glb.accessor(primitive["attributes"]["POSITION"]) / avatar_glb.METRES
    skin = template.parts["skin"]
    n = skin.vertices.stop
    split = avatar_glb.split_at_seams(
        template.triangles[skin.triangles], template.uv_triangles[skin.triangles], template.uv, n
    )
    if len(split.sources) != len(positions):
        log.warning("avatar.glb was made with another head template: lips and scalp look like the rest of the skin")
        return np.full(2, 2**32 - 1, "<u4").tobytes() + bytes((0, 0, 0, 255)) * len(positions)
    regions = {name: mask[:n] for name, mask in template.regions.items()}
    masks = np.stack(
        [regions["lips"], regions["mouth"] & ~regions["face"] & ~regions["lips"], regions["scalp"]], axis=1
    )
    near = adjacency(n, template.triangles[skin.triangles])
    near = near.multiply(1 / np.maximum(near.sum(axis=1), 1)).tocsr()
    soft = masks.astype(np.float64)
    for _ in range(2):
        soft = 0.5 * soft + 0.5 * (near @ soft)
    rim = border(n, template.triangles[skin.triangles]) & regions["neck"]
    distance = np.full(n, _FADE)
    if rim.any():
        distance = cKDTree(positions[:n][rim]).query(positions[:n])[0]
    rows = np.concatenate([soft, np.clip(distance / _FADE, 0, 1)[:, None]], axis=1)
    lines = [template.contours[name] for name in ("lips_inner_upper", "lips_inner_lower")]
    gap = np.array([line[len(line) // 2] for line in lines], "<u4")
    return gap.tobytes() + np.round(255 * rows[split.sources]).astype(np.uint8).tobytes()


def performance(track: Path) -> dict[str, Any]:
    """track.json with its numbers in rows: weights (f, 52) in ARKit's order, poses (f, 12), head angles (f, 3)."""
    try:
        about = json.loads(track.read_text(encoding="utf-8"))
        frames = about["frames"]
        poses = np.array([frame["pose"] for frame in frames])
        return {
            "name": about["video"],
            "fps": about["fps"],
            "size": about["image_size"],
            "focal": about["intrinsics"]["K"][1][1],
            "times": [frame["time"] for frame in frames],
            "quality": [round(frame["quality"], 3) for frame in frames],
            "weights": [[round(frame["weights"].get(name, 0), 4) for name in ARKIT_NAMES] for frame in frames],
            "poses": np.round(poses[:, :3].reshape(len(frames), 12), 6).tolist(),
            "angles": np.round(np.radians([head_angles(pose[:3, :3]) for pose in poses]), 5).tolist(),
        }
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(f"{track} is damaged ({error}): run stage avatar again") from error


def transferred(project: Project, template: Template) -> bytes:
    """The rig of stage blendshapes, transferred from the template, as a GLB with the same meshes and no pictures."""
    rig = project.read("blendshapes", Blendshapes)
    pixel = cv2.imencode(".png", _PIXEL)[1].tobytes()
    grey = cv2.imencode(".png", _PIXEL[..., 0])[1].tobytes()
    shapes = avatar_glb.Rig(rig.neutral, rig.deltas, rig.eye_centres, _LEAST_MOTION, _LEAST_TURN)
    return avatar_glb.write(template, shapes, avatar_glb.Pictures(pixel, pixel, pixel, grey), {}).glb


def details_of(folder: Path) -> dict[str, Content]:
    """What the shader needs of avatar/details; nothing where a part of it is missing."""
    try:
        about = json.loads((folder / "details.json").read_text(encoding="utf-8"))
        names = ["details.json", about["positions"]["file"], *(row["file"] for row in about["weights"])]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    here = {path.name: path for path in folder.iterdir() if path.is_file() and not path.is_symlink()}
    if any(name not in here for name in names):
        return {}
    return {f"data/details/{name}": here[name] for name in names}


def _opened(path: Path) -> Gltf:
    try:
        return read_glb(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}): run stage avatar again") from error


def _light(project: Project) -> list[list[float]] | None:
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


def _side(picture: bytes) -> int:
    """Pixels along the longer side, from a picture's header; 0 for none."""
    try:
        with Image.open(io.BytesIO(picture)) as image:
            return max(image.size)
    except OSError:
        return 0

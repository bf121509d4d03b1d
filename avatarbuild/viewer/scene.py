"""
What the viewer's page is made of: address -> content, from a project's finished stages.

The page itself is small; head and eyes with small pictures come first, then avatar.glb with an albedo of 2048 texels;
the full albedo, the other rig and the video follow when they are asked for. Nothing heavy is imported before an address
is asked for that needs it: the server answers at once.
"""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avatarbuild.errors import InputError
from avatarbuild.project import Project
from avatarbuild.viewer.server import LIBRARY, Content, library, page_files

if TYPE_CHECKING:
    from avatarbuild.formats.gltf import Gltf
    from avatarbuild.template import Template

SCENE_VERSION = 1
PAGE = (
    *("index.html", "viewer.css", "context.js", "main.js", "stage.js", "first.js", "environment.js", "surface.js"),
    *("controls.js", "avatar.js", "details.js", "light.js", "panel.js", "keys.js", "timeline.js", "shapes.js"),
    *("record.js", "live.js", "surface.vert.glsl", "surface.frag.glsl", "LICENSE-three.js.txt"),
)
_SYNTHESIS = Path(__file__).parents[1] / "details" / "synthesis.glsl"


def files(project: Project, *, live: int | None) -> dict[str, Content]:
    """
    The page of a project with a finished avatar. live: the UDP port where messages are heard; None: nowhere.

    Raises InputError where there is no avatar, or three.js is not installed.
    """
    folder = project.folder("avatar")
    glb = folder / "avatar.glb"
    if not glb.is_file():
        raise InputError(f"{project.root} has no avatar yet: finish `avatarbuild run` first")
    made = _Made(project, glb)
    table: dict[str, Content] = {**page_files(*PAGE), "synthesis.glsl": _SYNTHESIS, LIBRARY: library()}
    about: dict[str, Any] = {
        "version": SCENE_VERSION,
        "title": project.root.resolve().name.removesuffix(".avatar"),
        "details": False,
        "performance": False,
        "video": False,
        "transferred": False,
        "live": live,
        "missing": {},
    }
    table["data/first.glb"] = made.first
    table["data/avatar.glb"] = made.lighter
    table["data/albedo.jpg"] = made.albedo
    table["data/traits.bin"] = made.traits
    details = details_of(folder / "details")
    table |= details
    about["details"] = bool(details)
    if not details:
        about["missing"]["details"] = "This avatar has no details that follow the expression: no video showed any."
    track = folder / "track.json"
    about["performance"] = track.is_file()
    if about["performance"]:
        table["data/performance.json"] = lambda: made.performance(track)
        video = video_of(project)
        about["video"] = video is not None
        if video is not None:
            table["data/video.mp4"] = lambda: made.video(video)
        else:
            about["missing"]["video"] = "The video is no longer where project.toml says that the capture is."
    else:
        about["missing"]["performance"] = "No video was tracked: load a table of weights, or use live input."
    if project.stamp("blendshapes") is not None:
        about["transferred"] = True
        table["data/transferred.glb"] = made.transferred
    table["data/scene.json"] = lambda: json.dumps(about | made.about()).encode()
    return table


class _Made:
    """The parts of a page that are made when they are asked for, by modules that are imported only then."""

    def __init__(self, project: Project, glb: Path) -> None:
        self.project, self._glb = project, glb

    @cached_property
    def glb(self) -> Gltf:
        from avatarbuild.viewer import start

        return start.opened(self._glb)

    @cached_property
    def template(self) -> Template:
        return self.project.template().load()

    def first(self) -> bytes:
        from avatarbuild.viewer import start

        return start.first(self.glb)

    def lighter(self) -> Path | bytes:
        from avatarbuild.viewer import start

        return start.lighter(self.glb, self._glb)

    def albedo(self) -> bytes:
        from avatarbuild.viewer import start

        return start.albedo(self.glb)

    def about(self) -> dict[str, Any]:
        """Of scene.json: whether albedo.jpg is larger than what avatar.glb has on the page, and the photos' light."""
        from avatarbuild.viewer import start

        return {"albedo": start.is_large(self.albedo()), "light": start.photo_light(self.project)}

    def traits(self) -> bytes:
        from avatarbuild.viewer import traits

        return traits.traits(self.template, self.glb)

    def performance(self, track: Path) -> bytes:
        from avatarbuild.viewer import performance

        return json.dumps(performance.performance(track), separators=(",", ":")).encode()

    def transferred(self) -> bytes:
        from avatarbuild.viewer import transferred

        return transferred.transferred(self.project, self.template)

    def video(self, source: Path) -> Path:
        from avatarbuild.viewer import film

        return film.for_page(source, self.project.clip_folder)


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


def video_of(project: Project) -> Path | None:
    """The video that stage tracking read; None where it is gone or none was tracked."""
    try:
        about = json.loads((project.folder("tracking") / "clip.json").read_text(encoding="utf-8"))
        path = project.root / project.settings()["capture"] / about["video"]
    except (OSError, ValueError, KeyError, TypeError, InputError):
        return None
    return path if about["video"] and path.is_file() else None

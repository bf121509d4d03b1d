"""`avatarbuild view`: the avatar's page, on this machine's own address or as a folder for any web server."""

from __future__ import annotations

import logging
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

from avatarbuild.errors import InputError
from avatarbuild.project import Project
from avatarbuild.viewer import scene, server

log = logging.getLogger(__name__)

_MARK = "avatar-page.txt"  # says that a folder is ours and may be written again
_ABOUT = """\
The page of an avatar, made by `avatarbuild view --export`. Any web server can serve this folder; opened as a file it
stays empty, since browsers read no modules from files. Try: python -m http.server --bind 127.0.0.1

three.js holds three.js with its GLTF loader and orbit controls, unchanged; its licence is in LICENSE-three.js.txt.
"""


def view(project: Project, port: int, udp: int, open_browser: bool, told: Callable[[str], None]) -> None:
    """Serves the page until Ctrl-C. udp: the port of live input, 0 for none. Raises InputError as `scene.files`."""
    heard = udp or None
    table = scene.files(project, live=heard)
    warm(table)
    app = server.application(table, _live_routes(heard))
    server.serve(app, port, open_browser=open_browser, told=told)


def export(project: Project, folder: Path, told: Callable[[str], None]) -> int:
    """
    Writes the same page into a folder, without live input; returns its bytes.

    Raises InputError where the folder holds something else or cannot be written.
    """
    table = scene.files(project, live=None)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file: name a folder with --export")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / _MARK).is_file():
        raise InputError(f"{folder} holds other files: name a new folder with --export")
    table[_MARK] = _ABOUT.encode()
    total = 0
    try:
        for address, content in table.items():
            if address == "data/video.mp4":
                told("the video is made smaller for the page …")
            made = content() if callable(content) else content
            place = folder / address
            place.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(made, Path):
                shutil.copyfile(made, place)
            else:
                place.write_bytes(made)
            total += place.stat().st_size
    except OSError as error:
        raise InputError(
            f"{folder} cannot be written ({error.strerror or error}): name another with --export"
        ) from None
    return total


def warm(table: dict[str, server.Content]) -> None:
    """Begins with what the first picture needs while the browser still starts; the table keeps what is made."""
    make = table["data/first.glb"]
    assert callable(make)
    table["data/first.glb"] = kept = server.once(make)

    def begin() -> None:
        try:
            kept()
        except InputError as error:  # the page says so when it asks
            log.warning("%s", error)

    threading.Thread(target=begin, daemon=True).start()


def _live_routes(heard: int | None) -> list[server.BaseRoute]:
    if heard is None:
        return []
    from avatarbuild.viewer import live

    return [live.route(heard)]

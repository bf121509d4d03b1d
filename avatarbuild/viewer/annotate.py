"""
`avatarbuild annotate`: the page on which the user puts contours and points right; docs/annotate.md tells its use.

It reads the project and writes one file, corrections.json. What the page sends is that file's own content, checked by
the file's own reader before anything is written. Somebody else's change in the meantime is not overwritten: every
content has a tag, and who saves names the one that he began from.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from avatarbuild.errors import InputError
from avatarbuild.formats import video
from avatarbuild.formats.corrections import Corrections, corrections_bytes, read_corrections
from avatarbuild.project import Project
from avatarbuild.tracking.full_rate import Sightings
from avatarbuild.viewer import annotate_subject as subjects
from avatarbuild.viewer import server
from avatarbuild.viewer.annotate_flow import LiveFlow
from avatarbuild.viewer.annotate_subject import Subject

PAGE = Path(__file__).parent / "annotate_page"
FILES = ("index.html", "annotate.css", "main.js", "store.js", "view.js", "photo.js", "frames.js", "pictures.js")
MOST_BYTES = 4_000_000  # of what a page may send

Stale = Callable[[Corrections], list[str]]
"""The stages that the next run would redo with these corrections."""


def annotate(project: Project, stale: Stale, port: int, open_browser: bool, told: Callable[[str], None]) -> None:
    """
    Serves the page until Ctrl-C.

    Raises InputError where there is nothing to correct, corrections.json is damaged, or the port is taken.
    """
    project.corrections()
    server.serve(page(project, stale), port, open_browser=open_browser, told=told)


def page(project: Project, stale: Stale) -> Starlette:
    """The page's server."""
    subject = subjects.open_subject(project)
    flow = _flow(project, subject)
    photos = _photo_names(project)
    saving = threading.Lock()

    @lru_cache(maxsize=256)
    def picture(kind: str, which: int, part: str) -> bytes | None:
        if part not in subjects.PARTS:
            return None
        if kind == "photo" and subject.portrait is not None:
            return subjects.piece(subject.portrait.image, subject.portrait.box, part)
        if kind == "frame" and subject.footage is not None:
            rows = np.flatnonzero(subject.footage.clip.processed == which)
            if len(rows):
                row = int(rows[0])
                return subjects.piece(subject.footage.clip.frames.images[row], subject.footage.box[row], part)
        return None

    async def send_picture(request: Request) -> Response:
        which = request.path_params.get("which", 0)
        data = await run_in_threadpool(picture, request.path_params["kind"], which, request.path_params["part"])
        return Response(data, media_type="image/jpeg") if data else PlainTextResponse("no such picture", 404)

    def state() -> dict[str, Any]:
        content, tag = _content(project)
        about = subjects.described(subject)
        about |= {"corrections": json.loads(content), "tag": tag, "live": flow is not None and not flow.fault}
        return about | {"stale": stale(project.corrections())}

    def freshness() -> dict[str, Any]:
        return {"tag": _content(project)[1], "stale": stale(project.corrections())}

    async def send_state(request: Request) -> Response:
        try:
            return JSONResponse(await run_in_threadpool(state if request.url.path == "/state" else freshness))
        except InputError as error:
            return _fault(409, str(error))

    def save(told: Corrections, began_from: str) -> Response:
        with saving:
            if _content(project)[1] != began_from:
                return _fault(409, "corrections.json has been changed elsewhere: load the page again")
            try:
                project.save_corrections(told)
            except InputError as error:
                return _fault(507, str(error))
            return JSONResponse({"tag": _content(project)[1], "stale": stale(told)})

    async def receive(request: Request) -> Response:
        told = read_corrections(await _body(request), "what was sent")
        subjects.require_known(told, subject, photos)
        return await run_in_threadpool(save, told, request.headers.get("if-match", ""))

    def carry(told: Corrections, frame: int) -> dict[str, Any]:
        assert flow is not None
        assert subject.footage is not None
        flow.look(frame, frozenset(told.video))
        shown = set(subject.footage.clip.processed.tolist())
        out: dict[int, dict[int, list[float]]] = {}
        for i, (pixels, sure) in flow.carried(told.video).items():
            if i in shown:
                known = [int(k) for k in np.flatnonzero(sure) if k not in told.video.get(i, {})]
                rows = np.column_stack([pixels - 0.5, sure]).round(2)
                out[i] = {k: rows[k].tolist() for k in known}
        return {"frames": out, "ready": flow.ready(frame), "fault": flow.fault}

    async def propagate(request: Request) -> Response:
        body = await _body(request)
        told = read_corrections(body, "what was sent")
        subjects.require_known(told, subject, photos)
        frame = request.path_params["which"]
        if flow is None or subject.footage is None or frame >= len(subject.footage.clip.times):
            return _fault(404, "there is no such frame in a video at hand")
        return JSONResponse(await run_in_threadpool(carry, told, frame))

    routes = [
        Route("/state", send_state),
        Route("/freshness", send_state),
        Route("/corrections", _refusing(receive), methods=["PUT"]),
        Route("/propagate/{which:int}", _refusing(propagate), methods=["POST"]),
        Route("/picture/{kind}/{part}", send_picture),
        Route("/picture/{kind}/{which:int}/{part}", send_picture),
    ]
    return server.application({name: PAGE / name for name in FILES}, routes)


def _flow(project: Project, subject: Subject) -> LiveFlow | None:
    """None where the video is not at hand."""
    source = project.root / project.settings().get("capture", "")
    path = subjects.video_path(source, subject)
    if path is None:
        subject.notes["flow"] = "The video is not where it was: points are not carried to other frames on this page."
        return None
    assert subject.footage is not None
    clip, seen = subject.footage.clip, subject.footage.seen
    sightings = Sightings(clip.processed[seen], clip.frames.landmarks[seen])
    return LiveFlow(clip.times, sightings.expected, partial(video.decode_frames, path))


def _photo_names(project: Project) -> list[str]:
    folder = project.folder("capture") / "photos"
    return [str(name) for name in json.loads((folder / "views.json").read_text(encoding="utf-8"))["names"]]


def _content(project: Project) -> tuple[bytes, str]:
    """What is saved, and its tag."""
    try:
        saved = project.corrections_file.read_bytes()
    except FileNotFoundError:
        saved = b""
    content = corrections_bytes(read_corrections(saved, str(project.corrections_file)) if saved else Corrections())
    return content, hashlib.sha256(saved).hexdigest()[:16]


class _TooLarge(Exception):
    pass


async def _body(request: Request) -> bytes:
    data = bytearray()
    async for part in request.stream():
        data += part
        if len(data) > MOST_BYTES:
            raise _TooLarge
    return bytes(data)


def _refusing(answer: Callable[[Request], Any]) -> Callable[[Request], Any]:
    """The answer, or one line that says what is wrong with what was sent."""

    async def checked(request: Request) -> Response:
        if request.headers.get("content-type", "").split(";")[0].strip() != "application/json":
            return _fault(415, "send JSON")
        try:
            return await answer(request)
        except _TooLarge:
            return _fault(413, f"more than {MOST_BYTES} bytes were sent")
        except InputError as error:
            return _fault(400, str(error))

    return checked


def _fault(status: int, line: str) -> Response:
    return JSONResponse({"fault": line}, status_code=status)

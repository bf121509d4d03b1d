"""
A page on 127.0.0.1: which addresses there are, who may ask, how it starts and ends.

The files of a page are a table, address -> content. Nothing that a request says becomes a path, so that nothing outside
the table can be read, whatever the address holds. Routes of a page's own (POST, WebSocket) come beside the table.

Who may ask: requests whose Host is this server's, from pages of this server. A page elsewhere that makes the browser
ask (or a name that somebody lets point to 127.0.0.1) gets 403.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import mimetypes
import socket
import threading
import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from avatarbuild.errors import InputError

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
PAGES = Path(__file__).parent / "pages"  # our own HTML, CSS and modules
LIBRARY = "three.js"  # the address of three.js beside a page

# a file, bytes, or what makes one of them when it is first asked for
Made = Path | bytes
Content = Path | bytes | Callable[[], Made]

_NAMES = ("127.0.0.1", "localhost")
_AT_ONCE = 50_000_000  # bytes of a file that is sent in one piece; videos are asked for in ranges
_TYPES = {
    ".js": "text/javascript",
    ".glsl": "text/plain",
    ".glb": "model/gltf-binary",
    ".bin": "application/octet-stream",
}
_HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' blob: data:; "
        "media-src 'self' blob:; connect-src 'self' blob: ws://127.0.0.1:* ws://localhost:*; base-uri 'none'; "
        "form-action 'none'; frame-ancestors 'none'"
    ),
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
}


def library() -> Path:
    """
    The one ES module with three.js, its GLTF loader and orbit controls, from the wheel `nicegui`.

    Raises InputError where it is not installed.
    """
    found = importlib.util.find_spec("nicegui")  # finds the folder without importing the package
    for folder in (found.submodule_search_locations or []) if found else []:
        path = Path(folder) / "elements" / "scene" / "dist" / "index.js"
        if path.is_file():
            return path
    raise InputError("three.js, which the viewer draws with, is not installed: pip install 'nicegui>=3,<4'")


def page_files(*names: str) -> dict[str, Path]:
    """Address -> file of our own pages: the names as they lie in the folder `pages`."""
    return {name: PAGES / name for name in names}


def application(files: Mapping[str, Content], routes: Sequence[BaseRoute] = ()) -> Starlette:
    """
    The server of a page. files: address without its leading '/', like 'data/avatar.glb', -> content; 'index.html' is
    also '/'. Files answer ranges. `routes` (Starlette's) come first; the guard stands before all of them.
    """
    table = [Route("/" + address, _answer(address, content)) for address, content in files.items()]
    if "index.html" in files:
        table.append(Route("/", _answer("index.html", files["index.html"])))
    app = Starlette(routes=[*routes, *table])
    app.add_middleware(Guard)
    return app


class Guard:
    """Lets requests through whose Host, and Origin if there is one, are this server's; adds the headers of safety."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        fault = refusal(scope)
        if fault and scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": fault})
            return
        if fault:
            await PlainTextResponse(fault, status_code=403)(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *((k.encode(), v.encode()) for k, v in _HEADERS.items())]
            await send(message)

        await self.app(scope, receive, with_headers)


def refusal(scope: Scope) -> str:
    """Why a request is refused; '' where it is not."""
    port = scope["server"][1]
    ours = {f"{name}:{port}" for name in _NAMES} | (set(_NAMES) if port == 80 else set())
    headers = [(name.decode("latin-1").lower(), value.decode("latin-1")) for name, value in scope["headers"]]
    hosts = [value.lower() for name, value in headers if name == "host"]
    if len(hosts) != 1 or hosts[0] not in ours:
        return "this server answers on 127.0.0.1 only"
    for name, value in headers:
        if name == "origin":
            parts = urlsplit(value.lower())
            if parts.scheme != "http" or parts.netloc not in ours:
                return "this server answers its own pages only"
    told = dict(headers)
    # another site's page that embeds something of ours; a link to the page itself is a navigation
    if told.get("sec-fetch-site") in ("cross-site", "same-site") and told.get("sec-fetch-mode") != "navigate":
        return "this server answers its own pages only"
    return ""


def serve(app: ASGIApp, port: int = 0, *, open_browser: bool = True, told: Callable[[str], None] = log.info) -> None:
    """
    Answers on 127.0.0.1 until Ctrl-C; `told` gets the page's address once it answers. port 0: any free one.

    Raises InputError where the port is taken.
    """
    with contextlib.closing(_bound(port)) as bound:
        address = f"http://{HOST}:{bound.getsockname()[1]}/"

        def started() -> None:
            told(address)
            if open_browser:
                threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()

        with contextlib.suppress(KeyboardInterrupt):
            _Server(_config(app), started).run(sockets=[bound])


@contextlib.contextmanager
def serving(app: ASGIApp, port: int = 0) -> Iterator[str]:
    """The same in a thread of its own: gives the page's address, ends with the block."""
    with contextlib.closing(_bound(port)) as bound:
        up = threading.Event()
        server = _Server(_config(app), up.set)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]}, daemon=True)
        thread.start()
        try:
            if not up.wait(20):
                raise RuntimeError("the server of the page does not start")
            yield f"http://{HOST}:{bound.getsockname()[1]}/"
        finally:
            server.should_exit = True
            thread.join(20)


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, started: Callable[[], None]) -> None:
        super().__init__(config)
        self._told_start = started

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._told_start()


def _config(app: ASGIApp) -> uvicorn.Config:
    quiet: dict[str, Any] = {"log_config": None, "log_level": "warning", "access_log": False, "server_header": False}
    quick: dict[str, Any] = {"loop": "asyncio", "lifespan": "off"}  # to start; a faster loop would gain nothing here
    # an open page keeps its connections: Ctrl-C does not wait for it
    return uvicorn.Config(app, proxy_headers=False, timeout_graceful_shutdown=1, **quiet, **quick)


def _bound(port: int) -> socket.socket:
    bound = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((HOST, port))
    except (OSError, OverflowError) as error:
        bound.close()
        why = getattr(error, "strerror", None) or error
        raise InputError(f"port {port} cannot be used ({why}): name another with --port, or none") from None
    return bound


def once(make: Callable[[], Made]) -> Callable[[], Made]:
    """`make`, called at most once whoever asks; a fault is not kept."""
    made: list[Made] = []
    lock = threading.Lock()

    def ready() -> Made:
        with lock:
            if not made:
                made.append(make())
        return made[0]

    return ready


def _answer(address: str, content: Content) -> Callable[[Request], Any]:
    kind = media_type(address)
    ready = once(content) if callable(content) else None

    async def answer(request: Request) -> Response:
        try:
            held = content if ready is None else await run_in_threadpool(ready)
        except InputError as error:
            return PlainTextResponse(str(error), status_code=404)
        if isinstance(held, Path):
            if not held.is_file():
                return PlainTextResponse(f"{address} is gone", status_code=404)
            if kind.startswith("video/") or held.stat().st_size > _AT_ONCE:
                return FileResponse(held, media_type=kind)
            held = held.read_bytes()  # many small files: a thread for each read would take longer than all of them
        return Response(held, media_type=kind)

    return answer


def media_type(address: str) -> str:
    """The MIME type that an address's ending says."""
    suffix = Path(address).suffix.lower()
    return _TYPES.get(suffix) or mimetypes.guess_type(address)[0] or "application/octet-stream"

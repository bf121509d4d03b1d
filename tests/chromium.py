"""A page in headless Chromium with WebGL 2 in software, where a browser is at hand."""

from __future__ import annotations

import http.server
import os
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path

import pytest

VARIABLE = "AVATARBUILD_CHROMIUM"
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome-headless-shell")
OPTIONS = (
    *("--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync"),
    *("--disable-component-update", "--disable-dev-shm-usage", "--hide-scrollbars", "--disable-extensions"),
)
_TYPES = {".html": "text/html; charset=utf-8", ".png": "image/png", ".json": "application/json"}


def answer(files: dict[str, bytes], seconds: float = 150) -> bytes:
    """
    What index.html of `files` posts to /answer; AssertionError with its text if it posts to /fault instead. Skips the
    test without a browser; on CI that is a failure.
    """
    browser = program()
    given: list[tuple[str, bytes]] = []
    done = threading.Event()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            name = self.path.split("?")[0].lstrip("/") or "index.html"
            if name not in files:
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Type", _TYPES.get(Path(name).suffix, "text/plain; charset=utf-8"))
            self.end_headers()
            self.wfile.write(files[name])

        def do_POST(self) -> None:
            given.append((self.path, self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()
            done.set()

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        address = f"http://127.0.0.1:{server.server_port}/"
        command = [browser, *OPTIONS, f"--user-data-dir={folder}", "--remote-debugging-port=0", address]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            assert done.wait(seconds), f"{browser} gave no answer within {seconds} s"
        finally:
            process.terminate()
            process.wait(20)
            server.shutdown()
    path, data = given[0]
    assert path == "/answer", data.decode(errors="replace")
    return data


def program() -> str:
    """The browser to start. Skips the test without one; on CI that is a failure."""
    named = os.environ.get(VARIABLE)
    for name in [named] if named else _NAMES:
        found = shutil.which(name)
        if found:
            return found
    message = f"no Chromium: install it, or name its program in {VARIABLE}"
    if os.environ.get("CI", "").lower() in ("true", "1"):
        pytest.fail(message)
    pytest.skip(message)

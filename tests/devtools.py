"""A page in headless Chromium under remote control: evaluate, press, take pictures, hear what the console says."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import chromium
from websockets.sync.client import ClientConnection, connect


class Page:
    """One page over the DevTools protocol. `faults`: errors and warnings of its console and exceptions, as text."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._numbers = socket, itertools.count(1)
        self.faults: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, seconds: float = 60, **values: Any) -> dict[str, Any]:
        """A command's result. Raises AssertionError with the browser's words where it fails."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": values}))
        end = time.monotonic() + seconds
        while True:
            message = json.loads(self._socket.recv(timeout=max(end - time.monotonic(), 0.01)))
            if message.get("id") == number:
                assert "error" not in message, f"{method}: {message['error']}"
                return message["result"]
            self._hear(message)

    def _hear(self, message: dict[str, Any]) -> None:
        told = message.get("params", {})
        if message["method"] == "Runtime.exceptionThrown":
            about = told["exceptionDetails"]
            self.faults.append(about.get("exception", {}).get("description", about["text"]))
        elif message["method"] == "Runtime.consoleAPICalled" and told["type"] in ("error", "warning", "assert"):
            self.faults.append(" ".join(str(part.get("value", part.get("description"))) for part in told["args"]))
        elif message["method"] == "Log.entryAdded" and told["entry"]["level"] == "error":
            self.faults.append(f"{told['entry']['text']} {told['entry'].get('url', '')}")

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def evaluate(self, expression: str, seconds: float = 60) -> Any:
        """The value of JavaScript; promises are waited for. AssertionError with its exception's text."""
        made = self.call(
            "Runtime.evaluate", seconds, expression=expression, awaitPromise=True, returnByValue=True, userGesture=True
        )
        fault = made.get("exceptionDetails")
        assert fault is None, fault.get("exception", {}).get("description", fault["text"])
        return made["result"].get("value")

    def wait(self, expression: str, seconds: float = 60) -> Any:
        """The first true value of an expression that is asked for again and again."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            with contextlib.suppress(AssertionError):  # between two documents there is nothing to ask
                if found := self.evaluate(expression):
                    return found
            time.sleep(0.05)
        raise AssertionError(f"not true within {seconds} s: {expression}; the console: {self.faults}")

    def size(self, width: int, height: int) -> None:
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def press(self, key: str) -> None:
        """One key, by the name that KeyboardEvent.key gives it."""
        text = {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """kind: 'mousePressed', 'mouseMoved', 'mouseReleased', 'mouseWheel'."""
        button = {"button": "left", "clickCount": 1} if kind in ("mousePressed", "mouseReleased") else {}
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **{**button, **more})

    def picture(self) -> bytes:
        """A PNG of what the window shows."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])


@contextlib.contextmanager
def browser(*options: str) -> Iterator[Page]:
    """An empty page of a browser of its own. Skips the test without one; on CI that is a failure."""
    program = chromium.program()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        flags = (*chromium.OPTIONS, *options, f"--user-data-dir={folder}", "--remote-debugging-port=0", "about:blank")
        process = subprocess.Popen([program, *flags], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            with connect(_address(Path(folder), process), max_size=None, compression=None) as socket:
                yield Page(socket)
        finally:
            process.terminate()
            process.wait(20)


def _address(folder: Path, process: subprocess.Popen[bytes]) -> str:
    """The WebSocket of the first page."""
    import urllib.request

    end = time.monotonic() + 30
    while time.monotonic() < end:
        assert process.poll() is None, "the browser ended at once"
        with contextlib.suppress(OSError, ValueError, IndexError):
            port = (folder / "DevToolsActivePort").read_text().split()[0]
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=5) as answer:
                pages = [target for target in json.load(answer) if target["type"] == "page"]
            return pages[0]["webSocketDebuggerUrl"]
        time.sleep(0.05)
    raise AssertionError("the browser does not open its DevTools within 30 s")

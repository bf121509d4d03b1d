"""Live input: a UDP port of this machine is listened to while a page asks for it; its WebSocket gets what comes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from typing import Any

from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from avatarbuild.viewer.osc import State
from avatarbuild.viewer.server import HOST

log = logging.getLogger(__name__)

PORT = 39539  # where VMC's performers send to
_PICTURES = 60  # messages a second that a page gets at most


class Ear(asyncio.DatagramProtocol):
    """Hears packets; `news` is set while there is something that the page has not seen."""

    def __init__(self) -> None:
        self.state, self.news = State(), asyncio.Event()

    def datagram_received(self, data: bytes, address: Any) -> None:
        if self.state.hear(data):
            self.news.set()


def route(port: int) -> WebSocketRoute:
    """The address `/live`: what is heard on 127.0.0.1:port, as JSON {"weights": {name: 0 … 1}, "head": quaternion}."""

    async def live(socket: WebSocket) -> None:
        await socket.accept()
        loop = asyncio.get_running_loop()
        try:
            carrier, ear = await loop.create_datagram_endpoint(Ear, local_addr=(HOST, port))
        except OSError as error:
            why = (
                f"UDP port {port} cannot be listened to ({error.strerror or error}): close what uses it, or --live PORT"
            )
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await socket.send_text(json.dumps({"told": why}))
                await socket.close()
            return
        await socket.send_text(json.dumps({"told": f"Listening for VMC and OSC on UDP {HOST}:{port}"}))
        sender = asyncio.create_task(_send(socket, ear))
        try:
            while True:
                await socket.receive_text()  # a page says nothing; this ends when it goes
        except (WebSocketDisconnect, RuntimeError):
            pass
        finally:
            sender.cancel()
            carrier.close()

    return WebSocketRoute("/live", live)


async def _send(socket: WebSocket, ear: Ear) -> None:
    while True:
        await ear.news.wait()
        ear.news.clear()
        message = {
            "weights": {name: round(value, 4) for name, value in ear.state.weights.items()},
            "head": ear.state.head,
        }
        try:
            await socket.send_text(json.dumps(message))
        except (WebSocketDisconnect, RuntimeError):
            return
        await asyncio.sleep(1 / _PICTURES)

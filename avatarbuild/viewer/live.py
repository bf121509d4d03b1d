"""Live input: a UDP port of this machine is listened to while pages ask for it; their WebSockets get what comes."""

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

_PICTURES = 60  # messages a second that a page gets at most
_GONE = (WebSocketDisconnect, RuntimeError)


class Ear(asyncio.DatagramProtocol):
    """Hears packets for every page that listens; a page's event is set while there is news for it."""

    def __init__(self, port: int) -> None:
        self.port, self.state = port, State()
        self.pages: set[asyncio.Event] = set()
        self._carrier: asyncio.DatagramTransport | None = None

    def datagram_received(self, data: bytes, address: Any) -> None:
        if self.state.hear(data):
            for news in self.pages:
                news.set()

    async def join(self) -> asyncio.Event:
        """A page's event; the first page opens the port. Raises OSError where another program has it."""
        if self._carrier is None:
            loop = asyncio.get_running_loop()
            self._carrier, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=(HOST, self.port))
        news = asyncio.Event()
        self.pages.add(news)
        return news

    def leave(self, news: asyncio.Event) -> None:
        """The last page closes the port."""
        self.pages.discard(news)
        if not self.pages and self._carrier is not None:
            self._carrier.close()
            self._carrier, self.state = None, State()


def route(port: int) -> WebSocketRoute:
    """The address `/live`: what is heard on 127.0.0.1:port, as JSON {"weights": {name: 0 … 1}, "head": quaternion}."""
    ear = Ear(port)

    async def live(socket: WebSocket) -> None:
        await socket.accept()
        try:
            news = await ear.join()
        except OSError as error:
            why = (
                f"UDP port {port} cannot be listened to ({error.strerror or error}): close what uses it, or --live PORT"
            )
            with contextlib.suppress(*_GONE):
                await socket.send_text(json.dumps({"told": why}))
                await socket.close()
            return
        sender = asyncio.create_task(_send(socket, ear, news))
        try:
            while True:
                await socket.receive_text()  # a page says nothing; this ends when it goes
        except _GONE:
            pass
        finally:
            sender.cancel()
            ear.leave(news)

    return WebSocketRoute("/live", live)


async def _send(socket: WebSocket, ear: Ear, news: asyncio.Event) -> None:
    with contextlib.suppress(*_GONE):
        await socket.send_text(json.dumps({"told": f"Listening for VMC and OSC on UDP {HOST}:{ear.port}"}))
        while True:
            await news.wait()
            news.clear()
            weights = {name: round(value, 4) for name, value in ear.state.weights.items()}
            await socket.send_text(json.dumps({"weights": weights, "head": ear.state.head}))
            await asyncio.sleep(1 / _PICTURES)

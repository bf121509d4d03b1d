"""The server of local pages: who may ask, what can be read, ranges, ports; live input from UDP to the page."""

from __future__ import annotations

import http.client
import json
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from avatarbuild.errors import InputError
from avatarbuild.viewer import live, server
from avatarbuild.viewer.osc import State, messages

SECRET = b"not for the page"


async def _told(request: Request) -> Response:
    return PlainTextResponse((await request.body()).decode())


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, int, Path]]:
    """Host, port and folder of a server with a few addresses; beside its files lies one that it does not serve."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "secret.txt").write_bytes(SECRET)
    (folder / "clip.mp4").write_bytes(bytes(range(256)) * 40)
    (folder / "gone.bin").write_bytes(b"x")
    calls: list[int] = []

    def made() -> bytes:
        calls.append(1)
        return b"%d" % len(calls)

    def refused() -> bytes:
        raise InputError("this cannot be made")

    table: dict[str, server.Content] = {
        "index.html": b"<p>page",
        "data/clip.mp4": folder / "clip.mp4",
        "data/gone.bin": folder / "gone.bin",
        "data/made.json": made,
        "data/refused.json": refused,
    }
    app = server.application(table, [Route("/told", _told, methods=["POST"]), live.route(_free_udp())])
    (folder / "gone.bin").unlink()
    with server.serving(app) as address:
        parts = urlsplit(address)
        assert parts.hostname == "127.0.0.1"
        yield parts.hostname, parts.port or 0, folder


def _free_udp() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def _ask(
    place: tuple[str, int, Path], path: str, method: str = "GET", body: bytes | None = None, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    """The path goes out letter by letter, as no browser would send it."""
    link = http.client.HTTPConnection(place[0], place[1], timeout=20)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    link.putrequest(method, path, skip_host="Host" in named, skip_accept_encoding=True)
    for name, value in named.items():
        link.putheader(name, value)
    if body is not None:
        link.putheader("Content-Length", str(len(body)))
    link.endheaders(body)
    answer = link.getresponse()
    found = answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
    link.close()
    return found


def test_page_and_files(place):
    for path in ("/", "/index.html"):
        status, headers, body = _ask(place, path)
        assert (status, body) == (200, b"<p>page")
        assert headers["content-type"].startswith("text/html")
        assert headers["x-content-type-options"] == "nosniff"
        assert "default-src 'none'" in headers["content-security-policy"]
    assert _ask(place, "/data/made.json")[2] == _ask(place, "/data/made.json")[2] == b"1"  # made once
    status, _, body = _ask(place, "/data/refused.json")
    assert (status, body) == (404, b"this cannot be made")
    assert _ask(place, "/data/gone.bin")[0] == 404
    assert _ask(place, "/index.html", "POST", b"")[0] == 405
    assert _ask(place, "/told", "POST", b"words")[2] == b"words"


def test_a_video_answers_ranges(place):
    whole = (place[2] / "clip.mp4").read_bytes()
    status, headers, body = _ask(place, "/data/clip.mp4")
    assert (status, body) == (200, whole)
    assert headers["accept-ranges"] == "bytes"
    status, headers, body = _ask(place, "/data/clip.mp4", Range="bytes=100-199")
    assert (status, body) == (206, whole[100:200])
    assert headers["content-range"] == f"bytes 100-199/{len(whole)}"
    assert _ask(place, "/data/clip.mp4", Range="bytes=-5")[2] == whole[-5:]
    assert _ask(place, "/data/clip.mp4", Range="bytes=999999-")[0] == 416


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:{port}",
        "127.0.0.1",
        "127.0.0.1:1",
        "localhost.evil.example:{port}",
        "",
        "[::1]:{port}",
    ],
)
def test_foreign_hosts_are_refused(place, host):
    assert _ask(place, "/", Host=host.format(port=place[1]))[0] in (400, 403)


def test_own_names_are_not(place):
    for host in (f"127.0.0.1:{place[1]}", f"localhost:{place[1]}", f"LOCALHOST:{place[1]}"):
        assert _ask(place, "/", Host=host)[0] == 200
        assert _ask(place, "/", Host=host, Origin=f"http://{host}")[0] == 200


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "https://127.0.0.1:{port}", "http://127.0.0.1:1", "http://127.0.0.1", "file://"],
)
def test_foreign_origins_are_refused(place, origin):
    told = origin.format(port=place[1])
    assert _ask(place, "/", Origin=told)[0] == 403
    assert _ask(place, "/told", "POST", b"words", Origin=told)[0] == 403
    with pytest.raises(InvalidStatus, match="403"):
        connect(f"ws://127.0.0.1:{place[1]}/live", origin=told).close()  # type: ignore[arg-type]


def test_what_another_site_embeds_is_refused(place):
    assert _ask(place, "/data/clip.mp4", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="no-cors")[0] == 403
    assert _ask(place, "/", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate")[0] == 200  # a link
    assert _ask(place, "/data/clip.mp4", Sec_Fetch_Site="same-origin", Sec_Fetch_Mode="cors")[0] == 200


@pytest.mark.parametrize(
    "path",
    [
        "/secret.txt", "/data/secret.txt", "/data/../secret.txt", "/../secret.txt", "/data/%2e%2e/secret.txt",
        "/%2e%2e/%2e%2e/etc/passwd", "/data/..%2fsecret.txt", "/data/..%5csecret.txt", "/data/..\\secret.txt",
        "//etc/passwd", "/data//etc/passwd", "/{folder}/secret.txt", "/data/{folder}/secret.txt", "/file:///etc/passwd",
        "/data/clip.mp4/../../secret.txt", "/data/clip.mp4%00.txt", "/data/%c0%ae%c0%ae/secret.txt", "/data/", "/data",
        "/..;/secret.txt", "/data/....//secret.txt", "/live/../secret.txt", "http://127.0.0.1/secret.txt",
    ],
)  # fmt: skip
def test_nothing_else_can_be_read(place, path):
    try:
        status, _, body = _ask(place, path.format(folder=place[2]))
    except http.client.InvalidURL:
        return
    assert status in (400, 403, 404, 405)
    assert SECRET not in body
    assert b"root:" not in body


def test_the_address_is_of_this_machine_only(place):
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)} - {"127.0.0.1"}
    for address in others:
        if str(address).startswith("127."):
            continue
        with pytest.raises(OSError):
            socket.create_connection((address, place[1]), 2).close()


def test_a_taken_port_is_said(place):
    with pytest.raises(InputError, match=f"port {place[1]} cannot be used"):
        server.serve(server.application({}), place[1], open_browser=False)


# live input


def _osc(address: str, kinds: str, *values: object) -> bytes:
    text = lambda s: s.encode() + b"\0" * (4 - len(s.encode()) % 4)  # noqa: E731
    out = text(address) + text("," + kinds)
    for kind, value in zip(kinds, values, strict=True):
        out += text(str(value)) if kind == "s" else struct.pack({"f": ">f", "i": ">i"}[kind], value)
    return out


def _bundle(*packets: bytes) -> bytes:
    return b"#bundle\0" + bytes(8) + b"".join(struct.pack(">i", len(p)) + p for p in packets)


def test_osc_messages():
    assert list(messages(_osc("/a/b", "sfi", "hé", 0.5, -3))) == [("/a/b", ["hé", 0.5, -3])]
    inner = _bundle(_osc("/one", "f", 1.0), _bundle(_osc("/two", "i", 2)))
    assert [address for address, _ in messages(inner)] == ["/one", "/two"]
    for broken in (
        b"",
        b"/a",
        b"/a\0\0\0,f\0\0",
        b"a\0\0\0,\0\0\0",
        b"#bundle\0",
        inner[:-3],
        _osc("/a", "f", 1.0)[:-1],
    ):
        assert [m for m in messages(broken) if m[0] not in ("/one",)] == []
    deep = _osc("/deep", "f", 1.0)
    for _ in range(30):
        deep = _bundle(deep)
    assert list(messages(deep)) == []


def test_vmc_is_shown_when_it_is_applied():
    state = State()
    assert not state.hear(_osc("/VMC/Ext/Blend/Val", "sf", "JawOpen", 0.4))
    assert not state.hear(_osc("/VMC/Ext/Blend/Val", "sf", "unknown", 0.4))
    assert state.weights == {}
    assert state.hear(_osc("/VMC/Ext/Blend/Apply", ""))
    assert state.weights == pytest.approx({"jawOpen": 0.4})
    assert state.hear(_osc("/face/mouthSmileLeft", "f", 7.0))
    assert state.weights["mouthSmileLeft"] == 1.0
    for bad in (float("nan"), float("inf")):
        assert not state.hear(_osc("/face/jawOpen", "f", bad))
    assert state.hear(_osc("/VMC/Ext/Bone/Pos", "sfffffff", "Head", 0, 0, 0, 0.5, 0.5, 0.5, 0.5))
    assert state.head == (0.5, -0.5, -0.5, 0.5)


def test_from_a_packet_to_the_page():
    port = _free_udp()
    with (
        server.serving(server.application({}, [live.route(port)])) as address,
        connect(f"ws://{urlsplit(address).netloc}/live", origin=address.rstrip("/")) as page,  # type: ignore[arg-type]
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        assert str(port) in json.loads(page.recv(10))["told"]
        sender.sendto(b"\xff\xfe nonsense", ("127.0.0.1", port))
        sender.sendto(_osc("/x/JAWOPEN", "f", 0.25), ("127.0.0.1", port))
        assert json.loads(page.recv(10)) == {"weights": {"jawOpen": 0.25}, "head": None}
        with connect(f"ws://{urlsplit(address).netloc}/live") as second:
            assert str(port) in json.loads(second.recv(10))["told"]
            sender.sendto(_osc("/x/jawOpen", "f", 0.5), ("127.0.0.1", port))
            for each in (page, second):
                assert json.loads(each.recv(10))["weights"] == {"jawOpen": 0.5}


def test_a_port_of_another_program_is_said():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        served = server.serving(server.application({}, [live.route(port)]))
        with served as address, connect(f"ws://{urlsplit(address).netloc}/live") as page:
            assert "cannot be listened to" in json.loads(page.recv(10))["told"]

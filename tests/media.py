"""Photos and videos of every kind that phones and broken copies yield, made for tests."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pillow_heif
from PIL import Image

from avatarbuild.formats import colour
from avatarbuild.formats.clip import encode_clip

pillow_heif.register_heif_opener()

QUADRANTS = {"A": (200, 60, 50), "B": (60, 170, 70), "C": (60, 80, 190), "D": (210, 200, 90)}

# where the quadrants of an upright 'AB/CD' lie in the stored picture (EXIF 2.32, tag 274: row 0 and column 0 named)
STORED = {1: "ABCD", 2: "BADC", 3: "DCBA", 4: "CDAB", 5: "ACBD", 6: "BDAC", 7: "DBCA", 8: "CADB"}


def quadrants(letters: str = "ABCD", width: int = 96, height: int = 64) -> np.ndarray:
    """(height, width, 3) uint8: four flat colours, row by row."""
    rgb = np.empty((height, width, 3), np.uint8)
    for i, letter in enumerate(letters):
        y, x = divmod(i, 2)
        rgb[y * height // 2 : (y + 1) * height // 2, x * width // 2 : (x + 1) * width // 2] = QUADRANTS[letter]
    return rgb


def stored_quadrants(orientation: int, width: int = 96, height: int = 64) -> np.ndarray:
    """What a camera stores of the upright `quadrants()` with this EXIF orientation."""
    if orientation >= 5:
        width, height = height, width
    return quadrants(STORED[orientation], width, height)


def texture(width: int, height: int, seed: int = 0) -> np.ndarray:
    """(height, width, 3) uint8: smooth random colours with grain."""
    random = np.random.default_rng(seed)
    coarse = Image.fromarray(random.integers(30, 226, (8, 8, 3)).astype(np.uint8)).resize((width, height))
    return np.clip(np.asarray(coarse) + random.normal(0.0, 4.0, (height, width, 3)), 0, 255).astype(np.uint8)


def exif_block(
    orientation: int | None = None,
    f35: float | None = None,
    taken: str | None = None,
    subsecond: str | None = None,
    make: str | None = "Maker",
    model: str | None = "Phone 1",
    lens: str | None = "back lens 4.2mm",
    focal: float | None = None,
    plane: tuple[float, int] | None = None,
    written: tuple[int, int] | None = None,
    position: bool = False,
) -> bytes:
    """EXIF; `plane` is (pixels a unit, unit), `written` PixelXDimension and YDimension, `position` adds GPS tags."""
    block = Image.Exif()
    first = {0x0112: orientation, 0x010F: make, 0x0110: model}
    second = {0xA405: f35, 0x9003: taken, 0x9291: subsecond, 0xA434: lens, 0x920A: focal}
    if plane:
        second |= {0xA20E: plane[0], 0xA210: plane[1]}
    if written:
        second |= {0xA002: written[0], 0xA003: written[1]}
    for tag, value in first.items():
        if value is not None:
            block[tag] = value
    block.get_ifd(0x8769).update({tag: value for tag, value in second.items() if value is not None})
    block.get_ifd(0x8769)[0xA431] = "SERIAL-77"
    if position:
        block.get_ifd(0x8825).update({1: "N", 2: (47.0, 22.0, 37.5), 3: "E", 4: (8.0, 32.0, 30.25)})
    return block.tobytes()


def photo(path: Path, rgb: np.ndarray, exif: bytes = b"", icc: bytes | None = None) -> Path:
    """A JPEG, PNG or TIFF by its suffix; grey, alpha and 8 bit as the array is."""
    settings: dict = {"quality": 97, "subsampling": 0} if path.suffix.lower() in (".jpg", ".jpeg") else {}
    if exif:
        settings["exif"] = exif
    Image.fromarray(rgb).save(path, icc_profile=icc, **settings)
    return path


def heic(
    path: Path, rgb: np.ndarray, orientation: int = 1, how: str = "irot", icc: bytes | None = None, **tags
) -> Path:
    """
    An HEIC file of stored pixels whose orientation is said by properties of the picture ('irot'), by EXIF alone
    ('exif') or by both ('both', as iPhones do).

    The encoder makes properties of an EXIF orientation and keeps the tag: the tag is changed in the bytes.
    """
    given = 1 if how == "exif" else orientation
    written = 1 if how == "irot" else orientation
    data = io.BytesIO()
    block = exif_block(orientation=given, **tags)
    Image.fromarray(rgb).save(data, "HEIF", quality=95, chroma=444, exif=block, icc_profile=icc)
    assert data.getvalue().count(block) == 1
    path.write_bytes(data.getvalue().replace(block, exif_block(orientation=written, **tags)))
    return path


def heic_signal(path: Path, signal: np.ndarray, curve: str) -> Path:
    """A 10 bit HDR HEIC of (h, w, 3) float BT.2020 signal in 0..1 with curve 'HLG' or 'PQ'."""
    deep = np.rint(signal * 65535).astype(np.uint16)
    picture = pillow_heif.from_bytes("RGB;16", deep.shape[1::-1], deep.tobytes())
    number = {name: key for key, name in colour.HDR_CURVES.items()}[curve]
    coded = {"color_primaries": 9, "transfer_characteristics": number, "matrix_coefficients": 9, "full_range_flag": 1}
    picture.save(path, quality=-1, chroma=444, save_nclx_profile=True, **coded)
    return path


def signal_frames(signal: np.ndarray, n: int) -> list[np.ndarray]:
    """n uint16 frames for `encode_clip` of (h, w, 3) signal in 0..1."""
    return [np.rint(signal * 65535).astype(np.uint16)] * n


def profile(primaries: str, description: str) -> bytes:
    """An ICC profile (version 4, matrix and sRGB's curve) of primaries known to `colour`."""
    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    d65, d50 = colour.xyz_from_rgb(primaries) @ np.ones(3), np.array([0.9642, 1.0, 0.8249])
    adapt = np.linalg.solve(bradford, np.diag((bradford @ d50) / (bradford @ d65)) @ bradford)
    columns = (adapt @ colour.xyz_from_rgb(primaries)).T
    fixed = lambda values: b"".join(struct.pack(">i", round(v * 65536)) for v in values)  # noqa: E731
    text = description.encode("utf-16-be")
    named = b"mluc" + struct.pack(">IIIHHII", 0, 1, 12, 0x656E, 0x5553, len(text), 28) + text
    curve = b"para" + struct.pack(">IHH", 0, 3, 0) + fixed((2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045))
    xyz = lambda values: b"XYZ \0\0\0\0" + fixed(values)  # noqa: E731
    tags = {b"desc": named, b"cprt": named, b"wtpt": xyz(d50), b"chad": b"sf32\0\0\0\0" + fixed(adapt.ravel())}
    tags |= {bytes((c,)) + b"XYZ": xyz(column) for c, column in zip(b"rgb", columns)}
    tags |= {bytes((c,)) + b"TRC": curve for c in b"rgb"}
    directory, body = struct.pack(">I", len(tags)), b""
    for name, value in tags.items():
        directory += name + struct.pack(">II", 132 + 12 * len(tags) + len(body), len(value))
        body += value + b"\0" * (-len(value) % 4)
    head = struct.pack(">I4sI4s4s4s12s4s4sIIIIII", 0, b"\0\0\0\0", 0x04200000, b"mntr", b"RGB ", b"XYZ ", b"", b"acsp",
                       b"\0\0\0\0", 0, 0, 0, 0, 0, 0)  # fmt: skip
    head += fixed(d50)
    head += b"\0" * (128 - len(head))
    done = head + directory + body
    return struct.pack(">I", len(done)) + done[4:]


def huge_png(path: Path, width: int = 10_000, height: int = 10_000) -> Path:
    """A flat 8 bit RGB PNG of any size, written without its pixels ever being in memory."""
    packer, rows = zlib.compressobj(1), b"\0" + bytes((150, 110, 90)) * width
    packed = b"".join(packer.compress(rows) for _ in range(height)) + packer.flush()
    chunk = lambda kind, body: struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))  # noqa: E731
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b""))
    return path


def clip(path: Path, n: int = 12, fps: float = 30.0, size: tuple[int, int] = (96, 64), **settings) -> Path:
    """A clip of frames `numbered` by a grey bar on top of the `quadrants`: they tell their index and orientation."""
    encode_clip(path, [numbered(i, size) for i in range(n)], fps, **settings)
    return path


def numbered(i: int, size: tuple[int, int] = (96, 64)) -> np.ndarray:
    """Frame i of `clip`: the bar is of grey 20 + 15 i (mod 220)."""
    rgb = quadrants("ABCD", *size)
    rgb[: size[1] // 4] = 20 + 15 * i % 220
    return rgb


def number(rgb: np.ndarray) -> int:
    """The frame number (below 14) that `numbered` wrote, however the frame was compressed."""
    return round((float(rgb[: rgb.shape[0] // 8].mean()) - 20) / 15)


def without_tail(path: Path, source: Path, share: float) -> Path:
    """The first share of a file's bytes."""
    data = source.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path


def bad_inputs(folder: Path) -> dict[str, Path]:
    """Files that must each be refused in one line; the key says what is wrong. The folder is made."""
    folder.mkdir(parents=True, exist_ok=True)
    good = photo(folder / "good.jpg", texture(320, 240))
    data = good.read_bytes()
    bad = {name: folder / name.replace(": ", ".").replace(" ", "_") for name in _BAD}
    bad["empty: jpg"].write_bytes(b"")
    bad["text: jpg"].write_text("This is a note, not a photo.\n" * 20)
    bad["truncated: jpg"].write_bytes(data[: len(data) // 2])
    bad["zero tail: jpg"].write_bytes(data[: len(data) // 2] + bytes(len(data) - len(data) // 2))
    without_tail(bad["truncated: png"], photo(folder / "good.png", texture(320, 240)), 0.5)
    without_tail(bad["truncated: tif"], photo(folder / "good.tif", texture(320, 240)), 0.5)
    without_tail(bad["truncated: heic"], heic(folder / "good.heic", texture(320, 240)), 0.6)
    bad["text: heic"].write_text("no picture")
    bad["empty: mp4"].write_bytes(b"")
    bad["text: mp4"].write_text("no video")
    film = clip(folder / "good.mp4", 12)
    without_tail(bad["truncated: mp4"], film, 0.6)
    data = film.read_bytes()
    at = data.find(b"moov")
    bad["corrupt: mp4"].write_bytes(data[:at] + bytes(200) + data[at + 200 :])
    for name in ("good.jpg", "good.png", "good.tif", "good.heic", "good.mp4"):
        (folder / name).unlink()
    return bad


_BAD: Sequence[str] = (
    "empty: jpg", "text: jpg", "truncated: jpg", "zero tail: jpg", "truncated: png", "truncated: tif",
    "truncated: heic", "text: heic", "empty: mp4", "text: mp4", "truncated: mp4", "corrupt: mp4",
)  # fmt: skip

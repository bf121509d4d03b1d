"""Photos of any phone or editor, made upright and sRGB; and the JPEGs that the project keeps."""

from __future__ import annotations

import io
import logging
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pillow_heif
from PIL import Image, TiffImagePlugin, UnidentifiedImageError

from avatarbuild.errors import InputError
from avatarbuild.formats import colour, exif, heif, picture_files

log = logging.getLogger(__name__)

PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".heic", ".heif", ".hif"})

MIN_SIDE = 16  # pixels: less is an icon
MAX_PIXELS = 300_000_000  # beyond any phone; a larger picture is a stitched panorama or a trap

# Pillow's own limit is a third of this and would refuse pictures that are read here in strips
Image.MAX_IMAGE_PIXELS = None
pillow_heif.register_heif_opener(thumbnails=False)

_STRIP = 256  # rows read at a time

# what the readers raise for broken files
_FAULTS = (OSError, SyntaxError, ValueError, RuntimeError, EOFError)


@dataclass(frozen=True)
class PhotoFacts:
    """
    What a photo's header tells, for the upright full-size picture.

    size          width, height in pixels
    focal         pixels; NaN if unknown
    focal_source  'EXIF 35 mm equivalent', 'EXIF focal length and sensor resolution' or ''
    time          s from 1970-01-01 00:00 of the camera's own clock; NaN if unknown
    camera        'make model, lens'; '' if unknown
    lens          photos of equal `lens` were taken through one lens at one zoom and have one upright size
    mirrored      True where the header says that the upright picture is a mirror image; None: nothing is said
    colour        'sRGB', an ICC profile's name, 'HLG', 'PQ' or '' for nothing said, which is read as sRGB
    """

    size: tuple[int, int]
    focal: float
    focal_source: str
    time: float
    camera: str
    lens: str
    mirrored: bool | None
    colour: str


@dataclass(frozen=True)
class Photo:
    """An upright photo: rgb (h, w, 3) uint8 sRGB, which may be smaller than `facts` say, and its own focal, pixels."""

    rgb: np.ndarray
    focal: float
    facts: PhotoFacts


def is_photo(path: Path) -> bool:
    """Whether the name is a photo's; hidden files are none."""
    return path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")


def read_photo(path: Path, max_pixels: float = math.inf) -> Photo:
    """
    The photo upright, in sRGB, scaled down (area averages) to at most max_pixels.

    Raises InputError for files that cannot be read, are no pictures, end early, have over 300 million pixels or
    pixels of a kind that phones do not write (floating point, Lab).
    """
    with _opened(path) as (image, turn):
        facts = _facts(image, turn)
        size = _fitting(_stored_size(image), max_pixels)
        try:
            rgb = _pixels(path, image, size)
        except _FAULTS as e:
            log.debug("%s: %s", path.name, e)
            raise InputError(f"{path}: damaged, cannot be read to its end; copy it again or remove it") from e
    rgb = upright(rgb, turn)
    return Photo(rgb, facts.focal * (rgb.shape[1] / facts.size[0]), facts)


def decode_jpeg(data: bytes) -> np.ndarray:
    """(h, w, 3) uint8 of a JPEG file's bytes as stored: no orientation, no profile. Raises ValueError."""
    flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
    rgb = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if rgb is None:
        raise ValueError("not a JPEG file")
    return rgb


def encode_jpeg(rgb: np.ndarray, quality: int) -> bytes:
    """A JPEG file's bytes of (h, w, 3) uint8: full chroma, no metadata, the same bytes every time."""
    settings = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
    done, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), settings)
    assert done
    return data.tobytes()


def decode_png(data: bytes) -> np.ndarray:
    """(h, w, 3) or (h, w) uint8 of a PNG file's bytes as stored. Raises ValueError."""
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if pixels is None:
        raise ValueError("not a PNG file")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB) if pixels.ndim == 3 else pixels


def encode_png(rgb: np.ndarray) -> bytes:
    """A PNG file's bytes of (h, w, 3) or (h, w) uint8: no metadata, the same bytes every time."""
    done, data = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR) if rgb.ndim == 3 else rgb)
    assert done
    return data.tobytes()


def upright(rgb: np.ndarray, orientation: int) -> np.ndarray:
    """(h, w, 3) or (w, h, 3): the picture turned as EXIF's orientation 1 to 8 asks."""
    if orientation >= 5:
        rgb = rgb.transpose(1, 0, 2)
    if orientation in (2, 3, 6, 7):
        rgb = rgb[:, ::-1]
    if orientation in (3, 4, 7, 8):
        rgb = rgb[::-1]
    return np.ascontiguousarray(rgb)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Image.Image, int]]:
    """The picture with its header read, and the orientation still to be applied."""
    try:
        data = path.read_bytes()
    except OSError as e:
        raise InputError(f"{path}: cannot be opened ({e.strerror or e}); check its permissions or remove it") from e
    if not data:
        raise InputError(f"{path}: the file is empty; copy it from the camera again or remove it")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's remarks on odd EXIF blocks
            image = Image.open(io.BytesIO(data))
    except UnidentifiedImageError as e:
        raise InputError(f"{path}: not a picture that can be read; copy it again or remove it") from e
    except _FAULTS as e:
        log.debug("%s: %s", path.name, e)
        raise InputError(f"{path}: damaged, its header cannot be read; copy it again or remove it") from e
    with image:
        if image.width * image.height > MAX_PIXELS:
            found = f"{image.width} x {image.height} pixels"
            raise InputError(f"{path}: {found}, more than 300 million; scale it down or remove it")
        if min(image.size) < MIN_SIDE:
            raise InputError(f"{path}: {image.width} x {image.height} pixels are no photo; remove it")
        if not picture_files.is_whole(data, image.format):
            raise InputError(f"{path}: the file ends early; copy it from the camera again or remove it")
        if image.format == "PNG":
            image.info["exif"] = image.info.get("exif") or picture_files.png_exif(data)
        turn = exif.orientation(image.getexif())
        if image.format == "HEIF":
            turn = 1 if heif.turns_itself(data) else image.info.get("original_orientation") or 1
        yield image, turn


def _facts(image: Image.Image, turn: int) -> PhotoFacts:
    tags = image.getexif()
    width, height = _stored_size(image) if turn < 5 else _stored_size(image)[::-1]
    focal, source = exif.focal(tags, width, height)
    camera = exif.camera(tags)
    lens = f"{camera or 'unknown'} {exif.optics(tags)} {width}x{height}"
    mirrored = True if turn in (2, 4, 5, 7) else None
    return PhotoFacts((width, height), focal, source, exif.taken(tags), camera, lens, mirrored, _colour_name(image))


def _stored_size(image: Image.Image) -> tuple[int, int]:
    """Width and height before any turn; Pillow tells a TIFF's after it."""
    if isinstance(image, TiffImagePlugin.TiffImageFile):
        return int(image.tag_v2[256]), int(image.tag_v2[257])
    return image.size


def _colour_name(image: Image.Image) -> str:
    profile = image.info.get("icc_profile")
    if profile:
        return colour.profile_name(profile)
    curve, primaries = _coded_colour(image)
    return curve or primaries


def _coded_colour(image: Image.Image) -> tuple[str, str]:
    """('HLG', 'PQ' or '', wide primaries' name or '') of an HEIC file without ICC profile."""
    coded = image.info.get("nclx_profile")
    if image.format != "HEIF" or not coded or image.info.get("icc_profile"):
        return "", ""
    curve = colour.HDR_CURVES.get(int(coded["transfer_characteristics"]), "")
    return curve, colour.WIDE_PRIMARIES.get(int(coded["color_primaries"]), "")


def _fitting(size: tuple[int, int], max_pixels: float) -> tuple[int, int]:
    """The size, or the largest of its shape with at most max_pixels."""
    scale = min(1.0, math.sqrt(max_pixels / (size[0] * size[1])))
    if scale == 1.0:
        return size
    return max(1, int(size[0] * scale)), max(1, int(size[1] * scale))


def _pixels(path: Path, image: Image.Image, size: tuple[int, int]) -> np.ndarray:
    """(h, w, 3) uint8 sRGB as stored, scaled to size."""
    if image.mode in ("F", "LAB", "HSV"):
        raise InputError(f"{path}: its pixels are of kind {image.mode}; save it as 8 or 16 bit RGB or remove it")
    curve, primaries = _coded_colour(image)
    if curve:
        return _scaled(colour.srgb_from_hdr(_heif_signal(path), curve, primaries or "BT.709"), size)
    if image.format in ("PNG", "TIFF"):
        pixels = _scaled(_read_in_strips(path, size[0]), size)
        return _profiled(path, pixels, image)
    image.draft(None, size)
    image.load()
    if image.mode == "CMYK":
        return _scaled(_profiled(path, image, image), size)
    pixels = _scaled(np.asarray(image if image.mode in ("L", "RGB") else image.convert("RGB")), size)
    rgb = _profiled(path, pixels, image)
    return colour.srgb_from_primaries(rgb, primaries) if primaries else rgb


def _scaled(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(h, w) or (h, w, 3) averaged over areas to size (w, h)."""
    if (pixels.shape[1], pixels.shape[0]) == size:
        return pixels
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def _profiled(path: Path, pixels: np.ndarray | Image.Image, header: Image.Image) -> np.ndarray:
    """(h, w, 3) uint8 sRGB of pixels in the colours of the header's ICC profile, if it has one."""
    profile = header.info.get("icc_profile")
    if profile:
        picture = Image.fromarray(pixels) if isinstance(pixels, np.ndarray) else pixels
        try:
            return np.asarray(colour.srgb_from_icc(picture, profile))
        except ValueError as e:
            log.warning("%s: %s; its colours are taken for sRGB", path.name, e)
    if isinstance(pixels, Image.Image):
        return np.asarray(pixels.convert("RGB"))
    return pixels if pixels.ndim == 3 else np.repeat(pixels[:, :, None], 3, axis=2)


def _heif_signal(path: Path) -> np.ndarray:
    """(h, w, 3) uint16: the signal of an HDR HEIC file in full depth."""
    signal = np.asarray(pillow_heif.open_heif(path.read_bytes(), convert_hdr_to_8bit=False))
    if signal.dtype == np.uint8:
        signal = signal.astype(np.uint16) * 257
    if signal.ndim == 2:
        signal = np.repeat(signal[:, :, None], 3, axis=2)
    return signal[:, :, :3]


def _read_in_strips(path: Path, width: int) -> np.ndarray:
    """
    (h, width) grey or (h, width, 3) uint8 of a PNG or TIFF file; transparent parts black.

    Rows are shortened while they are read: 100 megapixels in 16 bit never lie in memory as a whole.
    """
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise OSError(oiio.geterror())
    try:
        spec = source.spec()
        n = 3 if spec.nchannels >= 3 else 1
        pixels = np.empty((spec.height, width, n), np.uint8)
        step = max(1, spec.tile_height) * max(1, _STRIP // max(1, spec.tile_height))
        for top in range(0, spec.height, step):
            bottom = min(top + step, spec.height)
            strip = _read_rows(source, spec, top, bottom, n)
            if width != spec.width:
                strip = cv2.resize(strip, (width, bottom - top), interpolation=cv2.INTER_AREA)
            pixels[top:bottom] = strip.reshape(-1, width, n)
    finally:
        source.close()
    return pixels if n == 3 else pixels[:, :, 0]


def _read_rows(source: oiio.ImageInput, spec: oiio.ImageSpec, top: int, bottom: int, n: int) -> np.ndarray:
    """(bottom - top, w, n) uint8: rows of the first n channels."""
    y = spec.y + top, spec.y + bottom
    if spec.tile_width:
        end = spec.y + min(spec.height, -(-bottom // spec.tile_height) * spec.tile_height)
        pixels = source.read_tiles(spec.x, spec.x + spec.width, y[0], end, 0, 1, 0, n, "uint8")
    else:
        pixels = source.read_scanlines(*y, 0, 0, n, "uint8")
    if pixels is None:
        raise OSError(source.geterror())
    return np.asarray(pixels).reshape(-1, spec.width, n)[: bottom - top]

"""Photos: orientations by hand, colours by profile, every pixel kind, and files that must be refused."""

import io
import json
import math
import resource
import sys
from pathlib import Path

import cv2
import media
import numpy as np
import OpenImageIO as oiio
import pytest
from captures import benchmark
from PIL import Image

from avatarbuild.errors import InputError
from avatarbuild.formats import colour, exif, heif, images

AWKWARD = "Fotos für Zoë 头像/IMG 01 ü"


def _close(rgb: np.ndarray, expected: np.ndarray, mean: float = 2.0) -> None:
    assert rgb.shape == expected.shape
    assert rgb.dtype == np.uint8
    assert np.abs(rgb.astype(int) - expected).mean() < mean


@pytest.fixture
def awkward(tmp_path):
    path = tmp_path / AWKWARD
    path.parent.mkdir(parents=True)
    return path


@pytest.mark.parametrize("suffix", ["jpg", "JPEG", "png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_all_orientations_stand_upright(awkward, suffix, orientation):
    stored = media.stored_quadrants(orientation)
    path = media.photo(Path(f"{awkward}.{suffix}"), stored, media.exif_block(orientation, f35=26))
    photo = images.read_photo(path)
    _close(photo.rgb, media.quadrants())
    assert photo.facts.size == (96, 64)
    assert photo.focal == pytest.approx(26 / 43.2666 * math.hypot(96, 64), rel=1e-4)
    assert photo.facts.mirrored is (True if orientation in (2, 4, 5, 7) else None)


@pytest.mark.parametrize("how", ["irot", "exif", "both"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_heic_is_turned_once_whoever_says_so(awkward, how, orientation):
    path = media.heic(Path(f"{awkward}.heic"), media.stored_quadrants(orientation), orientation, how, f35=26.0)
    turned = how != "exif" and orientation != 1
    assert heif.turns_itself(path.read_bytes()) == turned
    photo = images.read_photo(path)
    _close(photo.rgb, media.quadrants(), 4.0)
    assert photo.facts.size == (96, 64)
    assert photo.facts.focal == pytest.approx(26 / 43.2666 * math.hypot(96, 64), rel=1e-4)


def test_turns_itself_survives_nonsense():
    assert not heif.turns_itself(b"")
    assert not heif.turns_itself(bytes(range(256)) * 4)


def test_focal_from_35mm_equivalent():
    # the diagonal rule, by hand: a 36 x 24 picture at 1 pixel a mm
    assert exif.focal_from_35mm(50, 36000, 24000) == pytest.approx(50000)
    # a phone's 4 : 3 picture of 1512 x 2016 has the diagonal 2520; the truth of the benchmark capture is 1515.48
    assert exif.focal_from_35mm(26, 1512, 2016) == pytest.approx(26 / 43.26661 * 2520)
    assert exif.focal_from_35mm(26, 1512, 2016) == pytest.approx(1515.48, rel=2e-3)
    # crops of the 4 : 3 sensor keep its focal length: 16 : 9 cuts the short side, a square the long one
    assert exif.focal_from_35mm(26, 2016, 1134) == pytest.approx(exif.focal_from_35mm(26, 2016, 1512))
    assert exif.focal_from_35mm(26, 1512, 1512) == pytest.approx(exif.focal_from_35mm(26, 2016, 1512))


def test_focal_from_sensor_resolution(tmp_path):
    # 4.2 mm lens, 4000 pixels on 5.6 mm: 714.2857 a mm; the file was scaled from 4000 to 400 pixels
    block = media.exif_block(f35=None, focal=4.2, plane=(714.2857, 4), written=(4000, 3000))
    photo = images.read_photo(media.photo(tmp_path / "a.jpg", media.texture(400, 300), block))
    assert photo.focal == pytest.approx(300.0, rel=1e-4)
    assert photo.facts.focal_source == "EXIF focal length and sensor resolution"
    bare = images.read_photo(media.photo(tmp_path / "b.jpg", media.texture(400, 300)))
    assert math.isnan(bare.focal)
    assert (bare.facts.focal_source, bare.facts.camera) == ("", "")
    assert math.isnan(bare.facts.time)


def test_time_camera_and_lens(tmp_path):
    block = media.exif_block(1, 26, "2025:03:16 15:09:26", "743", "Apple", "iPhone 12", "iPhone 12 back camera")
    facts = images.read_photo(media.photo(tmp_path / "a.jpg", media.texture(40, 30), block)).facts
    assert facts.time == pytest.approx(1742137766.743)
    assert facts.camera == "Apple iPhone 12, iPhone 12 back camera"
    unset = media.exif_block(taken="0000:00:00 00:00:00")
    assert math.isnan(images.read_photo(media.photo(tmp_path / "b.jpg", media.texture(40, 30), unset)).facts.time)


def test_one_lens_is_one_camera_however_the_phone_was_held(tmp_path):
    def lens(name, orientation, **tags):
        stored = media.stored_quadrants(orientation)
        path = media.photo(tmp_path / f"{name}.jpg", stored, media.exif_block(orientation, **tags))
        return images.read_photo(path).facts.lens

    assert lens("a", 1, f35=26) == lens("b", 6, f35=26) == lens("c", 8, f35=26)
    assert lens("a", 1, f35=26) != lens("d", 1, f35=52), "a zoom"
    assert lens("a", 1, f35=26) != lens("e", 1, f35=26, lens="front lens")


def test_serial_number_and_position_reach_nothing(tmp_path):
    block = media.exif_block(6, 26, "2025:03:16 15:09:26", position=True)
    for path in (
        media.photo(tmp_path / "a.jpg", media.texture(96, 64), block),
        media.photo(tmp_path / "a.png", media.texture(96, 64), block),
        media.heic(tmp_path / "a.heic", media.texture(96, 64), 6, f35=26.0, position=True),
    ):
        assert b"SERIAL-77" in path.read_bytes()
        photo = images.read_photo(path)
        told = repr(photo.facts)
        assert "SERIAL" not in told
        assert not any(f"{v:g}" in told for v in (37.5, 30.25))
        kept = images.encode_jpeg(photo.rgb, 90)
        assert b"Exif" not in kept
        assert b"SERIAL" not in kept


def test_display_p3_becomes_srgb(tmp_path):
    srgb = np.array([200, 100, 50], np.float64)
    wide = colour.srgb_from_linear(
        np.linalg.solve(colour.gamut_matrix("Display P3"), colour.linear_from_srgb(srgb / 255))
    )
    rgb = np.tile(np.rint(wide * 255).astype(np.uint8), (40, 60, 1))
    assert np.abs(rgb[0, 0] - srgb).max() > 8, "the profile must matter"
    icc = media.profile("Display P3", "Display P3")
    paths = [media.photo(tmp_path / f"a.{s}", rgb, icc=icc) for s in ("jpg", "png", "tif")]
    for path in [*paths, media.heic(tmp_path / "a.heic", rgb, icc=icc)]:
        assert images.read_photo(path).facts.colour == "Display P3"
        assert np.abs(images.read_photo(path).rgb.reshape(-1, 3).mean(axis=0) - srgb).max() <= 2


def test_a_profile_that_does_not_fit_is_left_aside(tmp_path, caplog):
    path = media.photo(tmp_path / "a.jpg", np.full((20, 20), 120, np.uint8), icc=media.profile("Display P3", "P3"))
    assert images.read_photo(path).rgb[5, 5] == pytest.approx([120, 120, 120], abs=1)
    assert "taken for sRGB" in caplog.text


@pytest.mark.parametrize("curve", ["HLG", "PQ"])
def test_hdr_heic(tmp_path, curve):
    signal = {"HLG": 0.5, "PQ": 0.508078}[curve]
    path = media.heic_signal(tmp_path / "a.heic", np.full((64, 96, 3), signal), curve)
    assert images.read_photo(path).facts.colour == curve
    assert np.abs(images.read_photo(path).rgb.astype(int) - {"HLG": 137, "PQ": 186}[curve]).max() <= 2


def test_pixel_kinds(tmp_path):
    grey = np.tile(np.arange(96, dtype=np.uint8) + 80, (64, 1))
    rgb = np.repeat(grey[:, :, None], 3, axis=2)
    opaque = np.full((64, 96), 255, np.uint8)
    deep = grey.astype(np.uint16) * 257
    Image.fromarray(grey).save(tmp_path / "grey.png")
    Image.fromarray(grey).save(tmp_path / "grey.jpg", quality=100)
    Image.fromarray(deep).save(tmp_path / "grey16.png")
    Image.fromarray(deep).save(tmp_path / "grey16.tif")
    cv2.imwrite(str(tmp_path / "rgb16.png"), np.repeat(deep[:, :, None], 3, axis=2))
    cv2.imwrite(str(tmp_path / "rgb16.tif"), np.repeat(deep[:, :, None], 3, axis=2))
    Image.fromarray(np.dstack([rgb, opaque])).save(tmp_path / "alpha.png")
    Image.fromarray(np.dstack([grey, opaque]), "LA").save(tmp_path / "greyalpha.png")
    Image.fromarray(grey).convert("P").save(tmp_path / "palette.png")
    Image.fromarray(rgb).save(tmp_path / "lzw.tif", compression="tiff_lzw")
    Image.fromarray(rgb).convert("CMYK").save(tmp_path / "cmyk.jpg", quality=100)
    Image.fromarray(rgb).convert("CMYK").save(tmp_path / "cmyk.tif")
    for path in sorted(tmp_path.iterdir()):
        found = images.read_photo(path).rgb
        assert found.shape == (64, 96, 3), path.name
        assert np.abs(found.astype(int) - rgb).max() <= 2, path.name


def test_refused_pixel_kinds(tmp_path):
    Image.fromarray(np.zeros((20, 20), np.float32)).save(tmp_path / "float.tif")
    with pytest.raises(InputError, match=r"float\.tif.*8 or 16 bit"):
        images.read_photo(tmp_path / "float.tif")


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "heic"])
def test_scaled_down_while_read(tmp_path, suffix):
    rgb = media.texture(480, 360)
    block = {"f35": 26.0}
    path = tmp_path / f"a.{suffix}"
    if suffix == "heic":
        media.heic(path, rgb, **block)
    else:
        media.photo(path, rgb, media.exif_block(**block))
    whole, small = images.read_photo(path), images.read_photo(path, 9_600)
    assert small.rgb.shape == (84, 113, 3)
    assert small.facts.size == whole.facts.size == (480, 360)
    assert small.focal == pytest.approx(whole.focal * 113 / 480)
    expected = cv2.resize(whole.rgb, (113, 84), interpolation=cv2.INTER_AREA)
    assert np.abs(small.rgb.astype(int) - expected).mean() < 2.0
    # no shift against the whole: differences balance over the gradient of the picture
    assert np.abs((small.rgb.astype(int) - expected).mean()) < 0.3


def test_strips_tiles_and_rest_rows_join(tmp_path):
    rgb = media.texture(640, 613)
    media.photo(tmp_path / "a.png", rgb)
    spec = oiio.ImageSpec(640, 613, 3, "uint8")
    spec.tile_width = spec.tile_height = 64
    out = oiio.ImageOutput.create(str(tmp_path / "tiled.tif"))
    assert out.open(str(tmp_path / "tiled.tif"), spec)
    assert out.write_image(rgb)
    out.close()
    for name in ("a.png", "tiled.tif"):
        assert (images.read_photo(tmp_path / name).rgb == rgb).all()
        small = images.read_photo(tmp_path / name, 640 * 613 / 10).rgb
        assert np.abs(small.astype(int) - cv2.resize(rgb, small.shape[1::-1], interpolation=cv2.INTER_AREA)).max() <= 1


@pytest.mark.skipif(sys.platform == "win32", reason="counts memory by getrusage")
def test_a_hundred_megapixels(tmp_path):
    path = media.huge_png(tmp_path / "huge.png")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    photo = images.read_photo(path, 16e6)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert photo.facts.size == (10_000, 10_000)
    assert photo.rgb.shape == (4000, 4000, 3)
    assert tuple(photo.rgb[2000, 2000]) == (150, 110, 90)
    assert grown < 400 * 1024, "kB: well under two whole pictures"
    with pytest.raises(InputError, match="more than 300 million"):
        images.read_photo(media.huge_png(tmp_path / "beyond.png", 20_000, 15_001))


def test_bad_files_are_refused_in_one_line(tmp_path):
    for what, path in media.bad_inputs(tmp_path / AWKWARD).items():
        if not what.endswith("mp4"):
            with pytest.raises(InputError) as found:
                images.read_photo(path)
            line = str(found.value)
            assert path.name in line, what
            assert "\n" not in line, what
            assert "remove it" in line, what


def test_what_cannot_be_opened(tmp_path, monkeypatch):
    path = media.photo(tmp_path / "a.jpg", media.texture(40, 30))

    def refuse(self, *_):
        raise PermissionError(13, "Permission denied")

    with pytest.raises(InputError, match="cannot be opened"):
        images.read_photo(tmp_path / "absent.jpg")
    (tmp_path / "folder.jpg").mkdir()
    with pytest.raises(InputError, match="cannot be opened"):
        images.read_photo(tmp_path / "folder.jpg")
    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        images.read_photo(path)


def test_a_jpeg_followed_by_more_is_whole(tmp_path):
    """Phones append pictures and trailers of their own; progressive files hold several scans."""
    data = io.BytesIO()
    Image.fromarray(media.texture(200, 150)).save(data, "JPEG", progressive=True, quality=95)
    path = tmp_path / "a.jpg"
    path.write_bytes(data.getvalue() + b"SEFT trailer \xff\xd8\xff" + bytes(100))
    assert images.read_photo(path).rgb.shape == (150, 200, 3)


def test_jpeg_bytes_repeat_and_keep_chroma():
    rgb = np.zeros((32, 32, 3), np.uint8)
    rgb[:, 16:] = (220, 30, 40)
    data = images.encode_jpeg(rgb, 97)
    assert data == images.encode_jpeg(rgb, 97)
    assert np.abs(images.decode_jpeg(data).astype(int) - rgb).max() <= 4
    sampling = Image.open(io.BytesIO(data))
    assert all(layer[1:3] == (1, 1) for layer in sampling.layer)
    for nonsense in (b"", b"text"):
        with pytest.raises(ValueError):
            images.decode_jpeg(nonsense)


def test_names():
    assert images.is_photo(Path("IMG_1.HEIC"))
    assert images.is_photo(Path("a.b.Jpg"))
    assert not images.is_photo(Path("._IMG_1.jpg")), "macOS leaves such shadows on foreign disks"
    assert not images.is_photo(Path("clip.mov"))


@pytest.mark.benchmark
def test_focal_of_the_benchmark_capture():
    """EXIF's 26 mm by the diagonal rule against the true camera; the 36 mm width rule would be 4 % off."""
    root = benchmark()
    true = json.loads((root / "truth_b/cameras.json").read_text())["photos"]
    found = images.read_photo(root / "capture_b/photos/IMG_0001.JPG").facts
    assert found.focal == pytest.approx(true[0]["K"][0][0], rel=2e-3)

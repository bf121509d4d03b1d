"""Colour: standards' own numbers, and identities."""

import cv2
import media
import numpy as np
import pytest
from PIL import Image

from avatarbuild.formats import colour, ycbcr


def test_srgb_curve_by_hand_and_back():
    assert colour.linear_from_srgb(np.array([0.0, 0.04045, 0.5, 1.0])) == pytest.approx(
        [0.0, 0.0031308, 0.214041, 1.0], abs=1e-6
    )
    x = np.linspace(0.0, 1.0, 1001)
    assert colour.linear_from_srgb(colour.srgb_from_linear(x)) == pytest.approx(x, abs=1e-7)


def test_bytes_there_and_back():
    levels = np.arange(256, dtype=np.uint8)
    assert (colour.encode_srgb(colour.decode_srgb(levels)) == levels).all()
    assert colour.encode_srgb(np.array([-0.1, 1.1])).tolist() == [0, 255]


def test_primaries_give_the_published_matrices():
    # IEC 61966-2-1, four digits; the luminance row of BT.2020 is BT.2100's
    assert colour.xyz_from_rgb("BT.709")[1] == pytest.approx([0.2126, 0.7152, 0.0722], abs=5e-5)
    assert colour.xyz_from_rgb("BT.2020")[1] == pytest.approx([0.2627, 0.6780, 0.0593], abs=5e-5)
    # ITU-R BT.2087: BT.709 from BT.2020
    expected = [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
    assert colour.gamut_matrix("BT.2020") == pytest.approx(np.array(expected), abs=1e-4)
    for name in colour.PRIMARIES:
        assert colour.gamut_matrix(name) @ np.ones(3) == pytest.approx(np.ones(3), abs=1e-9)


def test_hlg_and_pq_curves_at_published_points():
    # BT.2100 table 5: 1/12 of scene light at half signal, all of it at 1; BT.2408: HLG 75 % and PQ 58 % are 203 cd/m2
    assert colour.scene_from_hlg(np.array([0.0, 0.5, 1.0])) == pytest.approx([0.0, 1 / 12, 1.0], abs=1e-6)
    assert 1000 * colour.scene_from_hlg(np.array(0.75)) ** 1.2 == pytest.approx(203, abs=1)
    assert colour.nits_from_pq(np.array([0.0, 0.508078, 0.5806, 1.0])) == pytest.approx([0, 100, 203, 10000], rel=1e-3)


def _grey(curve, signal):
    rgb = np.full((2, 2, 3), round(signal * 65535), np.uint16)
    out = colour.srgb_from_hdr(rgb, curve)
    assert (out == out[0, 0, 0]).all(), "grey stays grey"
    return int(out[0, 0, 0])


def test_hdr_greys_by_hand():
    # HLG 0.5: (1/12)^1.2 * 1000 = 50.7 cd/m2, 0.250 of 203; below the knee, so sRGB 0.537
    assert abs(_grey("HLG", 0.5) - 137) <= 1
    # PQ 0.508: 100 cd/m2, 0.4926, sRGB 0.7294
    assert abs(_grey("PQ", 0.508078) - 186) <= 1
    # reference white: m = 1, s = 1, S = (4.926 - 0.8) / 0.2 = 20.63: 0.8 + 0.2 * (1 + 1 / 425.6) / 2 = 0.9002
    assert abs(_grey("PQ", 0.5807) - 243) <= 1
    assert abs(_grey("HLG", 0.75) - 243) <= 1
    for curve in ("HLG", "PQ"):
        assert _grey(curve, 0.0) == 0
        assert _grey(curve, 1.0) == 255
        levels = [_grey(curve, s) for s in np.linspace(0, 1, 60)]
        assert levels == sorted(levels)


def test_hdr_colours_of_srgb_come_back():
    """sRGB patches put as display light at 203 cd/m2 white into BT.2020 PQ and HLG come back below the knee."""
    srgb = np.array([[[120, 80, 60], [200, 150, 120], [40, 60, 160], [90, 90, 90]]], np.float64)
    light = colour.linear_from_srgb(srgb / 255) @ np.linalg.inv(colour.gamut_matrix("BT.2020")).T * 203
    grid = np.arange(65536) / 65535
    pq = np.searchsorted(colour.nits_from_pq(grid), light).astype(np.uint16)
    assert np.abs(colour.srgb_from_hdr(pq, "PQ").astype(int) - srgb).max() <= 1
    luminance = light @ np.array([0.2627, 0.6780, 0.0593])
    scene = light / 1000 * (luminance[..., None] / 1000) ** (-0.2 / 1.2)
    hlg = np.searchsorted(colour.scene_from_hlg(grid), scene).astype(np.uint16)
    assert np.abs(colour.srgb_from_hdr(hlg, "HLG").astype(int) - srgb).max() <= 1


def test_wide_primaries_and_the_same_colour_as_icc_profile():
    srgb = np.array([[200, 100, 50], [90, 160, 80], [128, 128, 128], [30, 40, 120]], np.float64)
    wide = colour.srgb_from_linear(
        colour.linear_from_srgb(srgb / 255) @ np.linalg.inv(colour.gamut_matrix("Display P3")).T
    )
    pixels = np.rint(wide * 255).astype(np.uint8)[None]
    assert np.abs(colour.srgb_from_primaries(pixels, "Display P3").astype(int) - srgb).max() <= 1
    by_icc = colour.srgb_from_icc(Image.fromarray(pixels), media.profile("Display P3", "Display P3"))
    assert np.abs(np.asarray(by_icc).astype(int) - srgb).max() <= 1
    # P3's pure red lies outside sRGB
    assert tuple(colour.srgb_from_primaries(np.array([[[255, 0, 0]]], np.uint8), "Display P3")[0, 0]) == (255, 0, 0)


def test_profile_that_does_not_fit_is_an_error():
    with pytest.raises(ValueError):
        colour.srgb_from_icc(Image.new("L", (4, 4)), media.profile("Display P3", "P3"))
    with pytest.raises(ValueError):
        colour.srgb_from_icc(Image.new("RGB", (4, 4)), b"nonsense" * 30)
    assert colour.profile_name(media.profile("Display P3", "Display P3")) == "Display P3"
    assert colour.profile_name(b"nonsense") == "unreadable ICC profile"


def _rgb_slowly(y, cb, cr, bits, luma, full):
    """The oracle: chroma by sampling at the luma positions, then the equations in float64."""
    h, w = y.shape

    def up(c):
        x = np.arange(w) / (w / c.shape[1])
        j = np.arange(h, dtype=float) if c.shape[0] == h else (np.arange(h) - 0.5) / 2
        grid = [g.astype(np.float32) for g in np.meshgrid(x, j)]
        return cv2.remap(c.astype(np.float32), *grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)

    one, (kr, kb) = 2 ** (bits - 8), luma
    top = 256 * one - 1
    light = y / top if full else (y - 16.0 * one) / (219 * one)
    b, r = ((up(c) - 128 * one) / (top if full else 224 * one) for c in (cb, cr))
    red, blue = light + 2 * (1 - kr) * r, light + 2 * (1 - kb) * b
    return np.clip(np.dstack([red, (light - kr * red - kb * blue) / (1 - kr - kb), blue]), 0, 1)


@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize("chroma", [(32, 48), (64, 48), (64, 96)])
@pytest.mark.parametrize("full", [False, True])
def test_planes_against_the_slow_way(bits, chroma, full):
    random = np.random.default_rng(1)
    kind = np.uint8 if bits == 8 else np.uint16
    y = random.integers(0, 256 << (bits - 8), (64, 96)).astype(kind)
    cb, cr = random.integers(0, 256 << (bits - 8), (2, *chroma)).astype(kind)
    for luma in (ycbcr.BT709, ycbcr.BT601, ycbcr.BT2020):
        expected = _rgb_slowly(y, cb, cr, bits, luma, full)
        rgb = ycbcr.rgb_from_planes(y, cb, cr, bits, luma, full, deep=False)
        assert np.abs(rgb - 255 * expected).max() < 0.6
        deep = ycbcr.rgb_from_planes(y, cb, cr, bits, luma, full, deep=True)
        assert np.abs(deep / 65535 - expected).max() < 1e-3

"""Video: turns, colours, times, exact indices with and without seeking, and broken files."""

from fractions import Fraction
from pathlib import Path

import av
import media
import numpy as np
import pytest

from avatarbuild.errors import InputError
from avatarbuild.formats import colour, video
from avatarbuild.formats.clip import encode_clip

AWKWARD = "Videos für Zoë 头像/MOV 01 ü"


@pytest.fixture
def awkward(tmp_path):
    path = tmp_path / AWKWARD
    path.parent.mkdir(parents=True)
    return path


def _decoder_times(path):
    """The oracle: what the plain decoder gives, in its order."""
    with av.open(str(path)) as container:
        return [float(f.pts * f.time_base) for f in container.decode(container.streams.video[0])]


@pytest.mark.parametrize("codec,pix_fmt", [("h264", "yuv420p"), ("hevc", "yuv420p"), ("hevc", "yuv420p10le")])
@pytest.mark.parametrize("suffix", ["mp4", "MOV"])
def test_codecs_depths_and_containers(awkward, codec, pix_fmt, suffix):
    path = media.clip(Path(f"{awkward}.{suffix}"), 12, codec=codec, pix_fmt=pix_fmt)
    about = video.open_video(path)
    assert (about.codec, about.bits, about.frames, about.size) == (codec, 10 if "10" in pix_fmt else 8, 12, (96, 64))
    assert about.fps == pytest.approx(30)
    assert about.duration == pytest.approx(0.4)
    assert (about.rotation, about.mirrored, about.hdr) == (0, None, "")
    frames = list(video.decode_frames(path))
    assert [i for i, _, _ in frames] == list(range(12))
    assert [t for _, t, _ in frames] == pytest.approx(np.arange(12) / 30, abs=1e-4)
    assert [media.number(rgb) for _, _, rgb in frames] == list(range(12))
    assert all(np.abs(rgb.astype(int) - media.numbered(i)).mean() < 6 for i, _, rgb in frames)


@pytest.mark.parametrize("codec,pix_fmt", [("h264", "yuv420p"), ("hevc", "yuv420p10le")])
@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
def test_turned_and_mirrored_clips_stand_upright(tmp_path, codec, pix_fmt, rotation, mirror):
    settings = {"codec": codec, "pix_fmt": pix_fmt, "rotation": rotation, "mirror": mirror}
    path = media.clip(tmp_path / "a.mov", 3, **settings)
    about = video.open_video(path)
    assert (about.rotation, about.mirrored, about.size) == (rotation, True if mirror else None, (96, 64))
    for i, _, rgb in video.decode_frames(path):
        assert np.abs(rgb.astype(int) - media.numbered(i)).mean() < 6


def test_the_matrix_that_phones_write_for_portrait(tmp_path):
    """(0 1 0; -1 0 0; 0 0 1) takes the stored x axis to y: a quarter turn clockwise, PyAV's rotation -90."""
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.set_display_matrix([0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30])
        frame = av.VideoFrame.from_ndarray(media.quadrants("BDAC"), format="rgb24").reformat(format="yuv420p")
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)
    about = video.open_video(tmp_path / "a.mp4")
    assert (about.rotation, about.size) == (90, (64, 96))
    # a player shows the stored left edge on top: 'BD/AC' turned clockwise is 'AB/CD'
    _, _, rgb = next(video.decode_frames(tmp_path / "a.mp4"))
    assert np.abs(rgb.astype(int) - media.quadrants("ABCD", 64, 96)).mean() < 8


def _raw_clip(path, y, cb, cr, size=(96, 64), full=False, matrix=None):
    """One frame of flat Y'CbCr samples, tagged as told."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"qp": "0"})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        context = stream.codec_context
        context.color_range = 2 if full else 1
        if matrix is not None:
            context.colorspace = matrix
        planes = [np.full((size[1], size[0]), y), np.full((size[1] // 2, size[0]), 0)]
        planes[1].reshape(-1)[: size[0] * size[1] // 4] = cb
        planes[1].reshape(-1)[size[0] * size[1] // 4 :] = cr
        frame = av.VideoFrame.from_ndarray(np.concatenate(planes).astype(np.uint8), format="yuv420p")
        frame.color_range = context.color_range
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)
    return next(video.decode_frames(path))[2]


def test_matrices_and_ranges_by_hand(tmp_path):
    """R = y + 2 (1 - kr) cr, G = y - 2 kb (1 - kb) / kg cb - 2 kr (1 - kr) / kg cr, B = y + 2 (1 - kb) cb."""

    def expected(y, cb, cr, kr, kb, full):
        y, cb, cr = (y / 255, (cb - 128) / 255, (cr - 128) / 255) if full else (
            (y - 16) / 219, (cb - 128) / 224, (cr - 128) / 224)  # fmt: skip
        kg = 1 - kr - kb
        r, b = y + 2 * (1 - kr) * cr, y + 2 * (1 - kb) * cb
        return 255 * np.array([r, (y - kr * r - kb * b) / kg, b])

    bt709, bt601 = (0.2126, 0.0722), (0.299, 0.114)
    sample = (120, 110, 160)
    for matrix, size, k in (
        (1, (96, 64), bt709),
        (5, (96, 64), bt601),
        (6, (1280, 720), bt601),
        (None, (96, 64), bt601),
        (None, (1280, 720), bt709),
        (None, (720, 1280), bt709),
    ):
        for full in (False, True):
            rgb = _raw_clip(tmp_path / "a.mp4", *sample, size, full, matrix)
            assert np.abs(rgb - expected(*sample, *k, full)).max() <= 1.5, (matrix, size, full)


@pytest.mark.parametrize("transfer,signal,level", [("HLG", 0.5, 137), ("HLG", 0.75, 243), ("PQ", 0.508078, 186)])
def test_hdr_clips(tmp_path, transfer, signal, level):
    frames = media.signal_frames(np.full((64, 96, 3), signal), 2)
    encode_clip(tmp_path / "a.mov", frames, 30, codec="hevc", pix_fmt="yuv420p10le", transfer=transfer)
    about = video.open_video(tmp_path / "a.mov")
    assert (about.hdr, about.bits) == (transfer, 10)
    for _, _, rgb in video.decode_frames(tmp_path / "a.mov"):
        assert np.abs(rgb.astype(int) - level).max() <= 3


def test_hdr_colour_in_bands(tmp_path):
    """A skin colour, as HLG light in BT.2020, comes back as the sRGB it was."""
    srgb = np.array([200.0, 150.0, 120.0])
    light = np.linalg.solve(colour.gamut_matrix("BT.2020"), colour.linear_from_srgb(srgb / 255)) * 0.203
    scene = light * (light @ [0.2627, 0.6780, 0.0593]) ** (-0.2 / 1.2)
    grid = np.linspace(0, 1, 65536)
    signal = grid[np.searchsorted(colour.scene_from_hlg(grid), scene)]
    frames = media.signal_frames(np.tile(signal, (64, 96, 1)), 2)
    encode_clip(tmp_path / "a.mov", frames, 30, codec="hevc", pix_fmt="yuv420p10le", transfer="HLG", quality=8)
    _, _, rgb = next(video.decode_frames(tmp_path / "a.mov"))
    assert np.abs(rgb.reshape(-1, 3).mean(axis=0) - srgb).max() <= 3


def test_variable_frame_rate_keeps_true_times(tmp_path):
    times = np.cumsum([0, 33, 34, 100, 17, 33, 250, 33, 33, 41, 8, 33]) / 1000
    path = media.clip(tmp_path / "a.mp4", 12, times=times)
    assert video.frame_times(path) == pytest.approx(times, abs=1e-4)
    assert video.frame_times(path) == pytest.approx(np.array(_decoder_times(path)), abs=1e-9)
    assert [t for _, t, _ in video.decode_frames(path)] == pytest.approx(times, abs=1e-4)


@pytest.mark.parametrize("codec", ["h264", "hevc"])
def test_indices_are_exact_with_seeking(tmp_path, codec):
    """Sparse frames, by keyframes, are the very frames of a full pass."""
    path = tmp_path / "a.mp4"
    frames = [media.texture(96, 64, seed) for seed in range(60)]
    encode_clip(path, frames, 30, codec=codec, keyframe_every=7)
    whole = {i: rgb for i, _, rgb in video.decode_frames(path)}
    assert len(whole) == len(_decoder_times(path)) == 60
    assert len(video.keyframes(path)) >= 8
    for wanted in ([0], [59], [3, 30, 31, 58], [13, 14, 20, 21, 22], list(video.keyframes(path)), range(0, 60, 10)):
        found = list(video.decode_frames(path, wanted))
        assert [i for i, _, _ in found] == sorted(wanted)
        assert all((rgb == whole[i]).all() for i, _, rgb in found)
    assert list(video.decode_frames(path, [])) == []
    assert [i for i, _, _ in video.decode_frames(path, [5, 5, 999, -1])] == [5]


@pytest.mark.parametrize(
    "encoder,options",
    [
        ("libx265", {"x265-params": "keyint=8:min-keyint=8:open-gop=1:bframes=4:log-level=none:pools=none"}),
        ("libx264", {"x264-params": "keyint=8:min-keyint=8:open-gop=1:bframes=3:b-pyramid=normal:scenecut=0"}),
    ],
)
def test_open_groups_of_pictures(tmp_path, encoder, options):
    """B-frames that lean on the keyframe after them are found from the keyframe before."""
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(encoder, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for i in range(40):
            frame = av.VideoFrame.from_ndarray(media.texture(96, 64, i), format="rgb24").reformat(format="yuv420p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    whole = {i: rgb for i, _, rgb in video.decode_frames(path)}
    assert len(whole) == 40
    for i in range(40):
        [(found, _, rgb)] = video.decode_frames(path, [i])
        assert found == i
        assert (rgb == whole[i]).all()


def test_trimmed_clips_count_what_is_shown(tmp_path):
    """Phones trim by an edit list: the keyframe before the cut stays in the file, unseen."""
    whole, trimmed = tmp_path / "a.mp4", tmp_path / "b.mp4"
    encode_clip(whole, [media.texture(96, 64, i) for i in range(30)], 30, keyframe_every=15)
    data = bytearray(whole.read_bytes())
    at = data.find(b"elst") + 16
    start = int.from_bytes(data[at : at + 4], "big") + 10 * 90000 // 30
    data[at : at + 4] = start.to_bytes(4, "big")
    trimmed.write_bytes(bytes(data))
    full = [rgb for *_, rgb in video.decode_frames(whole)]
    assert len(_decoder_times(trimmed)) == len(video.frame_times(trimmed)) == video.open_video(trimmed).frames == 20
    assert all((rgb == full[10 + i]).all() for i, _, rgb in video.decode_frames(trimmed))
    for i in range(20):
        [(found, time, rgb)] = video.decode_frames(trimmed, [i])
        assert found == i
        assert time == pytest.approx(i / 30, abs=1e-4)
        assert (rgb == full[10 + i]).all()


def test_clips_and_decoding_repeat_bit_for_bit(tmp_path):
    for codec in ("h264", "hevc"):
        a, b = (media.clip(tmp_path / f"{name}.mp4", 12, codec=codec) for name in "ab")
        assert a.read_bytes() == b.read_bytes()
        once, again = (np.stack([rgb for *_, rgb in video.decode_frames(path)]) for path in (a, b))
        assert (once == again).all()


def test_sound_and_data_beside_the_picture(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        sound = container.add_stream("aac", rate=44100)
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for i in range(5):
            frame = av.VideoFrame.from_ndarray(media.numbered(i), format="rgb24").reformat(format="yuv420p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        samples = av.AudioFrame.from_ndarray(np.zeros((1, 2048), np.float32), format="fltp", layout="mono")
        samples.sample_rate = 44100
        for packet in [*sound.encode(samples), *sound.encode(None)]:
            container.mux(packet)
    assert video.open_video(path).frames == 5
    assert [media.number(rgb) for *_, rgb in video.decode_frames(path)] == list(range(5))


def test_no_picture_at_all(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        sound = container.add_stream("aac", rate=44100)
        samples = av.AudioFrame.from_ndarray(np.zeros((1, 2048), np.float32), format="fltp", layout="mono")
        samples.sample_rate = 44100
        for packet in [*sound.encode(samples), *sound.encode(None)]:
            container.mux(packet)
    with pytest.raises(InputError, match="holds no video"):
        video.open_video(path)


def test_shooting_time(tmp_path):
    def clip(name, **tags):
        with av.open(str(tmp_path / name), "w", options={"movflags": "use_metadata_tags"}) as container:
            container.metadata.update({key.replace("__", "."): value for key, value in tags.items()})
            stream = container.add_stream("libx264", rate=30)
            stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
            frame = av.VideoFrame.from_ndarray(media.quadrants(), format="rgb24").reformat(format="yuv420p")
            for packet in [*stream.encode(frame), *stream.encode(None)]:
                container.mux(packet)
        return video.open_video(tmp_path / name)

    assert np.isnan(clip("a.mp4").time)
    assert clip("b.mp4", creation_time="2025-03-16T14:09:26.000000Z").time == 1742134166
    local = {"com.apple.quicktime.creationdate": "2025-03-16T15:09:26+0100"}
    assert clip("c.mov", creation_time="2025-03-16T14:09:26.000000Z", **local).time == 1742137766
    placed = clip("d.mov", **{"com.apple.quicktime.location.ISO6709": "+47.3769+008.5417/"})
    assert "47.3769" not in repr(placed)


def test_bad_files_are_refused_in_one_line(tmp_path):
    for what, path in media.bad_inputs(tmp_path / AWKWARD).items():
        if what.endswith("mp4"):
            for read in (video.open_video, video.frame_times, lambda p: list(video.decode_frames(p))):
                with pytest.raises(InputError) as found:
                    read(path)
                line = str(found.value)
                assert path.name in line, what
                assert "\n" not in line, what


def test_what_cannot_be_opened(tmp_path, monkeypatch):
    path = media.clip(tmp_path / "a.mp4", 2)
    with pytest.raises(InputError, match="cannot be opened"):
        video.open_video(tmp_path / "absent.mp4")

    def refuse(self, *_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        video.open_video(path)


def test_a_copy_that_broke_off_gives_what_it_has(tmp_path):
    """With the index in front, the frames before the break are sound."""
    whole = tmp_path / "whole.mp4"
    with av.open(str(whole), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=30, options={"g": "10", "bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for i in range(60):
            frame = av.VideoFrame.from_ndarray(media.texture(96, 64, i), format="rgb24").reformat(format="yuv420p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    full = [rgb for *_, rgb in video.decode_frames(whole)]
    broken = media.without_tail(tmp_path / "broken.mp4", whole, 0.6)
    n = video.open_video(broken).frames
    assert 20 <= n <= 45, "the header still promises 60"
    found = list(video.decode_frames(broken))
    assert n - 1 <= len(found) <= n
    assert [i for i, _, _ in found] == list(range(len(found)))
    assert all((rgb == full[i]).all() for i, _, rgb in found)


def test_noise_in_the_middle_is_left_out_with_a_warning(tmp_path, caplog):
    path = tmp_path / "a.mp4"
    encode_clip(path, [media.texture(192, 128, i) for i in range(40)], 30, keyframe_every=8)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 4000] = bytes(4000)
    path.write_bytes(bytes(data))
    frames = list(video.decode_frames(path))
    found = [i for i, _, _ in frames]
    assert len(video.frame_times(path)) == 40
    assert found == sorted(set(found))
    for (i, _, rgb), (j, _, again) in zip(frames, video.decode_frames(path)):
        assert i == j
        assert (rgb == again).all()
    assert 15 <= len(found) < 40
    assert "cannot be decoded" in caplog.text


def test_square_pixels(tmp_path):
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 72, 96, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        frame = av.VideoFrame.from_ndarray(media.quadrants("ABCD", 72, 96), format="rgb24").reformat(format="yuv420p")
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)
    assert video.open_video(tmp_path / "a.mp4").size == (96, 96)
    assert next(video.decode_frames(tmp_path / "a.mp4"))[2].shape == (96, 96, 3)


def test_a_single_frame(tmp_path):
    for codec in ("h264", "hevc"):
        about = video.open_video(media.clip(tmp_path / "a.mp4", 1, codec=codec))
        assert about.frames == 1
        assert about.fps == pytest.approx(30)


def test_names():
    assert video.is_video(Path("MOV_1.MOV"))
    assert not video.is_video(Path("._MOV_1.MOV"))
    assert not video.is_video(Path("a.jpg"))


@pytest.mark.parametrize("codec", ["h264", "hevc"])
def test_the_same_frames_give_the_same_bytes(tmp_path: Path, codec: str) -> None:
    """Whatever lay in the memory before, and for rows whose length is no multiple of 64."""
    rng = np.random.default_rng(0)
    blocks = np.kron(rng.integers(0, 255, (20, 33, 3)), np.ones((16, 16, 1)))
    frames = [np.clip(blocks + rng.integers(-8, 8, blocks.shape) + k, 0, 255).astype(np.uint8) for k in range(10)]
    made, junk = set(), []
    for i in range(6):
        junk = [*junk[-2:], rng.integers(0, 255, 1_000_000 * (i + 1), np.uint8)]
        encode_clip(tmp_path / "a.mp4", frames, 10, codec=codec, quality=19)
        made.add((tmp_path / "a.mp4").read_bytes())
    assert len(made) == 1

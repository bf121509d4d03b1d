from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from captures import benchmark_photo, texture_photos
from media import exif_block, heic, photo, texture
from PIL import Image

from avatarbuild.artefacts import Capture
from avatarbuild.errors import InputError
from avatarbuild.formats.clip import encode_clip
from avatarbuild.options import CaptureOptions
from avatarbuild.progress import Silent
from avatarbuild.stages.capture import run

OPTIONS = CaptureOptions()


def face_photos(folder: Path, numbers: range) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    made = []
    for i in numbers:
        rgb = benchmark_photo(i)
        taken = f"2025:03:01 12:00:{i:02d}"
        made.append(photo(folder / f"IMG_{i:04d}.JPG", rgb[::2, ::2], exif_block(f35=26.0, taken=taken)))
    return made


def equal(a: Capture, b: Capture) -> bool:
    arrays = [(getattr(a.photos, k), getattr(b.photos, k)) for k in vars(a.photos) if k != "images"]
    same = all(np.array_equal(x, y, equal_nan=np.asarray(x).dtype.kind == "f") for x, y in arrays)
    return same and [i.data() for i in a.photos.images] == [i.data() for i in b.photos.images]


def test_photos_without_a_face_make_a_capture_without_a_face(tmp_path: Path) -> None:
    texture_photos(tmp_path / "c" / "photos", 8)
    capture = run(tmp_path / "c", OPTIONS, Silent())
    assert not capture.face
    assert (capture.frontal, capture.clip, capture.neutral.any()) == (-1, None, False)
    assert capture.photos.names == [f"IMG_{i:04d}" for i in range(8, 0, -1)]  # by the clock, not by name
    assert capture.photos.files[0] == "photos/IMG_0008.jpg"
    assert np.isnan(capture.photos.landmarks).all()
    assert np.allclose(capture.photos.focal, 26 / 43.267 * np.hypot(96, 128), rtol=0.01)
    assert any(w.startswith("face: seen well in 0 of 8 photos") for w in capture.warnings)
    assert any(w.startswith("video: none") for w in capture.warnings)
    capture.save(tmp_path / "saved")
    assert equal(Capture.load(tmp_path / "saved"), capture)
    assert equal(run(tmp_path / "c", OPTIONS, Silent()), capture)


def test_every_format_and_orientation_in_one_folder(tmp_path: Path) -> None:
    """Photos of one lens, stored in any way, are upright copies of one size."""
    for i in range(8):
        block = exif_block(orientation=i + 1, f35=26.0)
        stored = texture(96, 64, seed=i) if i < 4 else texture(64, 96, seed=i)
        photo(tmp_path / f"turned {i}.jpg", stored, block)
    photo(tmp_path / "plain.png", texture(96, 64, seed=9))
    photo(tmp_path / "tagged.tiff", texture(96, 64, seed=10))
    heic(tmp_path / "Größe.heic", texture(96, 64, seed=11), f35=26.0)
    capture = run(tmp_path, OPTIONS, Silent())
    assert len(capture.photos) == 11
    assert (capture.photos.size == (96, 64)).all()
    assert all(image.rgb().shape == (64, 96, 3) for image in capture.photos.images)
    assert "Größe" in capture.photos.names
    assert any("no focal length in 2 photos" in w for w in capture.warnings)


@pytest.mark.parametrize("count, says", [(0, "holds no photos"), (1, "holds 1 usable photos"), (3, "3 usable photos")])
def test_too_few_photos(tmp_path: Path, count: int, says: str) -> None:
    texture_photos(tmp_path, count)
    with pytest.raises(InputError, match=says) as e:
        run(tmp_path, OPTIONS, Silent())
    assert "at least 8 are needed" in str(e.value)
    assert "\n" not in str(e.value)


def spoil(path: Path, how: str) -> None:
    if how == "truncated":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif how == "text":
        path.write_text(f"{path} is no picture")
    else:
        path.write_bytes(b"")


@pytest.mark.parametrize("how", ["truncated", "text", "empty"])
def test_a_broken_photo_is_left_out_with_its_name(tmp_path: Path, how: str) -> None:
    paths = texture_photos(tmp_path, 9)
    spoil(paths[3], how)
    capture = run(tmp_path, OPTIONS, Silent())
    assert len(capture.photos) == 8
    assert [w for w in capture.warnings if "IMG_0004.jpg" in w]
    spoil(paths[4], how)
    with pytest.raises(InputError, match="7 usable photos and 2 that cannot be read"):
        run(tmp_path, OPTIONS, Silent())


def test_a_photo_that_may_not_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = texture_photos(tmp_path, 9)
    read = Path.read_bytes

    def refuse(path: Path) -> bytes:
        if path == paths[0]:
            raise PermissionError(13, "Permission denied")
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", refuse)
    capture = run(tmp_path, OPTIONS, Silent())
    assert [w for w in capture.warnings if "IMG_0001.jpg" in w and "Permission denied" in w]


def test_a_video_alone_is_not_enough(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"whatever")
    with pytest.raises(InputError, match="a video alone gives no head"):
        run(tmp_path, CaptureOptions(), Silent())


def test_a_corrupt_video_is_left_out(tmp_path: Path) -> None:
    texture_photos(tmp_path, 8)
    (tmp_path / "MOV_0001.mp4").write_bytes(os.urandom(5000))
    capture = run(tmp_path, OPTIONS, Silent())
    assert capture.clip is None
    assert [w for w in capture.warnings if "MOV_0001.mp4" in w]


def test_a_video_without_a_face_is_not_used(tmp_path: Path) -> None:
    texture_photos(tmp_path, 8)
    encode_clip(tmp_path / "wall.mp4", [texture(64, 64, seed=2)] * 20, fps=10)
    capture = run(tmp_path, OPTIONS, Silent())
    assert capture.clip is None
    assert [w for w in capture.warnings if "wall.mp4 shows a face in 0 of" in w]


def test_a_large_photo_is_scaled_and_its_lens_with_it(tmp_path: Path) -> None:
    texture_photos(tmp_path, 8)
    Image.new("RGB", (12000, 8500), (90, 120, 60)).save(tmp_path / "huge.png")
    options = CaptureOptions(max_megapixels=1.0)
    capture = run(tmp_path, options, Silent())
    i = capture.photos.names.index("huge")
    width, height = capture.photos.size[i]
    assert 0.98e6 < width * height <= 1e6
    assert capture.photos.lens[i] != capture.photos.lens[-1]


def test_settings_set_the_lens_and_a_known_length(tmp_path: Path) -> None:
    texture_photos(tmp_path, 8)
    (tmp_path / "capture.toml").write_text(
        "focal = 52\n[known_length]\nmm = 50\npoints = [{photo = 'IMG_0001.jpg', a = [0, 0], b = [9, 19]},"
        " {photo = 'img_0002.jpg', a = [0, 0], b = [1, 1]}]\n"
    )
    capture = run(tmp_path, CaptureOptions(max_megapixels=96 * 128 / 4e6), Silent())
    assert np.allclose(capture.photos.focal, 52 / 43.267 * np.hypot(48, 64), rtol=0.01)
    known = capture.settings["known_length"]
    assert known["mm"] == 50
    assert known["points"][0] == {"photo": "IMG_0001", "a": [0.25, 0.25], "b": [4.75, 9.75]}
    assert known["points"][1]["photo"] == "IMG_0002"


def test_several_captures_are_refused(tmp_path: Path) -> None:
    for i, who in enumerate(("anna", "ben")):
        texture_photos(tmp_path / who, 8, seed=100 * i)
        encode_clip(tmp_path / who / "v.mp4", [texture(32, 32)] * 3, fps=10)
    with pytest.raises(InputError, match=r"2 captures \(anna, ben\)"):
        run(tmp_path, OPTIONS, Silent())


def test_equal_names_in_different_folders_stay_apart(tmp_path: Path) -> None:
    for i, folder in enumerate("ab"):
        for j in range(4):
            path = tmp_path / folder / f"IMG_{j}.jpg"
            path.parent.mkdir(exist_ok=True)
            photo(path, texture(48, 64, seed=10 * i + j))
    capture = run(tmp_path, OPTIONS, Silent())
    assert len(set(capture.photos.names)) == 8
    assert capture.photos.names[4] == "b_IMG_0"


def test_a_face_in_photos_and_video(tmp_path: Path) -> None:
    """A face in 14 photos and a video with two people: all is filled, the subject is followed, sharp frames taken."""
    face_photos(tmp_path, range(9, 23))
    still = benchmark_photo(16)[::3, ::3][:320, :240]
    frames = []
    for i in range(20):
        rgb = np.roll(still, i, axis=1)
        smooth = np.asarray(Image.fromarray(rgb).resize((80, 106)).resize((rgb.shape[1], rgb.shape[0])))
        frames.append(rgb if i % 5 == 3 else smooth)
    encode_clip(tmp_path / "film.mp4", frames, fps=10)
    capture = run(tmp_path, CaptureOptions(frame_rate=2.0), Silent())
    assert capture.face
    assert capture.clip is not None
    assert capture.photos.names[capture.frontal] in ("IMG_0016", "IMG_0017")
    assert capture.neutral.sum() >= 10
    assert capture.photos.pose[0, 0] > 30 > -10 > capture.photos.pose[-1, 0]
    assert capture.clip.processed.tolist() == [3, 8, 13, 18]
    assert len(capture.clip.times) == 20
    assert (capture.clip.frames.presence > 0.9).all()
    assert np.isclose(capture.clip.focal, 1.12 * 26 / 43.267 * np.hypot(*capture.clip.size), rtol=0.01)
    capture.save(tmp_path / "saved")
    loaded = Capture.load(tmp_path / "saved")
    assert loaded.clip is not None
    assert np.array_equal(loaded.clip.frames.landmarks, capture.clip.frames.landmarks)

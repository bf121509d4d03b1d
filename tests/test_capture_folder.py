from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from media import texture

from avatarbuild.capture_folder import natural, open_capture, read_settings
from avatarbuild.errors import InputError
from avatarbuild.formats.clip import encode_clip


def files(root: Path, *names: str) -> Path:
    """Files of different contents; pictures and videos only by name."""
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode() * 10)
    return root


def posix(paths: list[Path]) -> list[str]:
    return [path.as_posix() for path in paths]


def test_natural_order() -> None:
    names = ["IMG_9.jpg", "IMG_10.jpg", "img_11.JPG", "a", "a1", "a1b", "a2", "B", "10", "9"]
    shuffled = names[:]
    random.Random(1).shuffle(shuffled)
    assert sorted(shuffled, key=natural) == [
        "9",
        "10",
        "a",
        "a1",
        "a1b",
        "a2",
        "B",
        "IMG_9.jpg",
        "IMG_10.jpg",
        "img_11.JPG",
    ]


def test_any_layout_spaces_and_letters_of_any_alphabet(tmp_path: Path) -> None:
    names = ["IMG_2.JPG", "IMG_10.jpg", "photos/Große Bilder/ä ö 1.png", "日本/写真 2.heic", "clips/mein film.MOV"]
    found = open_capture(files(tmp_path, *names, "notes.txt", ".hidden.jpg", "__MACOSX/x.jpg", "a/.b/c.jpg"))
    assert posix(found.photos) == ["IMG_2.JPG", "IMG_10.jpg", "photos/Große Bilder/ä ö 1.png", "日本/写真 2.heic"]
    assert posix(found.videos) == ["clips/mein film.MOV"]
    assert not found.warnings


def test_links_are_followed_and_loops_are_not(tmp_path: Path) -> None:
    files(tmp_path, "elsewhere/a.jpg", "elsewhere/b.jpg")
    root = files(tmp_path / "capture", "c.jpg")
    (root / "more").symlink_to(tmp_path / "elsewhere")
    (root / "again").symlink_to(root)
    (root / "gone.jpg").symlink_to(tmp_path / "nothing")
    assert posix(open_capture(root).photos) == ["c.jpg", "more/a.jpg", "more/b.jpg"]


def test_a_project_inside_the_capture_is_no_photo(tmp_path: Path) -> None:
    files(tmp_path, "a.jpg", "made/project.toml", "made/01-capture/photos/a.jpg", "x.avatar/y.jpg")
    assert posix(open_capture(tmp_path).photos) == ["a.jpg"]


def test_copies_are_left_out_by_name(tmp_path: Path) -> None:
    kept = ["IMG_0001.HEIC", "IMG_0002.jpg", "IMG_E0009.jpg", "PXL_5.jpg", "cat 12.jpg"]
    copies = [
        "IMG_E0001.JPG",
        "IMG_0001.jpg",
        "IMG_0002 (1).jpg",
        "IMG_0002-edited.jpg",
        "PXL_5~2.jpg",
        "PXL_5 copy.jpg",
    ]
    found = open_capture(files(tmp_path, *kept, *copies))
    assert sorted(posix(found.photos)) == sorted(kept)
    assert sorted(path.as_posix() for path, _ in found.left_out) == sorted(copies)


def test_files_of_equal_bytes_count_once(tmp_path: Path) -> None:
    files(tmp_path, "a.jpg", "b.jpg")
    (tmp_path / "z.jpg").write_bytes((tmp_path / "a.jpg").read_bytes())
    found = open_capture(tmp_path)
    assert posix(found.photos) == ["a.jpg", "b.jpg"]
    assert found.left_out == [(Path("z.jpg"), "the same file as a.jpg")]


def test_live_photos_are_no_expression_video(tmp_path: Path) -> None:
    """Short ones beside their photo; a long video that only shares a photo's name stays."""
    files(tmp_path, "IMG_1.jpg", "IMG_2.jpg")
    frames = [texture(32, 32, seed=i % 3) for i in range(60)]
    encode_clip(tmp_path / "IMG_1.mov", frames[:20], fps=10)
    encode_clip(tmp_path / "IMG_2.mov", frames, fps=10)
    found = open_capture(tmp_path)
    assert posix(found.videos) == ["IMG_2.mov"]
    assert found.left_out == [(Path("IMG_1.mov"), "the moving half of a Live Photo")]


def test_several_subjects_are_noticed(tmp_path: Path) -> None:
    for who in ("ben", "anna"):
        files(tmp_path, *(f"{who}/photos/{who}{i}.jpg" for i in range(8)), f"{who}/{who}.mp4")
    assert open_capture(tmp_path).subjects == ["anna", "ben"]


def test_photos_and_video_folders_are_one_subject(tmp_path: Path) -> None:
    files(tmp_path, *(f"photos/{i}.jpg" for i in range(9)), "video/a.mp4", "video/a.jpg")
    assert open_capture(tmp_path).subjects == []


@pytest.mark.parametrize("name, says", [("missing", "does not exist"), ("a.jpg", "is a file")])
def test_no_folder(tmp_path: Path, name: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        open_capture(files(tmp_path, "a.jpg") / name)


def test_a_folder_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files(tmp_path, "a.jpg", "sub/b.jpg")
    import os

    scan = os.scandir
    closed = {str(tmp_path / "sub")}

    def refuse(path: str) -> object:
        if str(path) in closed:
            raise PermissionError(13, "Permission denied", str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", refuse)
    found = open_capture(tmp_path)
    assert posix(found.photos) == ["a.jpg"]
    assert len(found.warnings) == 1
    assert "sub cannot be read (Permission denied)" in found.warnings[0]
    closed.add(str(tmp_path))
    with pytest.raises(InputError, match=r"cannot be read .*permissions"):
        open_capture(tmp_path)


def test_settings_choose_files(tmp_path: Path) -> None:
    files(tmp_path, "a1.jpg", "a2.jpg", "b1.jpg", "x/c.jpg", "one.mp4", "two.mp4")
    (tmp_path / "capture.toml").write_text(
        'video = "one.mp4"\nphotos = ["a*.jpg", "X/*"]\nexclude = "a2.JPG"\nfocal = 28\nfrontal = "a1.jpg"\n'
    )
    found = open_capture(tmp_path)
    assert posix(found.photos) == ["a1.jpg", "x/c.jpg"]
    assert posix(found.videos) == ["one.mp4"]
    assert found.settings["focal"] == 28
    assert posix(found.files) == ["capture.toml", "a1.jpg", "x/c.jpg", "one.mp4"]


def test_a_known_length(tmp_path: Path) -> None:
    (tmp_path / "capture.toml").write_text(
        "[known_length]\nmm = 85.6\npoints = [{photo = 'a.jpg', a = [1, 2], b = [3, 4.5]},"
        " {photo = 'b.jpg', a = [1, 2], b = [3, 4]}]\n"
    )
    known = read_settings(tmp_path)["known_length"]
    assert known["mm"] == 85.6
    assert known["points"][0] == {"photo": "a.jpg", "a": [1.0, 2.0], "b": [3.0, 4.5]}


@pytest.mark.parametrize(
    "text, says",
    [
        ("vidio = 'a.mp4'", "no setting 'vidio', did you mean 'video'"),
        ("video = 3", "video must be"),
        ("video = 'gone.mp4'", "names the video 'gone.mp4'"),
        ("photos = [1]", "photos must be a list"),
        ("focal = '26'", "35 mm equivalent"),
        ("focal = 0.5", "35 mm equivalent"),
        ("focal = true", "35 mm equivalent"),
        ("known_length = 5", "known_length must be"),
        ("known_length = {mm = 80, points = []}", "at least two photos"),
        ("known_length = {mm = -1, points = []}", "1 to 5000 mm"),
        ("what is this", "correct it or remove"),
    ],
)
def test_faulty_settings(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "capture.toml").write_text(text)
    with pytest.raises(InputError, match=says) as e:
        open_capture(tmp_path)
    assert "\n" not in str(e.value)


def test_an_empty_folder_lists_nothing(tmp_path: Path) -> None:
    found = open_capture(tmp_path)
    assert (found.photos, found.videos, found.files) == ([], [], [])
    assert np.size(found.left_out) == 0

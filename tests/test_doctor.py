from __future__ import annotations

import io
import json
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest
from captures import benchmark_photo, texture_photos
from media import exif_block, photo, texture
from rich.console import Console

from avatarbuild import coverage, doctor
from avatarbuild.errors import InputError
from avatarbuild.formats.clip import encode_clip
from avatarbuild.progress import Silent

SCHEMA = json.loads((Path(__file__).parent.parent / "docs" / "schemas" / "check.schema.json").read_text())


def examined(folder: Path) -> tuple[doctor.Checkup, dict]:
    """A checkup whose JSON obeys the schema and whose picture is one; with its lines by name."""
    checkup = doctor.examine(folder, Silent())
    value = json.loads(json.dumps(checkup.as_json()))
    jsonschema.validate(value, SCHEMA)
    picture = cv2.imdecode(np.frombuffer(checkup.picture, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (720, 1200, 3)
    return checkup, {line["name"]: line for line in value["lines"]}


def test_an_empty_folder_and_few_photos(tmp_path: Path) -> None:
    checkup, lines = examined(tmp_path)
    assert checkup.verdict == "re-shoot"
    assert lines["photos"]["values"]["count"] == 0
    texture_photos(tmp_path, 3)
    checkup, lines = examined(tmp_path)
    assert checkup.verdict == lines["face"]["verdict"] == lines["photos"]["verdict"] == "re-shoot"


def test_what_is_unreadable_or_double_is_named(tmp_path: Path) -> None:
    texture_photos(tmp_path, 4)
    (tmp_path / "IMG_0002.jpg").write_text("no picture")
    (tmp_path / "IMG_E0003.jpg").write_bytes((tmp_path / "IMG_0003.jpg").read_bytes())
    (tmp_path / "film.mov").write_text("no film")
    _, lines = examined(tmp_path)
    assert lines["unreadable"]["values"]["files"] == ["IMG_0002.jpg"]
    assert lines["copies"]["values"]["left_out"][0][0] == "IMG_E0003.jpg"
    assert "film.mov" in lines["videos"]["found"]


def test_several_subjects(tmp_path: Path) -> None:
    for i, who in enumerate(("anna", "ben")):
        texture_photos(tmp_path / who, 8, seed=100 * i)
        encode_clip(tmp_path / who / "v.mp4", [texture(32, 32)] * 3, fps=10)
    checkup, lines = examined(tmp_path)
    assert checkup.verdict == "re-shoot"
    assert lines["subjects"]["values"]["subjects"] == ["anna", "ben"]


def test_a_missing_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        doctor.examine(tmp_path / "nowhere", Silent())


def test_the_table_shows_every_line(tmp_path: Path) -> None:
    texture_photos(tmp_path, 3)
    checkup, lines = examined(tmp_path)
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(doctor.table(checkup))
    text = console.export_text()
    assert all(name in text for name in lines)
    assert "re-shoot" in text


def test_names_with_brackets_are_no_markup(tmp_path: Path) -> None:
    folder = tmp_path / "a [red]b[/nothing]"
    texture_photos(folder, 2)
    (folder / "x [bold].jpg").write_text("no picture")
    console = Console(width=300, record=True, file=io.StringIO())
    console.print(doctor.table(doctor.examine(folder, Silent())))
    text = console.export_text()
    assert "[red]b[/nothing]" in text
    assert "x [bold].jpg" in text


def test_directions_on_the_picture() -> None:
    """As one stands before the subject: their right side is left, above is up."""
    assert coverage._x(45.0) < coverage._x(0.0) < coverage._x(-45.0)
    assert coverage._y(-20.0) < coverage._y(0.0) < coverage._y(20.0)


def test_a_mirrored_video_of_a_face(tmp_path: Path) -> None:
    for i in range(10, 22):
        photo(tmp_path / f"IMG_{i:04d}.JPG", benchmark_photo(i), exif_block(f35=26.0))
    frames = [np.ascontiguousarray(benchmark_photo(i)[:800, :600][:, ::-1]) for i in (14, 15, 16, 17, 18)]
    encode_clip(tmp_path / "selfie.mp4", frames * 3, fps=5, keyframe_every=1)
    checkup, lines = examined(tmp_path)
    assert lines["mirrored"]["verdict"] == "re-shoot"
    assert lines["person in video"]["verdict"] == "good"
    assert lines["face"]["values"]["trusted"] == 12
    assert lines["yaw coverage"]["values"]["lacking"]
    assert checkup.verdict == "re-shoot"

"""The command line: exit codes, one clear line for every bad input, JSON for machines."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import pytest
from captures import texture_photos
from media import bad_inputs, huge_png

from avatarbuild import main, pipeline, project

SCHEMAS = Path(__file__).parent.parent / "docs" / "schemas"


def call(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    """Runs the program in this process; its exit code."""
    monkeypatch.setattr(sys, "argv", ["avatarbuild", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        main.run_program()
    assert isinstance(stop.value.code, int)
    return stop.value.code


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line of an error, without its wrapping."""
    text = capsys.readouterr().err
    assert "Traceback" not in text
    errors = [line for line in text.splitlines() if line.startswith("error")]
    assert len(errors) == 1, text
    return errors[0]


def valid(name: str, value: object) -> None:
    jsonschema.validate(value, json.loads((SCHEMAS / f"{name}.schema.json").read_text()))


@pytest.mark.parametrize("verb", ["run", "check"])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_photos(
    verb: str, count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "me"
    folder.mkdir()
    texture_photos(folder, count)
    code = call(monkeypatch, verb, folder)
    if verb == "check":
        assert code == 0
        assert "re-shoot" in capsys.readouterr().out
        return
    assert code == 2
    assert "8 are needed" in one_line(capsys)
    assert not list((tmp_path / "me.avatar").glob("0*"))


def test_bad_files_among_good_ones_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "Zoë été 写真"
    texture_photos(folder, 9)
    made = bad_inputs(folder / "bad files")
    code = call(monkeypatch, "run", folder, "--until", "capture", "--json")
    assert code == 0
    answer = json.loads(capsys.readouterr().out)
    valid("run", answer)
    stage = answer["stages"][0]
    assert stage["figures"]["photos"] >= 9
    told = " ".join(stage["warnings"])
    # of the same picture in several formats one is read, so names are compared without their endings
    for what, path in made.items():
        assert f"/{path.stem}." in told, what
    stamp = json.loads((project.default_project(folder) / "01-capture" / "stamp.json").read_text())
    valid("stamp", stamp)


def test_only_bad_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    bad_inputs(tmp_path / "me")
    assert call(monkeypatch, "run", tmp_path / "me", "--until", "capture") == 2
    assert "usable photos" in one_line(capsys)


def test_photos_of_nothing_in_common(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    texture_photos(tmp_path / "me", 9)
    assert call(monkeypatch, "run", tmp_path / "me") == 2
    assert "of 9 photos could be placed" in one_line(capsys)


@pytest.mark.slow
def test_a_huge_photo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    texture_photos(tmp_path / "me", 8)
    huge_png(tmp_path / "me" / "huge.png")
    assert call(monkeypatch, "run", tmp_path / "me", "--until", "capture", "--json") == 0
    figures = json.loads(capsys.readouterr().out)["stages"][0]["figures"]
    assert figures["photos"] == 9


@pytest.mark.parametrize(
    "words, says",
    [
        (["run", "nowhere"], "does not exist"),
        (["run", ".", "--from", "camera"], "did you mean 'cameras'"),
        (["run", ".", "--set", "points.widnow=5"], "did you mean 'points.window'"),
        (["run", ".", "--set", "points"], "stage.option=value"),
        (["run", ".", "--quality", "hihg"], "did you mean 'high'"),
        (["status", "."], "project.toml"),
        (["clean", "."], "project.toml"),
    ],
)
def test_wrong_use(
    words: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, *words) == 2
    assert says in one_line(capsys)


@pytest.mark.parametrize("words", [["rnu", "."], ["run"], ["run", ".", "--forse"]])
def test_wrong_words(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert call(monkeypatch, *words) == 2


def test_a_project_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    texture_photos(tmp_path / "me", 8)
    (tmp_path / "file").write_text("")
    assert call(monkeypatch, "run", tmp_path / "me", "-o", tmp_path / "file") == 2
    assert "is a file" in one_line(capsys)

    def denied(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", denied)
    assert call(monkeypatch, "run", tmp_path / "me") == 2
    assert "cannot be made: Permission denied" in one_line(capsys)


def test_a_disk_without_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    texture_photos(tmp_path / "me", 8)
    monkeypatch.setattr(project.shutil, "disk_usage", lambda _: SimpleNamespace(free=10**6))
    assert call(monkeypatch, "run", tmp_path / "me") == 2
    assert "are needed" in one_line(capsys)


def test_a_fault_of_ours_is_one_line_and_code_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(main, "_existing", broken)
    assert call(monkeypatch, "status", tmp_path) == 1
    text = capsys.readouterr().err
    assert text.startswith("fault ZeroDivisionError")
    assert len(text.splitlines()) == 1


def test_stopping_by_the_keyboard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    texture_photos(tmp_path / "me", 8)
    monkeypatch.setattr(pipeline, "run", stopped)
    assert call(monkeypatch, "run", tmp_path / "me") == 130
    assert "goes on" in capsys.readouterr().err


def test_status_and_clean(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "me"
    texture_photos(folder, 8)
    assert call(monkeypatch, "run", folder, "--until", "capture", "--set", "capture.max_megapixels=8") == 0
    place = project.default_project(folder)
    capsys.readouterr()
    assert call(monkeypatch, "status", place, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    valid("status", answer)
    assert [line["state"] for line in answer["stages"]][:2] == ["fresh", "missing"]
    (folder / "IMG_0001.jpg").unlink()
    assert call(monkeypatch, "status", place) == 0
    assert "stale" in capsys.readouterr().out
    assert call(monkeypatch, "clean", place, "--stage", "capture") == 0
    assert not (place / "01-capture").exists()


def test_template_verbs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert call(monkeypatch, "template", "list", "--json") == 0
    assert json.loads(capsys.readouterr().out)["templates"][0]["shipped"]
    assert call(monkeypatch, "template", "info", "--json") == 0
    assert json.loads(capsys.readouterr().out)["template"]["expressions"] == 52
    assert call(monkeypatch, "template", "info", "nobody") == 2
    (tmp_path / "note.pkl").write_text("no model")
    assert call(monkeypatch, "template", "import", tmp_path / "note.pkl", "-o", tmp_path / "out.npz") == 2
    assert not (tmp_path / "out.npz").exists()


def test_simulate_checks_its_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(monkeypatch, "simulate", "-o", tmp_path / "new", "--set", "fotos=3") == 2
    assert "did you mean 'photos'" in one_line(capsys)
    assert not (tmp_path / "new").exists()


def test_options_and_version(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(monkeypatch, "options", "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    valid("options", answer)
    assert {"option", "default", "draft", "high", "unit", "sentence"} == set(answer["options"][0])
    assert call(monkeypatch, "--version") == 0
    assert capsys.readouterr().out.startswith("avatarbuild ")

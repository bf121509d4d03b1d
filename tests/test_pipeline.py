"""The runner: freshness, resuming, locks, faults; with stages that cost nothing."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from avatarbuild import artefacts, options, pipeline
from avatarbuild.errors import InputError
from avatarbuild.pipeline import Stage, keys, plan, run, states
from avatarbuild.progress import Silent
from avatarbuild.project import Project, default_project, digest_files, stage_folder_name
from avatarbuild.template_files import TemplateFile, resolve


@dataclass(frozen=True)
class Number:
    """An artefact of one number."""

    value: int
    face: bool = True
    figures: dict[str, Any] = field(default_factory=lambda: {"count": 1})
    warnings: list[str] = field(default_factory=list)
    digest: str = ""

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        (folder / "number").write_text(str(self.value))

    @staticmethod
    def load(folder: Path) -> Number:
        return Number(int((folder / "number").read_text()))


given: dict[str, Any] = {}  # the template that each stage was given
told: dict[str, tuple[tuple[Any, ...], list[dict[str, Any]] | None]] = {}  # what each stage was given last


@pytest.fixture
def cheap(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The three stages replaced by sums; returns the names of the stages that ran."""
    ran: list[str] = []

    def module(name: str) -> SimpleNamespace:
        def work(*inputs: Any, stamps: list[dict[str, Any]] | None = None, template: Any = None) -> Number:
            ran.append(name)
            if template is not None:
                given[name] = template
            told[name] = (inputs, stamps)
            return Number(sum(i.value if isinstance(i, Number) else 1 for i in inputs[:-2]) + inputs[-2].amount)

        return SimpleNamespace(run=work)

    @dataclass(frozen=True)
    class Amount:
        amount: int = options.option(1, "things", "How many.", least=0)

    monkeypatch.setattr(options, "STAGE_OPTIONS", dict.fromkeys(("capture", "cameras", "points"), Amount))
    rows = (
        Stage("capture", (), Number, Amount, 1, ""),
        Stage("cameras", ("capture",), Number, Amount, 1, ""),
        Stage("points", ("capture", "cameras"), Number, Amount, 1, "", reports=True),
    )
    monkeypatch.setattr(pipeline, "STAGES", rows)
    monkeypatch.setattr(pipeline.importlib, "import_module", lambda name: module(name.rsplit(".", 1)[1]))
    return ran


def go(project: Project, settings: dict[str, str] | None = None, digest: str = "x", **words: Any) -> None:
    what = plan(words.get("first"), words.get("until"), words.get("only"), words.get("force", False))
    with project.lock():
        chosen = options.stage_options("standard", settings)
        run(project, Path("."), digest, resolve("head"), chosen, what, Silent(), lambda *_: None)


def value(project: Project, stage: str) -> int:
    return Number.load(project.folder(stage)).value


def test_runs_in_order_and_only_what_changed(tmp_path: Path, cheap: list[str]) -> None:
    project = Project(tmp_path / "p")
    go(project)
    assert cheap == ["capture", "cameras", "points"]
    assert [value(project, s) for s in cheap] == [2, 3, 6]
    cheap.clear()
    go(project)
    assert cheap == []
    go(project, {"cameras.amount": "5"})
    assert cheap == ["cameras", "points"]
    assert value(project, "points") == 10
    cheap.clear()
    go(project, {"cameras.amount": "5"}, digest="other bytes")
    assert cheap == ["capture", "cameras", "points"]


def test_first_until_only_force(tmp_path: Path, cheap: list[str]) -> None:
    project = Project(tmp_path / "p")
    go(project, until="capture")
    assert cheap == ["capture"]
    with pytest.raises(InputError, match="cameras is missing"):
        go(project, only="points")
    go(project)
    cheap.clear()
    go(project, first="cameras")
    assert cheap == ["cameras", "points"]
    cheap.clear()
    go(project, only="cameras")
    assert cheap == ["cameras"]
    cheap.clear()
    go(project, force=True)
    assert cheap == ["capture", "cameras", "points"]
    with pytest.raises(InputError, match="capture is stale"):
        go(project, {"capture.amount": "3"}, only="cameras")


def test_what_a_stage_is_given(tmp_path: Path, cheap: list[str]) -> None:
    project = Project(tmp_path / "p")
    go(project, digest="bytes of the capture")
    go(project, digest="bytes of the capture", only="points")
    (taken, _, _, _), stamps = told["points"]
    assert taken.digest == "bytes of the capture"
    assert taken.figures == {"count": 1}
    assert stamps is not None
    assert [stamp["stage"] for stamp in stamps] == ["capture", "cameras"]
    assert told["cameras"][1] is None


def test_another_template_makes_the_heads_stages_stale(tmp_path: Path) -> None:
    chosen = options.stage_options()
    before = keys("x", resolve("head").digest, chosen)
    (tmp_path / "other.npz").write_bytes(b"another head")
    after = keys("x", TemplateFile(tmp_path / "other.npz").digest, chosen)
    assert [name for name in before if before[name] != after[name]] == list(pipeline.HEAD_STAGES)


def test_states(tmp_path: Path, cheap: list[str]) -> None:
    project = Project(tmp_path / "p")
    go(project, until="cameras")
    chosen = options.stage_options("standard", {"cameras.amount": "2"})
    assert [line.state for line in states(project, keys("x", "head", chosen))] == ["fresh", "stale", "missing"]


@pytest.mark.parametrize(
    "words, hint",
    [
        ({"first": "camera"}, "did you mean 'cameras'"),
        ({"only": "poinst"}, "did you mean 'points'"),
        ({"first": "points", "until": "capture"}, "comes after"),
        ({"only": "points", "until": "capture"}, "--only"),
    ],
)
def test_wrong_plans(words: dict[str, str], hint: str) -> None:
    with pytest.raises(InputError, match=hint):
        plan(words.get("first"), words.get("until"), words.get("only"), False)


@pytest.mark.parametrize(
    "key, text, hint",
    [
        ("point.window", "5", "did you mean 'points'"),
        ("points.widnow", "5", "did you mean 'points.window'"),
        ("points.window", "wide", "a value like"),
        ("points.window", "0", "at least"),
        ("points.backend", "cpuu", "did you mean 'cpu'"),
    ],
)
def test_wrong_options(key: str, text: str, hint: str) -> None:
    with pytest.raises(InputError, match=hint):
        options.stage_options("standard", {key: text})


def test_quality_changes_options_and_settings_win() -> None:
    draft = options.stage_options("draft", {"cameras.max_features": "1234"})
    assert draft["cameras"].max_image_size < options.CamerasOptions().max_image_size
    assert draft["cameras"].max_features == 1234
    with pytest.raises(InputError, match="did you mean 'draft'"):
        options.stage_options("drat")


def test_a_full_disk_leaves_what_was_there(tmp_path: Path, cheap: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    project = Project(tmp_path / "p")
    go(project)

    def full(self: Number, folder: Path) -> None:
        folder.mkdir(parents=True)
        (folder / "number").write_text("1")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Number, "save", full)
    with pytest.raises(InputError, match=r"disk .* is full"):
        go(project, {"points.amount": "7"})
    assert value(project, "points") == 6
    assert not list(project.root.glob(".saving*"))


def test_what_a_killed_save_left_is_swept_up(tmp_path: Path, cheap: list[str]) -> None:
    project = Project(tmp_path / "p")
    go(project)
    # killed while writing, and killed between the two renames
    (project.root / ".saving-03-points").mkdir()
    (project.root / ".saving-03-points" / "number").write_text("half")
    project.folder("cameras").rename(project.root / ".replaced-02-cameras")
    cheap.clear()
    go(project)
    assert cheap == []
    assert value(project, "cameras") == 3
    assert sorted(p.name for p in project.root.iterdir()) == [".lock", "01-capture", "02-cameras", "03-points"]


def test_two_runs_do_not_share_a_project(tmp_path: Path) -> None:
    project = Project(tmp_path / "p")
    with project.lock(), pytest.raises(InputError, match="another run"), project.lock():
        pass


def test_a_killed_holder_frees_the_lock(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from avatarbuild.project import Project\n"
        "with Project(Path(sys.argv[1])).lock():\n    print('held', flush=True)\n    time.sleep(60)\n"
    )
    holder = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "p")], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline().strip() == "held"
    with pytest.raises(InputError, match="another run"), Project(tmp_path / "p").lock():
        pass
    holder.kill()
    holder.wait()
    time.sleep(0.1)
    with Project(tmp_path / "p").lock():
        pass


def test_a_capture_without_a_face_ends_after_points(
    tmp_path: Path, cheap: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    project = Project(tmp_path / "p")
    monkeypatch.setattr(Number, "load", staticmethod(lambda folder: Number(1, face=False)))
    with pytest.raises(InputError, match="no face"):
        go(project)
    assert project.stamp("points") is not None


def test_stamps_hold_dates_under_timing_only(tmp_path: Path, cheap: list[str]) -> None:
    project = Project(tmp_path / "p")
    go(project)
    stamp = project.stamp("points")
    assert stamp is not None
    timing = stamp.pop("timing")
    assert set(timing) == {"started", "seconds"}
    assert stamp["version"] == 1
    assert timing["started"][:4] not in json.dumps(stamp)


def test_a_stamp_vouches_for_its_files_and_for_itself(tmp_path: Path) -> None:
    project = Project(tmp_path)
    project.save("points", Number(7), {"key": "k", "figures": {}, "timing": {"seconds": 1.0}})
    assert project.read("points", Number).value == 7
    place = project.folder("points")
    (place / "Thumbs.db").write_text("a file manager's")
    assert project.read("points", Number).value == 7
    (place / "number").write_text("8")
    with pytest.raises(InputError, match=r"number has changed since it was made.*--from points"):
        project.read("points", Number)
    (place / "number").unlink()
    with pytest.raises(InputError, match="number is gone"):
        project.read("points", Number)
    text = (place / "stamp.json").read_text()
    (place / "stamp.json").write_text(text.replace('"seconds": 1.0', '"seconds": 2.0'))
    assert project.stamp("points") is not None
    (place / "stamp.json").write_text(text.replace('"timing": {', '"times": {'))
    assert project.stamp("points") is None
    (place / "stamp.json").write_text(text.replace('"seconds": 1.0', '"hours": 1.0'))
    assert project.stamp("points") is None
    (place / "stamp.json").write_text(text.replace('"key": "k"', '"key": "l"'))
    assert project.stamp("points") is None


@pytest.mark.parametrize(
    "text", ["", "[]", "null", "[" * 5000, '{"timing": 3}', '{"key": "k", "timing": {"seconds": "x"}}', "{}"]
)
def test_a_damaged_stamp_is_none(text: str, tmp_path: Path) -> None:
    project = Project(tmp_path)
    project.folder("points").mkdir()
    (project.folder("points") / "stamp.json").write_text(text)
    assert project.stamp("points") is None


@pytest.mark.parametrize("text", ["\xff", "a = ", "quality = 3", "options = 'x'", "[options]\na = 1", "[" * 5000])
def test_damaged_settings_are_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "project.toml").write_bytes(text.encode("latin1"))
    with pytest.raises(InputError, match=r"project\.toml"):
        Project(tmp_path).settings()


def test_digest_is_of_names_and_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).write_text(name)
    first = digest_files(tmp_path, [tmp_path / "a", tmp_path / "b"])
    assert digest_files(tmp_path, [tmp_path / "b", tmp_path / "a"]) == first
    (tmp_path / "b").write_text("c")
    assert digest_files(tmp_path, [tmp_path / "a", tmp_path / "b"]) != first


def test_settings_survive_odd_names(tmp_path: Path) -> None:
    project = Project(tmp_path / "prôjet d'été")
    project.root.mkdir()
    capture = tmp_path / 'Zoë "1" фото'
    project.write_settings(capture, TemplateFile(tmp_path / "têtes" / "a.npz"), "draft", {"points.window": "6"})
    kept = project.settings()
    assert (project.root / kept["capture"]).resolve() == capture.resolve()
    assert (project.root / kept["template"]).resolve() == tmp_path / "têtes" / "a.npz"
    assert kept["quality"] == "draft"
    assert kept["options"] == {"points.window": "6"}
    assert default_project(Path("x/me")).name == "me.avatar"
    assert stage_folder_name("details") == "09-details"
    assert stage_folder_name("avatar") == "avatar"


def test_the_project_names_its_template(tmp_path: Path) -> None:
    project = Project(tmp_path / "p")
    project.root.mkdir()
    assert project.template() == resolve("head")
    project.write_settings(tmp_path, resolve("head"), "draft", {})
    assert project.settings()["template"] == "head"
    assert project.template().shipped
    (tmp_path / "a.npz").write_bytes(b"")
    project.write_settings(tmp_path, resolve(tmp_path / "a"), "draft", {})
    assert project.settings()["template"] == "../a.npz"
    assert project.template().digest == TemplateFile(tmp_path / "a.npz").digest
    (tmp_path / "a.npz").unlink()
    with pytest.raises(InputError, match="no such template"):
        project.template()


def test_the_heads_stages_are_given_the_template(
    tmp_path: Path, cheap: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "HEAD_STAGES", ("points",))
    asked: list[Path] = []
    monkeypatch.setattr(TemplateFile, "load", lambda self: asked.append(self.path) or "the head")
    go(Project(tmp_path / "p"), until="cameras")
    assert asked == []
    go(Project(tmp_path / "p"))
    go(Project(tmp_path / "p"))
    assert asked == [resolve("head").path]
    assert given == {"points": "the head"}


def test_a_template_that_cannot_serve_is_refused_before_the_first_stage(
    tmp_path: Path, cheap: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "HEAD_STAGES", ("points",))

    def refuse(self: TemplateFile) -> None:
        raise InputError("no teeth")

    monkeypatch.setattr(TemplateFile, "load", refuse)
    with pytest.raises(InputError, match="no teeth"):
        go(Project(tmp_path / "p"))
    assert cheap == []
    go(Project(tmp_path / "p"), until="cameras")
    assert cheap == ["capture", "cameras"]


def test_every_stage_row_has_its_function_and_options() -> None:
    for stage in pipeline.STAGES:
        assert (Path(pipeline.__file__).parent / "stages" / f"{stage.name}.py").is_file()
        assert options.STAGE_OPTIONS[stage.name] is stage.options
        assert hasattr(stage.makes, "load")
    assert issubclass(pipeline.STAGES[0].makes, artefacts.Capture)

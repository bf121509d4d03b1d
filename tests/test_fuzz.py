"""
Captures and project folders that are damaged in every way: no traceback, no hang, exit code 0 or 2.

Every case is a seed. AVATARBUILD_FUZZ_PROJECT names a finished project of examples/small for the long proof, which
otherwise makes one.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic
from captures import texture_photos
from media import clip

ROOT = Path(__file__).parent.parent
LIMIT = 300.0  # seconds that a case may take; the first of a kind compiles its kernels
SHORT = 15

# runs the program on one list of words a line, in one process, since to begin costs more than most cases
RUNNER = """
import contextlib, io, json, sys
sys.path.insert(0, sys.argv[1])
from avatarbuild import main
for line in sys.stdin:
    said, printed = io.StringIO(), io.StringIO()
    sys.argv = ["avatarbuild", *json.loads(line)]
    main.screen.file = None
    code = None
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(said):
        try:
            main.run_program()
        except SystemExit as stop:
            code = stop.code
        except BaseException as error:
            said.write(f"Traceback: {error!r}")
    print(json.dumps({"code": code, "text": said.getvalue() + printed.getvalue()}), flush=True)
"""


class Runner:
    """The program in a process that is begun again where it dies or hangs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process: subprocess.Popen[str] | None = None
        self.answers: queue.Queue[str] = queue.Queue()

    def __call__(self, words: list[str], limit: float = LIMIT) -> dict[str, Any]:
        if self.process is None or self.process.poll() is not None:
            environment = {**os.environ, "AVATARBUILD_TRACEBACK": ""}
            self.process = subprocess.Popen(
                [sys.executable, "-c", RUNNER, str(ROOT)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=(self.folder / "chatter").open("ab"),
                text=True,
                env=environment,
                cwd=self.folder,
            )
            self.answers = queue.Queue()
            threading.Thread(target=self._listen, args=(self.process, self.answers), daemon=True).start()
        assert self.process.stdin
        self.process.stdin.write(json.dumps(words) + "\n")
        self.process.stdin.flush()
        try:
            answer = self.answers.get(timeout=limit)
        except queue.Empty:
            self.process.kill()
            self.process.wait()
            return {"code": "hangs", "text": ""}
        if not answer:
            return {"code": f"the process ended with {self.process.wait()}", "text": ""}
        return json.loads(answer)

    @staticmethod
    def _listen(process: subprocess.Popen[str], answers: queue.Queue[str]) -> None:
        assert process.stdout
        for line in process.stdout:
            answers.put(line)
        answers.put("")

    def close(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Any:
    runner = Runner(tmp_path_factory.mktemp("fuzz"))
    yield runner
    runner.close()


# ---- what befalls a file: path, generator


def _bytes(path: Path, change: Callable[[bytearray, np.random.Generator], bytes], rng: np.random.Generator) -> None:
    data = bytearray(path.read_bytes())
    path.unlink()  # it may be a link to the original's bytes
    path.write_bytes(change(data, rng))


def truncated(path: Path, rng: np.random.Generator) -> None:
    _bytes(path, lambda data, rng: bytes(data[: int(rng.integers(0, max(len(data), 1)))]), rng)


def emptied(path: Path, rng: np.random.Generator) -> None:
    _bytes(path, lambda data, rng: b"", rng)


def flipped(path: Path, rng: np.random.Generator) -> None:
    def change(data: bytearray, rng: np.random.Generator) -> bytes:
        for at in rng.integers(0, max(len(data), 1), 3):
            if data:
                data[at] ^= 1 << int(rng.integers(8))
        return bytes(data)

    _bytes(path, change, rng)


def garbled(path: Path, rng: np.random.Generator) -> None:
    def change(data: bytearray, rng: np.random.Generator) -> bytes:
        at = int(rng.integers(0, max(len(data), 1)))
        data[at : at + 400] = rng.bytes(min(400, len(data) - at))
        return bytes(data)

    _bytes(path, change, rng)


def head_garbled(path: Path, rng: np.random.Generator) -> None:
    """The first 300 bytes are where EXIF and containers' tables are."""

    def change(data: bytearray, rng: np.random.Generator) -> bytes:
        for at in rng.integers(2, max(min(len(data), 300), 3), 12):
            if at < len(data):
                data[at] = int(rng.integers(256))
        return bytes(data)

    _bytes(path, change, rng)


def noise(path: Path, rng: np.random.Generator) -> None:
    _bytes(path, lambda data, rng: rng.bytes(2000), rng)


def removed(path: Path, rng: np.random.Generator) -> None:
    path.unlink()


def folder_instead(path: Path, rng: np.random.Generator) -> None:
    path.unlink()
    path.mkdir()


def dangling(path: Path, rng: np.random.Generator) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def swapped(path: Path, rng: np.random.Generator) -> None:
    """Another file's bytes under this name."""
    others = [other for other in sorted(path.parent.rglob("*")) if other.is_file() and other != path]
    if others:
        data = others[int(rng.integers(len(others)))].read_bytes()
        path.unlink()
        path.write_bytes(data)


def renamed(path: Path, rng: np.random.Generator) -> None:
    path.rename(path.with_suffix(str(rng.choice([".png", ".heic", ".mp4", ".txt", ".tif", ".JPG", ".dng", ".mov"]))))


def unreadable(path: Path, rng: np.random.Generator) -> None:
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data)
    path.chmod(0)


DAMAGE = (
    truncated,
    emptied,
    flipped,
    garbled,
    head_garbled,
    noise,
    removed,
    folder_instead,
    dangling,
    swapped,
    unreadable,
)

SETTINGS = (
    "",
    "focal = 0",
    "focal = nan",
    "focal = 1e400",
    'focal = "wide"',
    "focal = [26]",
    'video = "photos"',
    'video = "../../etc/passwd"',
    'video = ["a", "b"]',
    'frontal = "IMG_0001.jpg"',
    'frontal = "IMG_9999.jpg"',
    'photos = "*"\nexclude = "*"',
    "photos = []",
    "photos = [1, 2]",
    'exclude = ["[", "**", ""]',
    "known_length = 85",
    "known_length = {mm = 85.6, points = []}",
    'known_length = {mm = 85.6, points = [{photo = "IMG_0001.jpg", a = [1e9, -1], b = [2, nan]}]}',
    "[focal]\nx = 1",
    "focal = 26\nfocal = 27",
    "\x00\x01",
    "a" * 100_000,
    "= = =",
    "focl = 26",
)
NESTED = "[" * 5000


def damaged_capture(folder: Path, source: Path, rng: np.random.Generator) -> str:
    """A copy of a capture with one to three faults; what they are."""
    shutil.copytree(source, folder)
    told = []
    for _ in range(int(rng.integers(1, 4))):
        files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink()]
        kind = rng.integers(10)
        if kind < 6:
            path = files[int(rng.integers(len(files)))]
            what = (*DAMAGE, renamed)[int(rng.integers(len(DAMAGE) + 1))]
            if os.access(path, os.R_OK):
                what(path, rng)
            told.append(f"{path.name} {what.__name__}")
        elif kind < 8:
            text = SETTINGS[int(rng.integers(len(SETTINGS)))]
            (folder / "capture.toml").write_bytes(text.encode())
            told.append(f"capture.toml: {text[:60]!r}")
        elif kind == 8:
            _absurd(folder, rng)
            told.append("absurd pictures")
        else:
            for path in files[7:]:
                path.unlink()
            told.append("most files removed")
    return ", ".join(told)


def _absurd(folder: Path, rng: np.random.Generator) -> None:
    """Pictures of one pixel, of one row, and one that claims to be of 60000 x 60000."""
    import cv2

    cv2.imwrite(str(folder / "one.png"), np.zeros((1, 1, 3), np.uint8))
    cv2.imwrite(str(folder / "row.jpg"), np.zeros((1, 5000, 3), np.uint8))
    cv2.imwrite(str(folder / "huge.png"), np.zeros((4, 4), np.uint8))
    data = bytearray((folder / "huge.png").read_bytes())
    data[16:24] = (60000).to_bytes(4, "big") * 2
    (folder / "huge.png").write_bytes(bytes(data))


def damaged_project(folder: Path, source: Path, rng: np.random.Generator) -> str:
    """A copy of a project with one fault; what it is."""
    linked = lambda a, b: os.link(a, b)  # noqa: E731
    shutil.copytree(source, folder, copy_function=linked)
    for name in ("project.toml", "avatarbuild.log"):
        (folder / name).unlink()
        shutil.copy2(source / name, folder / name)
    stages = [path for path in sorted(folder.iterdir()) if path.is_dir()]
    kind = int(rng.integers(12))
    if kind == 0:
        path = folder / "project.toml"
        what = DAMAGE[int(rng.integers(len(DAMAGE)))]
        what(path, rng)
        return f"project.toml {what.__name__}"
    if kind == 1:
        texts = ("{}", "[]", NESTED, '{"version": 1, "photos": 3}', '{"version": 99}', "nonsense")
        text = texts[int(rng.integers(len(texts)))]
        (folder / "corrections.json").write_text(text)
        return f"corrections.json: {text[:40]}"
    stage = stages[int(rng.integers(len(stages)))]
    if kind == 2:
        shutil.rmtree(stage)
        stage.write_text("a file where a folder is expected")
        return f"{stage.name} is a file"
    if kind <= 5:
        text = _tampered((stage / "stamp.json").read_text(), rng)
        (stage / "stamp.json").unlink()
        (stage / "stamp.json").write_text(text)
        return f"{stage.name}/stamp.json tampered: {text[:60]!r}"
    files = [path for path in sorted(stage.rglob("*")) if path.is_file()]
    path = files[int(rng.integers(len(files)))]
    what = DAMAGE[int(rng.integers(len(DAMAGE)))]
    what(path, rng)
    return f"{path.relative_to(folder)} {what.__name__}"


def _tampered(text: str, rng: np.random.Generator) -> str:
    stamp = json.loads(text)
    key = sorted(stamp)[int(rng.integers(len(stamp)))]
    values: list[Any] = [None, "x", [], {}, -1, float("nan"), {"seconds": "long"}, {"photos": [[["deep"]]]}]
    if rng.random() < 0.2:
        return str(rng.choice(["", "null", "[]", "{}", "{", NESTED]))
    if rng.random() < 0.3:
        del stamp[key]
    else:
        stamp[key] = values[int(rng.integers(len(values)))]
    if rng.random() < 0.5:
        stamp.pop("seal", None)  # as an older version would have left it
    return json.dumps(stamp)


# ---- the cases


def fault(program: Runner, words: list[str], what: str) -> list[str]:
    """[] where the program answers as it should."""
    answer = program(words)
    text = answer["text"]
    errors = sum(line.startswith("error") for line in text.splitlines())
    if answer["code"] in (0, 2) and "Traceback" not in text and errors == (answer["code"] == 2):
        return []
    return [f"{what}: `{' '.join(words)}` ends with {answer['code']}: {text[-600:]}"]


def tiny_capture(folder: Path) -> Path:
    texture_photos(folder / "photos", 10)
    (folder / "video").mkdir()
    clip(folder / "video" / "MOV_0001.mp4", 12)
    return folder


def try_captures(program: Runner, folder: Path, seeds: range) -> None:
    source, faults = tiny_capture(folder / "source"), []
    for seed in seeds:
        rng = np.random.default_rng([1, seed])
        capture = folder / f"c{seed}"
        what = f"capture {seed}: {damaged_capture(capture, source, rng)}"
        faults += fault(program, ["run", str(capture), "--until", "capture"], what)
        if seed % 3 == 0:
            faults += fault(program, ["check", str(capture)], what)
        _forget(capture)
        _forget(capture.with_name(f"{capture.name}.avatar"))
    assert not faults, f"{len(faults)}\n" + "\n".join(faults)


def try_projects(
    program: Runner, folder: Path, source: Path, capture: Path, late: list[list[str]], seeds: range
) -> None:
    """Every case shows its status and goes on with one of the commands `late`, PROJECT and CAPTURE filled in."""
    faults = []
    for seed in seeds:
        rng = np.random.default_rng([2, seed])
        project = folder / f"p{seed}.avatar"
        what = f"project {seed}: {damaged_project(project, source, rng)}"
        faults += fault(program, ["status", str(project)], what)
        places = {"PROJECT": str(project), "CAPTURE": str(capture)}
        words = [places.get(word, word) for word in late[int(rng.integers(len(late)))]]
        faults += fault(program, words, what)
        _forget(project)
    assert not faults, f"{len(faults)}\n" + "\n".join(faults)


def _forget(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    if folder.is_file():
        folder.unlink()


def test_damaged_captures(tmp_path: Path, program: Runner) -> None:
    try_captures(program, tmp_path, range(SHORT * 2 // 3))


def test_damaged_projects(tmp_path: Path, program: Runner) -> None:
    capture = synthetic.capture(3)
    project = tmp_path / "whole.avatar"
    assert program(["run", str(capture), "-o", str(project), "--until", "cameras", "--quality", "draft"])["code"] == 0
    again = ["run", "CAPTURE", "-o", "PROJECT"]
    late = [[*again, "--only", "cameras"], [*again, "--until", "cameras"], ["clean", "PROJECT"]]
    try_projects(program, tmp_path, project, capture, late, range(SHORT - SHORT * 2 // 3))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("ten", range(10))
def test_a_hundred_damaged_captures(ten: int, tmp_path: Path, program: Runner) -> None:
    try_captures(program, tmp_path, range(1000 + 10 * ten, 1010 + 10 * ten))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, program: Runner) -> Path:
    """A project of examples/small with every stage, of draft quality."""
    project = tmp_path_factory.mktemp("finished") / "whole.avatar"
    named = os.environ.get("AVATARBUILD_FUZZ_PROJECT")
    words = ["run", str(ROOT / "examples" / "small"), "-o", str(project), "--quality", "draft"]
    if named:
        shutil.copytree(named, project)
        words += ["--until", "capture"]
    made = program(words, limit=6 * LIMIT)
    assert made["code"] == 0, made["text"]
    return project


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("ten", range(10))
def test_a_hundred_damaged_projects(ten: int, tmp_path: Path, finished: Path, program: Runner) -> None:
    weights = tmp_path / "weights.csv"
    weights.write_text("frame,jawOpen\n0,0.0\n1,0.5\n")
    again = ["run", "CAPTURE", "-o", "PROJECT", "--only"]
    late = [
        *([*again, stage] for stage in ("blendshapes", "avatar", "details", "refinement")),
        ["status", "PROJECT", "--json"],
        ["clean", "PROJECT"],
        ["animate", "PROJECT", str(weights), "-o", str(tmp_path / "clip.mp4"), "--size", "64x80"],
    ]
    seeds = range(1000 + 10 * ten, 1010 + 10 * ten)
    try_projects(program, tmp_path, finished, ROOT / "examples" / "small", late, seeds)

"""A run that is killed at any moment resumes, and ends in the same bytes as an unbroken run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import synthetic

ROOT = Path(__file__).parent.parent
DRAFT = ["--quality", "draft", "--set", "points.min_views=2"]


def contents(project: Path) -> dict[str, bytes]:
    """Every artefact's bytes; of stamps all but `timing`, and not the report, which shows seconds."""
    found = {}
    for path in sorted(project.rglob("*")):
        name = path.relative_to(project).as_posix()
        if not path.is_file() or name in (".lock", "avatarbuild.log", "project.toml", "avatar/report.html"):
            continue
        data = path.read_bytes()
        if path.name == "stamp.json":
            data = json.dumps({k: v for k, v in json.loads(data).items() if k != "timing"}).encode()
        found[name] = data
    return found


def start(capture: Path, project: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, str(ROOT / "cli.py"), "run", str(capture), "-o", str(project), *DRAFT]
    environment = {**os.environ, "AVATARBUILD_TRACEBACK": "1"}
    with project.with_name(f"{project.name} said").open("ab") as said:
        return subprocess.Popen(command, stdout=said, stderr=said, env=environment)


def finish(capture: Path, project: Path) -> None:
    code = start(capture, project).wait()
    said = project.with_name(f"{project.name} said").read_text(errors="replace")
    assert code == 0, f"{code}: {said[-8000:]}"


def prove(capture: Path, folder: Path, kills: int, seed: int) -> None:
    """Kills `kills` runs at random moments and compares what they end in with an unbroken run."""
    clock = time.monotonic()
    finish(capture, folder / "whole")
    length = time.monotonic() - clock
    whole = contents(folder / "whole")
    assert "avatar/avatar.glb" in whole
    rng = np.random.default_rng(seed)
    for number in range(kills):
        project = folder / f"killed {number}"
        run = start(capture, project)
        time.sleep(rng.uniform(0, length))
        run.kill()
        run.wait()
        finish(capture, project)
        again = contents(project)
        assert sorted(again) == sorted(whole)
        different = [name for name in whole if whole[name] != again[name]]
        assert not different, f"kill {number}: {different}"


@pytest.mark.timeout(1500)
def test_a_killed_run_ends_in_the_same_bytes(tmp_path: Path) -> None:
    prove(synthetic.capture(3, photos=16, photo_width=360), tmp_path, kills=1, seed=0)


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_twenty_killed_runs(tmp_path: Path) -> None:
    named = os.environ.get("AVATARBUILD_KILL_CAPTURE")
    prove(Path(named) if named else ROOT / "examples" / "small", tmp_path, kills=20, seed=1)

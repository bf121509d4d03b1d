"""Runs from scratch give the same bytes, whatever the number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_kill import ROOT, contents

from avatarbuild.batch.subject import one_share


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_the_same_bytes_twice_and_with_one_and_two_threads(tmp_path: Path) -> None:
    """The example capture, of draft quality; AVATARBUILD_TWICE names another capture."""
    capture = Path(os.environ.get("AVATARBUILD_TWICE", ROOT / "examples" / "small"))
    made = {}
    for name, threads in (("two threads", 2), ("one thread", 1), ("two threads again", 2)):
        project = tmp_path / name
        command = [sys.executable, str(ROOT / "cli.py"), "run", str(capture), "-o", str(project), "--quality", "draft"]
        environment = {**os.environ, **one_share(threads)}
        assert subprocess.run(command, env=environment, capture_output=True).returncode == 0
        made[name] = contents(project)
        first = made["two threads"]
        assert sorted(made[name]) == sorted(first)
        different = [file for file in first if first[file] != made[name][file]]
        assert not different, f"{name}: {different}"
    assert "avatar/avatar.glb" in made["one thread"]

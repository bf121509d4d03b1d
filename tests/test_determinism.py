"""Runs from scratch give the same bytes, whatever the number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_kill import ROOT, contents

from avatarbuild.batch.subject import one_share

MATCHING = """
import sys
import numpy as np
from avatarbuild.geometry import patchmatch
rng = np.random.default_rng(3)
shape, f = (60, 80), np.float32
smooth = rng.uniform(0, 255, (16, 21)).repeat(4, 0).repeat(4, 1)[:60, :80].astype(f)
smooth += rng.normal(0, 2, shape).astype(f)
M = np.eye(3, dtype=f)[None].repeat(3, 0)
k = np.array([[90, 0, 0], [-90, 10, 0], [0, 90, 0.01]], f)
back = np.concatenate([M, -k[:, :, None]], axis=2)
size = np.full(3, 60 * 80)
grey = np.concatenate([np.roll(smooth, (i, 2 * i), (0, 1)).ravel() for i in range(3)])
start = np.arange(3) * 60 * 80
src = patchmatch.Sources(grey, start, np.full(3, 80), np.full(3, 60), M, k, back, np.zeros((0, 3), f))
pixels = np.argwhere(np.ones(shape, bool)).astype(np.int32)
low, high = np.full(shape, 0.001, f), np.full(shape, 0.1, f)
planes, cost = np.zeros((*shape, 3), f), np.full(shape, 2, f)
patchmatch.random_planes(planes, pixels, low, high, f(90), 5)
win = patchmatch.window(4)
patchmatch.plane_costs(smooth, pixels, planes, cost, win, src, 2, f(0))
first = cost.copy()
patchmatch.sweep(smooth, pixels, planes, cost, low, high, f(90), win, src, 2, f(0), False, 3, 2, f(0.1), f(1), 7)
sys.stdout.buffer.write(first.tobytes() + planes.tobytes() + cost.tobytes())
"""


def test_kernels_just_compiled_and_from_the_cache_give_the_same_bytes(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", MATCHING]
    compiled, cached = (subprocess.run(command, env=environment, capture_output=True, check=True) for _ in range(2))
    assert len(compiled.stdout) == 60 * 80 * 5 * 4
    assert compiled.stdout == cached.stdout


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_the_same_bytes_twice_and_with_one_and_two_threads(tmp_path: Path) -> None:
    """
    The example capture, of draft quality, the first time with kernels that are compiled on the way; AVATARBUILD_TWICE
    names another capture.
    """
    capture = Path(os.environ.get("AVATARBUILD_TWICE", ROOT / "examples" / "small"))
    made = {}
    for name, threads in (("two threads", 2), ("one thread", 1), ("two threads again", 2)):
        project = tmp_path / name
        command = [sys.executable, str(ROOT / "cli.py"), "run", str(capture), "-o", str(project), "--quality", "draft"]
        environment = {**os.environ, **one_share(threads), "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
        assert subprocess.run(command, env=environment, capture_output=True).returncode == 0
        made[name] = contents(project)
        first = made["two threads"]
        assert sorted(made[name]) == sorted(first)
        different = [file for file in first if first[file] != made[name][file]]
        assert not different, f"{name}: {different}"
    assert "avatar/avatar.glb" in made["one thread"]

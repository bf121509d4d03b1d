"""What benchmarks share: where the captures, their truth and the scorer of avatars lie, and the scorer itself."""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType


def benchmark(name: str = "") -> Path | None:
    """The path of `name` in the folder that AVATARBUILD_BENCHMARK names; None where it names none."""
    home = os.environ.get("AVATARBUILD_BENCHMARK")
    return Path(home) / name if home else None


def arguments(description: str | None) -> argparse.ArgumentParser:
    """PROJECT, --truth and --scorer, by default those of the folder that AVATARBUILD_BENCHMARK names."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("--truth", type=Path, default=benchmark("truth_b"))
    parser.add_argument("--scorer", type=Path, default=benchmark("score.py"))
    return parser


def scored(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The parsed arguments; an error where the truth or the scorer is not named."""
    a = parser.parse_args()
    if a.truth is None or a.scorer is None:
        parser.error("give --truth and --scorer, or set AVATARBUILD_BENCHMARK")
    return a


def load_scorer(path: Path) -> ModuleType:
    """The scorer's module from its file."""
    spec = importlib.util.spec_from_file_location("scorer", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["scorer"] = module
    spec.loader.exec_module(module)
    return module

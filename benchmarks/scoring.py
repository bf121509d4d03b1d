"""What benchmarks against the scorer of avatars share: where it and the truth lie, and the scorer itself."""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType


def arguments(description: str | None) -> argparse.ArgumentParser:
    """PROJECT, --truth and --scorer, by default those of the folder that AVATARBUILD_BENCHMARK names."""
    home = os.environ.get("AVATARBUILD_BENCHMARK")
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("--truth", type=Path, default=Path(home) / "truth_b" if home else None)
    parser.add_argument("--scorer", type=Path, default=Path(home) / "score.py" if home else None)
    return parser


def scored(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The parsed arguments; an error where the truth or the scorer is not named."""
    a = parser.parse_args()
    if a.truth is None or a.scorer is None:
        parser.error("give --truth and --scorer, or set AVATARBUILD_BENCHMARK")
    return a


def load_scorer(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("scorer", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["scorer"] = module
    spec.loader.exec_module(module)
    return module

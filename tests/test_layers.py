"""The architecture as a test: what may import what, formatting, types."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "avatarbuild"
PURE = ("geometry", "energies", "solvers")


def imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name.startswith("avatarbuild.")}


@pytest.mark.parametrize("layer", PURE)
def test_numerics_import_nothing_above_them(layer: str) -> None:
    allowed = ("avatarbuild.geometry",) if layer == "geometry" else ("avatarbuild.geometry", f"avatarbuild.{layer}")
    for path in sorted((PACKAGE / layer).rglob("*.py")):
        for name in imports(path):
            assert name.startswith(allowed) or name == "avatarbuild.errors", f"{path.name} imports {name}"
        tree = ast.parse(path.read_text(encoding="utf-8"))
        calls = {n.func.id for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)}
        assert not calls & {"open", "print"}, f"{path.name} opens files or prints"


def test_stages_do_not_know_the_pipeline() -> None:
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.name not in ("main.py", "__main__.py") and path.parent.name != "batch":
            above = {"avatarbuild.pipeline", "avatarbuild.main"} & imports(path)
            assert not above, f"{path.name} imports {above}"


def test_module_names_are_things() -> None:
    for path in PACKAGE.rglob("*.py"):
        assert path.stem not in {"utils", "helpers", "common", "misc"}


@pytest.mark.parametrize("command", [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["mypy"]])
def test_style_and_types(command: list[str]) -> None:
    done = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]

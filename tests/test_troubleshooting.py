"""docs/troubleshooting.md lists every error: what a user sees can be looked up."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "avatarbuild"


def said(node: ast.expr) -> str:
    """A message with … for what varies."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(said(value) for value in node.values)
    if isinstance(node, ast.BinOp):
        return said(node.left) + said(node.right)
    return "…"


def messages() -> dict[str, str]:
    """Every message of an InputError -> where it is raised."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Raise) or not isinstance(node.exc, ast.Call):
                continue
            if isinstance(node.exc.func, ast.Name) and node.exc.func.id == "InputError":
                text = re.sub("…+", "…", said(node.exc.args[0])).replace("`", "").strip()
                found[text] = f"{path.relative_to(PACKAGE)}:{node.lineno}"
    return found | _too_few()


def _too_few() -> dict[str, str]:
    """Those of a stage that puts its message together in a function of its own."""
    path = PACKAGE / "stages" / "capture.py"
    functions = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)]
    returns = [node for f in functions if f.name == "_too_few" for node in ast.walk(f) if isinstance(node, ast.Return)]
    return {said(node.value): f"stages/capture.py:{node.lineno}" for node in returns if node.value is not None}


def test_every_error_can_be_looked_up() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    missing = [f"- `{text}`   ({where})" for text, where in messages().items() if len(text) > 12 and text not in page]
    assert not missing, "add to docs/troubleshooting.md:\n" + "\n".join(missing)


def test_no_error_is_listed_that_is_gone() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    listed = re.findall(r"^- `(.+)`", page, re.MULTILINE)
    there = set(messages())
    assert len(listed) > 150
    gone = [text for text in listed if text not in there]
    assert not gone, "no longer said: " + ", ".join(gone)

"""The pages hold together: links lead somewhere, the method's table names what is there, README knows every page."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        if not target.startswith(("http:", "https:")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_readme_knows_every_page() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [page.name for page in PAGES[1:] if f"docs/{page.name}" not in text] == []


def test_benchmarks_that_are_named_are_there() -> None:
    for page in PAGES:
        for name in re.findall(r"benchmarks/(\w+\.py)", page.read_text(encoding="utf-8")):
            assert (ROOT / "benchmarks" / name).is_file(), f"{page.name}: {name}"


def test_the_method_names_what_is_there() -> None:
    rows = re.findall(r"^\|(.+)\|$", (ROOT / "docs" / "method.md").read_text(encoding="utf-8"), re.MULTILINE)
    for row in rows[2:]:
        what, _, variables, files = [cell.strip() for cell in row.split("|")]
        paths = [ROOT / "avatarbuild" / name.strip() for name in files.split(",")]
        for path in paths:
            assert path.is_file(), f"{what}: {path}"
        source = "".join(path.read_text(encoding="utf-8") for path in paths)
        for name in re.findall(r"`(\w+)`", variables):
            assert re.search(rf"\b{name}\b", source) or any(path.stem == name for path in paths), f"{what}: {name}"

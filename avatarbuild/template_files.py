"""Which file a template's name means, and whether the stages can use what it holds."""

from __future__ import annotations

import difflib
import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from avatarbuild.errors import InputError

if TYPE_CHECKING:  # numpy and scipy are imported where a template is read
    from avatarbuild.template import Template

SHIPPED = "head"


@dataclass(frozen=True)
class TemplateFile:
    """A template on disk, as a project chooses it: the shipped head unless another is named."""

    path: Path

    @property
    def shipped(self) -> bool:
        """Whether it came with the program."""
        return self.path == _shipped_head()

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the file's bytes."""
        with self.path.open("rb") as f:
            return hashlib.file_digest(f, "sha256").hexdigest()

    def load(self) -> Template:
        """
        The template, fit for every stage.

        Raises InputError where the file holds no template, or one without eyeballs, teeth, gums or tongue.
        """
        from avatarbuild.template import PART_NAMES, Template

        template = Template.load(self.path)
        missing = [name for name in PART_NAMES if name not in template.parts]
        if missing:
            raise InputError(
                f"template {self.path} has no {', '.join(missing)}, which stages from neutral on need: make it with "
                "`avatarbuild template import`, which adds what a model lacks"
            )
        return template


def resolve(name: str | Path) -> TemplateFile:
    """
    The template of a name: the shipped head's name, a .npz with or without its ending, or a folder that holds one.

    Raises InputError where there is none or more than one; the message names the nearest.
    """
    path = Path(name)
    if str(name) == SHIPPED:
        return TemplateFile(_shipped_head())
    for file in (path, path.with_name(path.name + ".npz") if path.name else path):
        if file.is_file():
            return TemplateFile(file)
    if path.is_dir():
        inside = templates_in(path)
        if len(inside) == 1:
            return TemplateFile(inside[0])
        found = f"{len(inside)} templates ({', '.join(p.name for p in inside)})" if inside else "no template"
        raise InputError(f"the folder {path} holds {found}, one is needed: name a .npz, or '{SHIPPED}'")
    beside = [str(p if path.suffix else p.with_suffix("")) for p in templates_in(path.parent)]
    close = difflib.get_close_matches(str(name), [SHIPPED, *beside], n=1, cutoff=0.4)
    hint = f"did you mean '{close[0]}'?" if close else f"name '{SHIPPED}' or a .npz from `avatarbuild template import`"
    raise InputError(f"template {name}: no such template, {hint}")


def templates_in(folder: Path) -> list[Path]:
    """The template files of a folder, by name; other .npz files are passed over."""
    return [path for path in sorted(folder.glob("*.npz")) if _is_template(path)] if folder.is_dir() else []


def _shipped_head() -> Path:
    from avatarbuild.template import template_folder

    return template_folder() / "head.npz"


def _is_template(path: Path) -> bool:
    import numpy as np

    try:
        with np.load(path, allow_pickle=False) as stored:
            return {"mean", "expression_names", "part_ranges"} <= set(stored.files)
    except (ValueError, OSError, EOFError):
        return False

"""`avatarbuild template list | info | import`: what the three verbs do; plain data, and tables for the terminal."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

from rich.table import Table

from avatarbuild.errors import InputError
from avatarbuild.template import Template, template_folder
from avatarbuild.template_files import SHIPPED, resolve, templates_in
from avatarbuild.template_import import bfm, flame, ict
from avatarbuild.template_import.transfer import to_template
from avatarbuild.whole_file import whole_file

log = logging.getLogger(__name__)

READERS = {"ict": ict.read, "flame": flame.read, "bfm": bfm.read}
_SUFFIXES = {".npz": "flame", ".pkl": "flame", ".pickle": "flame", ".h5": "bfm", ".hdf5": "bfm", ".mat": "bfm"}


class TemplateEntry(NamedTuple):
    """A template file: its name, the file, bytes on disk, and whether it came with the program."""

    name: str
    path: Path
    size: int
    shipped: bool


class TemplateFacts(NamedTuple):
    """What `template info` tells; counts, and sizes in mm."""

    name: str
    version: str
    path: Path
    vertices: int
    triangles: int
    parts: dict[str, int]
    components: int
    expressions: int
    largest_sigma: float
    eye_distance: float
    extent: tuple[float, float, float]


def list_templates(folder: Path | None = None) -> list[TemplateEntry]:
    """The shipped head and the template files of a folder, by name; other .npz files are passed over.

    Raises:
        InputError: `folder` is not there.
    """
    files = [(template_folder() / "head.npz", True)]
    if folder is not None:
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder; name one that holds imported templates")
        files += [(path, False) for path in templates_in(folder)]
    return [TemplateEntry(SHIPPED if own else path.stem, path, path.stat().st_size, own) for path, own in files]


def describe(path_or_name: str | Path) -> TemplateFacts:
    """What a template holds.

    Raises:
        InputError: no template there.
    """
    path = resolve(path_or_name).path
    template = Template.load(path)
    skin = template.mean[template.parts["skin"].vertices]
    wide, high, deep = (float(side) for side in skin.max(axis=0) - skin.min(axis=0))
    apart = template.eye_centres[0] - template.eye_centres[1]
    return TemplateFacts(
        name=template.name,
        version=template.version,
        path=path,
        vertices=template.vertex_count,
        triangles=len(template.triangles),
        parts={name: part.vertices.stop - part.vertices.start for name, part in template.parts.items()},
        components=len(template.identity),
        expressions=len(template.expression_names),
        largest_sigma=float(template.sigma.max(initial=0.0)),
        eye_distance=float((apart @ apart) ** 0.5),
        extent=(wide, high, deep),
    )


def kind_of(source: Path) -> str:
    """ "ict", "flame" or "bfm", from the folder's files or the file's ending.

    Raises:
        InputError: none of them.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; name the model's file, or ICT-FaceKit's folder")
    if source.is_dir():
        if ict.folder_of(source) is not None:
            return "ict"
        raise InputError(f"{source}: no {ict.NEUTRAL} in this folder; FLAME and BFM are single files, name the file")
    kind = _SUFFIXES.get(source.suffix.lower())
    if kind is None:
        raise InputError(f"{source}: a model is a folder (ICT-FaceKit) or a file in {', '.join(_SUFFIXES)}")
    return kind


def import_template(source: Path, kind: str | None, output: Path) -> Template:
    """Read a model of `kind` (told from `source` if None), make it a Template and write it to `output` (.npz).

    Raises:
        InputError: the model cannot be read, is of no known kind, or does not become a valid template.
    """
    kind = kind or kind_of(source)
    if kind not in READERS:
        raise InputError(f"{kind}: no such kind of model; {', '.join(READERS)} can be imported")
    if output.suffix.lower() != ".npz":
        raise InputError(f"{output}: a template ends in .npz; choose another name")
    head = READERS[kind](source)
    log.info(
        "%s: %d vertices, %d components, %d expressions",
        kind,
        len(head.mean),
        len(head.identity),
        len(head.expressions),
    )
    template = to_template(head, Template.load())
    output.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(output) as partial:
        template.save(partial)
    return template


def list_table(entries: list[TemplateEntry]) -> Table:
    """The list for a terminal."""
    table = Table("template", "size", "file")
    for entry in entries:
        table.add_row(
            entry.name + (" (shipped)" if entry.shipped else ""), f"{entry.size / 1e6:.1f} MB", str(entry.path)
        )
    return table


def facts_table(facts: TemplateFacts) -> Table:
    """What `template info` prints."""
    table = Table("", f"{facts.name} {facts.version}")
    table.add_row("file", str(facts.path))
    table.add_row("vertices, triangles", f"{facts.vertices:,}, {facts.triangles:,}")
    table.add_row("parts", ", ".join(f"{name} {count:,}" for name, count in facts.parts.items()))
    table.add_row("identity", f"{facts.components} components, the largest {facts.largest_sigma:.1f} mm")
    table.add_row("expressions", str(facts.expressions))
    table.add_row("eyes apart", f"{facts.eye_distance:.1f} mm")
    table.add_row("width, height, depth", " x ".join(f"{side:.0f}" for side in facts.extent) + " mm")
    return table

"""Which file a template's name means, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from avatarbuild.errors import InputError
from avatarbuild.template import Template, template_folder
from avatarbuild.template_files import TemplateFile, resolve, templates_in


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two templates (one without a tongue), a file that is none, and a folder with one template."""
    place = tmp_path_factory.mktemp("templates")
    shipped = Template.load()
    small = replace(
        shipped,
        identity=shipped.identity[:1],
        sigma=shipped.sigma[:1],
        eye_centre_basis=shipped.eye_centre_basis[:1],
        subdivision=None,
        cage_mean=None,
        cage_identity=None,
        cage_expressions=None,
    )
    parts = {name: part for name, part in shipped.parts.items() if name != "tongue"}
    (place / "one").mkdir()
    small.save(place / "one" / "anna.npz")
    (place / "bert.npz").write_bytes((place / "one" / "anna.npz").read_bytes())
    replace(small, parts=parts).save(place / "mute.npz")
    (place / "notes.npz").write_bytes(b"no archive")
    return place


def test_names_of_templates(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    (folder / "head").mkdir(exist_ok=True)  # the shipped head's name is never a folder's
    assert resolve("head") == TemplateFile(template_folder() / "head.npz")
    assert resolve("head").shipped
    assert resolve("bert").path == resolve("bert.npz").path == Path("bert.npz")
    assert resolve(folder / "one").path == folder / "one" / "anna.npz"
    assert not resolve("bert").shipped
    assert templates_in(folder) == [folder / "bert.npz", folder / "mute.npz"]


@pytest.mark.parametrize(
    "name, hint",
    [
        ("haed", "did you mean 'head'"),
        ("brt", "did you mean 'bert'"),
        ("one/ana.npz", "did you mean 'one/anna.npz'"),
        ("nowhere/at/all.npz", "avatarbuild template import"),
        (".", "bert.npz, mute.npz"),
        ("empty", "no template"),
    ],
)
def test_misspelt_names(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, hint: str) -> None:
    monkeypatch.chdir(folder)
    (folder / "empty").mkdir(exist_ok=True)
    with pytest.raises(InputError, match=hint):
        resolve(name)


def test_the_same_bytes_are_the_same_template(folder: Path) -> None:
    assert resolve(folder / "bert").digest == resolve(folder / "one").digest
    assert resolve(folder / "bert").digest != resolve(folder / "mute").digest
    assert resolve(folder / "bert").load().vertex_count == Template.load().vertex_count


def test_a_template_without_a_part_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match="no tongue"):
        resolve(folder / "mute").load()
    with pytest.raises(InputError, match="not a template"):
        resolve(folder / "notes.npz").load()

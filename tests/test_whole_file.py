"""A file that is written whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from avatarbuild.errors import InputError
from avatarbuild.whole_file import whole_file


def test_it_takes_its_name_at_the_end(tmp_path: Path) -> None:
    place = tmp_path / "a clip.csv"
    place.write_text("old")
    with whole_file(place) as partial:
        partial.write_text("new")
        assert place.read_text() == "old"
        assert partial.suffix == ".csv"
    assert place.read_text() == "new"
    assert list(tmp_path.iterdir()) == [place]


def _interrupted(place: Path) -> None:
    with whole_file(place) as partial:
        partial.write_text("half")
        raise KeyboardInterrupt


def test_a_fault_leaves_what_was_there(tmp_path: Path) -> None:
    place = tmp_path / "clip.csv"
    place.write_text("old")
    with pytest.raises(KeyboardInterrupt):
        _interrupted(place)
    assert place.read_text() == "old"
    assert list(tmp_path.iterdir()) == [place]


def test_a_place_that_cannot_be_written_is_told_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"), whole_file(tmp_path / "nowhere" / "clip.csv"):
        pytest.fail("the work began")


def test_a_folder_in_its_place(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"), whole_file(tmp_path):
        pass


def test_faults_of_other_files_are_not_taken_for_its_own(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), whole_file(tmp_path / "clip.csv"):
        (tmp_path / "another").read_bytes()

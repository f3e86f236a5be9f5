# SPDX-License-Identifier: GPL-3.0-or-later
"""Saved settings: what is saved, files of other versions, files to refuse."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.errors import ParseError
from gaussian_wrapping_addon.core.settings.job import (
    FORMAT,
    MAX_BYTES,
    MAX_NOTES,
    VERSION,
    read_saved_settings,
    savable_settings,
    write_saved_settings,
)

SETTINGS = {"training.iterations": 1234, "preset": "fine", "texture.lods": 2}


def written(path: Path, **changes: Any) -> Path:
    values = {"format": FORMAT, "version": VERSION, "settings": SETTINGS, "panel": {}}
    path.write_text(json.dumps({**values, **changes}))
    return path


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_saved_settings(path, SETTINGS, {"resolution": "POINTS"})
    saved = read_saved_settings(path)
    assert saved.values == SETTINGS
    assert saved.panel == {"resolution": "POINTS"}
    assert saved.notes == ()


def test_paths_regions_and_the_machine_are_no_part_of_it() -> None:
    names = {declared.path for declared in savable_settings()}
    assert {"preset", "training.iterations", "meshing.most_parts", "texture.lods"} <= names
    assert not names & {"start_splat", "regions", "threads", "device", "export", "training.focus"}


def test_a_word_of_an_earlier_version_becomes_the_default(tmp_path: Path) -> None:
    path = written(tmp_path / "a.json", settings={"training.harmonics": "auto"})
    saved = read_saved_settings(path)
    assert (saved.values, saved.notes) == ({"training.harmonics": "on"}, ())


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("training.magic", 1, "'training.magic' is no setting of this version."),
        ("start_splat", "/etc/passwd", "'start_splat' is no setting"),
        ("threads", 4, "'threads' is no setting"),
        ("training.iterations", -1, "training.iterations is out of range"),
        ("training.iterations", "1", "training.iterations is out of range"),
        ("training.iterations", 1.5, "training.iterations is out of range"),
        ("training.iterations", True, "training.iterations is out of range"),
        ("training.iterations", 10**400, "training.iterations is out of range"),
        ("training.harmonics", "maybe", "training.harmonics is out of range"),
        ("meshing.edge_length", 10**400, "meshing.edge_length is out of range"),
        ("meshing.edge_length", [1], "meshing.edge_length is out of range"),
        ("preset", None, "preset is out of range"),
        ("x" * 500, 1, "'" + "x" * 40 + "'"),
    ],
)
def test_what_this_version_cannot_use_is_told_and_left_out(
    tmp_path: Path, name: str, value: Any, says: str
) -> None:
    path = written(tmp_path / "a.json", settings={"texture.lods": 3, name: value})
    saved = read_saved_settings(path)
    assert saved.values == {"texture.lods": 3}
    (note,) = saved.notes
    assert says in note
    assert len(note) < 100


def test_zero_leaves_a_number_to_the_preset(tmp_path: Path) -> None:
    path = written(tmp_path / "a.json", settings={"training.iterations": 0})
    assert read_saved_settings(path).values == {"training.iterations": 0}


def test_many_notes_are_counted(tmp_path: Path) -> None:
    path = written(tmp_path / "a.json", settings={f"x{k}": 1 for k in range(100)})
    notes = read_saved_settings(path).notes
    assert len(notes) == MAX_NOTES + 1
    assert notes[-1] == "95 more entries were left out."


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not JSON"),
        ("import os; os.system('x')", "not JSON"),
        ("[]", "format: is not"),
        ("{}", "format: is not"),
        ("[" * 50_000, "nested too deeply"),
        (json.dumps({"format": FORMAT}), "version: is not 1"),
        (json.dumps({"format": FORMAT, "version": True}), "version: is not 1"),
        (json.dumps({"format": FORMAT, "version": 2}), "version: is not 1"),
        (json.dumps({"format": FORMAT, "version": 1}), "settings: is not an object"),
        (json.dumps({"format": FORMAT, "version": 1, "settings": {}, "panel": 3}), "panel: is not"),
        ('{"a": NaN}', "NaN is not a number"),
        (" " * (MAX_BYTES + 1), "bytes are too many"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(ParseError, match=says) as refused:
        read_saved_settings(path)
    assert refused.value.hint


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    written(tmp_path / "there.json")
    (tmp_path / "a.json").symlink_to(tmp_path / "there.json")
    with pytest.raises(ParseError, match="a link"):
        read_saved_settings(tmp_path / "a.json")

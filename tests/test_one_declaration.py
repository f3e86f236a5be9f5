# SPDX-License-Identifier: GPL-3.0-or-later
"""One declaration per setting: all that shows it is made from there, the documentation too.

The part in Blender is in ``tests/blender/test_setting_properties.py``.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.settings import (
    PRESETS,
    SWITCH,
    Declaration,
    JobSettings,
    declarations,
    declared,
    with_values,
)
from gaussian_wrapping_addon.core.settings.declaration import value_at
from tests.fake_setting import GROUPS, REPOSITORY, copy_with_fake_setting, said_by
from tools.settings_table import table

DOCS = REPOSITORY / "docs" / "settings.md"
SETTINGS = declarations(JobSettings)
WITH_PANEL = [entry for entry in SETTINGS if entry.panel is not None]


def path_of(entry: Declaration) -> str:
    return entry.path


@pytest.mark.parametrize("group", GROUPS)
def test_a_new_setting_needs_its_declaration_only(tmp_path: Path, group: str) -> None:
    folder = copy_with_fake_setting(tmp_path, group)
    shutil.copy(DOCS, folder / "docs.md")
    found = said_by("tests.fake_setting_play", folder, group)
    # Of meshes and textures, what is not given has its default whatever the preset.
    fine = 5 if group == "training" else 3
    assert (found["default"], found["fine"], found["given"]) == (3, fine, 7)
    assert found["refused"] == "--set fake_number is out of range. Give from 1 to 9."
    assert (found["stored"], found["read"]) == (7, 7)
    (row,) = found["table"]
    for cell in (
        "`--set fake_number=N`",
        "Fake Number",
        "3 / 3 / 5 / 3 / 3",
        "from 1 to 9",
        "bananas",
    ):
        assert f"{cell} |" in row
    assert found["outdated"], "the test of the table would fail until it is written again"


def test_the_table_is_up_to_date() -> None:
    assert DOCS.read_text(encoding="utf-8") == table(), "run make settings-table"


def test_every_setting_stands_in_the_table() -> None:
    text = DOCS.read_text(encoding="utf-8")
    for entry in SETTINGS:
        assert f"\n| `{entry.name}` |" in text
        if entry.option is not None:
            word = entry.option.name if entry.option.own else f"--set {entry.option.word}="
            assert f"`{word}" in text
        if entry.panel is not None:
            assert (entry.panel.drawn_label or entry.panel.label) in text


@pytest.mark.parametrize("entry", SETTINGS, ids=path_of)
def test_declarations_agree_with_themselves(entry: Declaration) -> None:
    for name in PRESETS:
        value = entry.presets.get(name, entry.default)
        assert entry.check is None or entry.check.holds(value)
        assert type(value) is (tuple if isinstance(entry.default, tuple) else entry.kind)
    assert entry.help.endswith(".")
    if entry.option is not None:
        assert entry.option.name.startswith("--")
        assert entry.scope in ("training", "method", "region", "more")


@pytest.mark.parametrize("entry", WITH_PANEL, ids=path_of)
def test_panels_show_what_may_be_chosen(entry: Declaration) -> None:
    panel = entry.panel
    assert panel is not None
    values = tuple(item.value for item in panel.items)
    if entry.choices == SWITCH:
        assert values == ()
        assert [entry.to_panel(value) for value in SWITCH] == [False, True]
    elif entry.choices:
        assert values == entry.choices
    for value in values or (entry.default,):
        assert entry.check is None or entry.check.holds(value)
        assert entry.from_panel(entry.to_panel(value)) == value
    assert not panel.description.endswith(".")


def test_values_are_found_and_replaced_by_path() -> None:
    settings = with_values(JobSettings(), {"seed": 4, "meshing.points": 9, "training.sh_degree": 0})
    assert [value_at(settings, p) for p in ("seed", "meshing.points", "training.sh_degree")] == [
        4, 9, 0,
    ]  # fmt: skip
    assert with_values(settings, {"seed": 0, "meshing.points": 0, "training.sh_degree": 2}) == (
        JobSettings()
    )
    assert declared("meshing.points").group == "meshing"
    with pytest.raises(KeyError):
        declared("meshing.colour")


def test_a_field_without_declaration_is_refused() -> None:
    @dataclass(frozen=True)
    class Careless:
        number: int = 3

    with pytest.raises(TypeError, match=r"Careless\.number"):
        declarations(Careless)

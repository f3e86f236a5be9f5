# SPDX-License-Identifier: GPL-3.0-or-later
"""The user's presets: saved, applied in one undo step, deleted; files that others wrote."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import MethodType, SimpleNamespace

import bpy
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobStatus
from gaussian_wrapping_addon.core.settings.job import savable_settings
from gaussian_wrapping_addon.ops import job_timer
from gaussian_wrapping_addon.ops.panel_settings import job_settings
from gaussian_wrapping_addon.ops.presets import (
    MOST_PRESETS,
    apply_preset,
    delete_preset,
    preset_names,
    save_preset,
)
from gaussian_wrapping_addon.ui.training_panel import GWRAP_MT_presets
from tests.blender.fake_layout import FakeLayout

pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture(autouse=True)
def folder() -> Iterator[Path]:
    found = Path(bpy.utils.user_resource("SCRIPTS", path="presets/gaussian_wrapping", create=True))
    for path in found.iterdir():
        path.unlink()
    yield found
    for path in found.iterdir():
        path.unlink()


def panel_values() -> dict[str, object]:
    gwrap = bpy.context.scene.gwrap
    owners = {"training": gwrap.training, "scene": gwrap}
    values = {
        d.path: getattr(owners[d.property_owner], d.property_name) for d in savable_settings()
    }
    return {**values, "resolution": gwrap.resolution, "decimate": gwrap.decimate}


def change_everything() -> dict[str, object]:
    """Give every savable property another value than its default; return them all."""
    gwrap = bpy.context.scene.gwrap
    owners = {"training": gwrap.training, "scene": gwrap}
    before = panel_values()
    for declared in savable_settings():
        owner, name = owners[declared.property_owner], declared.property_name
        kind = owner.bl_rna.properties[name]
        if kind.type == "ENUM":
            other = [i.identifier for i in kind.enum_items if i.identifier != getattr(owner, name)]
            setattr(owner, name, other[-1])
        elif kind.type == "BOOLEAN":
            setattr(owner, name, not getattr(owner, name))
        else:
            # 0 leaves a number to the preset; the next that the setting allows is its lowest.
            more = kind.default + 1
            low = declared.check.low if declared.panel.preset_if_zero else more
            if getattr(declared.check, "zero", ""):  # 0, or a number of at least the lowest
                low = max(declared.check.low, more)
            setattr(owner, name, type(kind.default)(low))
    gwrap.resolution, gwrap.decimate = "POINTS", not gwrap.decimate
    after = panel_values()
    assert [name for name in before if before[name] == after[name]] == []
    return after


def test_every_setting_comes_back() -> None:
    before = panel_values()
    wanted = change_everything()
    settings = job_settings(bpy.context.scene, 1)
    assert bpy.ops.gwrap.save_preset(name="Best / wood, no. 1") == {"FINISHED"}
    (name,) = preset_names()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    assert panel_values() == before
    assert bpy.ops.gwrap.apply_preset(name=name) == {"FINISHED"}
    assert panel_values() == wanted
    assert job_settings(bpy.context.scene, 1) == settings
    assert bpy.ops.gwrap.delete_preset(name=name) == {"FINISHED"}
    assert preset_names() == []


def test_the_file_is_text_and_holds_no_path_and_applying_keeps_folders(folder: Path) -> None:
    gwrap = bpy.context.scene.gwrap
    gwrap.source, gwrap.output, gwrap.training.start_splat = "/secret/a", "/secret/b", "/secret/c"
    save_preset(bpy.context.scene, "one")
    text = (folder / "one.json").read_text()
    assert "secret" not in text
    assert json.loads(text)["settings"]["preset"] == "standard"
    gwrap.source, gwrap.output, gwrap.job_folder = "/a", "/b", "/c"
    apply_preset(bpy.context.scene, "one")
    assert (gwrap.source, gwrap.output, gwrap.job_folder) == ("/a", "/b", "/c")


def test_a_preset_of_another_version_is_used_as_far_as_it_goes(folder: Path) -> None:
    save_preset(bpy.context.scene, "one")
    path = folder / "one.json"
    values = json.loads(path.read_text())
    values["settings"] |= {"training.iterations": 77, "training.future": 5, "texture.lods": 10**9}
    values["panel"] = {"resolution": "SIDEWAYS", "decimate": "x", "source": "/etc"}
    path.write_text(json.dumps(values))
    notes = apply_preset(bpy.context.scene, "one")
    gwrap = bpy.context.scene.gwrap
    assert gwrap.training.iterations == 77
    assert (gwrap.lods, gwrap.resolution, gwrap.source) == (0, "AUTOMATIC", "")
    assert {note.split()[0] for note in notes} == {
        "'training.future'", "texture.lods", "resolution", "decimate",
    }  # fmt: skip
    assert len(notes) == 4


@pytest.mark.parametrize("text", ["", "import bpy", "{}", "[" * 10_000, '{"format": 1}'])
def test_a_hostile_file_is_refused_and_changes_nothing(folder: Path, text: str) -> None:
    (folder / "bad.json").write_text(text)
    before = panel_values()
    with pytest.raises(RuntimeError, match=r"bad\.json, "):
        bpy.ops.gwrap.apply_preset(name="bad")
    assert panel_values() == before


def test_python_and_links_are_neither_shown_nor_run(folder: Path, tmp_path: Path) -> None:
    (folder / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    (tmp_path / "there.json").write_text("{}")
    (folder / "linked.json").symlink_to(tmp_path / "there.json")
    assert preset_names() == []
    for name in ("evil", "linked"):
        with pytest.raises(UsageError, match=f"There is no preset '{name}'"):
            apply_preset(bpy.context.scene, name)
    assert not (tmp_path / "ran").exists()


def test_only_listed_presets_can_be_named(folder: Path) -> None:
    save_preset(bpy.context.scene, "one")
    (folder.parent / "one.json").write_text("{}")
    for name in ("", "../one", "/etc/passwd", "none", "one.json"):
        with pytest.raises(UsageError, match="There is no preset"):
            apply_preset(bpy.context.scene, name)
        with pytest.raises(UsageError, match="There is no preset"):
            delete_preset(name)
    assert (folder.parent / "one.json").exists()
    assert preset_names() == ["one"]
    (folder.parent / "one.json").unlink()
    with pytest.raises(RuntimeError, match="has no name"):
        bpy.ops.gwrap.save_preset(name="  ")


def test_a_preset_of_the_same_name_is_replaced_and_there_is_a_limit(folder: Path) -> None:
    for number in range(MOST_PRESETS):
        (folder / f"p{number}.json").write_text("{}")
    assert save_preset(bpy.context.scene, "p3") == "p3"
    assert json.loads((folder / "p3.json").read_text())["version"] == 1
    with pytest.raises(UsageError, match="100 presets already"):
        save_preset(bpy.context.scene, "another")


def test_no_preset_is_applied_while_a_job_runs() -> None:
    save_preset(bpy.context.scene, "one")
    status = JobStatus("RUNNING", "train", 0.5, "", None)
    client = SimpleNamespace(poll=lambda: status)
    job_timer.watch(bpy.context.scene, Path("/tmp/gwrap-none"), client, imports=False)  # type: ignore[arg-type]
    assert not bpy.ops.gwrap.apply_preset.poll()
    assert bpy.ops.gwrap.save_preset.poll()
    job_timer.forget_all_jobs()
    assert bpy.ops.gwrap.apply_preset.poll()


def test_the_menu_lists_them() -> None:
    def drawn() -> FakeLayout:
        layout = FakeLayout()
        fake = SimpleNamespace(layout=layout)
        MethodType(GWRAP_MT_presets.draw, fake)(bpy.context)
        return layout

    assert drawn().texts.splitlines() == ["No presets yet", "Save Preset…"]
    save_preset(bpy.context.scene, "dark wood")
    layout = drawn()
    assert layout.texts.splitlines() == ["dark wood", "Save Preset…"]
    assert layout.operators == ["gwrap.apply_preset", "gwrap.delete_preset", "gwrap.save_preset"]

# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender properties are made from the declarations, and .blend files keep their values."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

from gaussian_wrapping_addon.core.settings import JobSettings, declarations, declared
from gaussian_wrapping_addon.ops import worker_setup
from gaussian_wrapping_addon.ui import (
    computers_panel,
    dataset_panel,
    mesh_panel,
    preferences,
    training_panel,
)
from tests.blender.fake_layout import draw
from tests.fake_setting import GROUPS, copy_with_fake_setting, said_by

# As in 0.1.0: .blend files hold the names of the properties and the indices of the entries.
STORED: dict[str, list[str] | None] = {
    "preset": ["DRAFT", "STANDARD", "FINE", "PAPER", "LARGE"],
    "resolution": ["AUTOMATIC", "EDGE_LENGTH", "POINTS"],
    "method": ["PAM", "PIVOTS"],
    "spacing": ["ADAPTIVE", "UNIFORM"],
    "pivots": ["2", "3", "9"],
    "boundary": ["CLOSED", "OPEN"],
    "unseen": ["EMPTY", "OCCUPIED"],
    "texture_size": ["0", "1024", "2048", "4096", "8192"],
    "normal_map": ["AUTO", "ON", "OFF"],
    "texture_source": ["PHOTOS", "GAUSSIANS"],
    "training.exposure": ["AUTO", "ON", "OFF"],
    "training.multi_view": ["AUTO", "ON", "OFF"],
    "training.mask_mode": ["IGNORE", "BACKGROUND", "AUTO"],
    "training.turntable": ["AUTO", "ON", "OFF"],
    "training.georeference": ["AUTO", "ON", "OFF"],
    **dict.fromkeys(
        (
            "edge_length", "points", "most_parts", "decimate", "target_faces", "smooth_steps",
            "ambient_occlusion", "lods", "max_atlases", "training.reflections",
            "training.orientations", "training.add_gaussians",
            "training.mask_invert", "training.mask_grow_px",
            "training.markers", "training.control_points", "training.iterations",
            "training.max_gaussians", "training.max_image_px", "training.start_splat",
            "training.more_iterations",
        )
    ),
}  # fmt: skip


def property_at(path: str) -> bpy.types.Property:
    owner = bpy.context.scene.gwrap
    if path.startswith("training."):
        owner = owner.training
    return owner.bl_rna.properties[path.removeprefix("training.")]


@pytest.mark.usefixtures("addon")
def test_files_keep_their_values() -> None:
    for path, entries in STORED.items():
        found = property_at(path)
        assert (found.type == "ENUM") == (entries is not None), path
        if entries is not None:
            assert [item.identifier for item in found.enum_items] == entries
            assert [item.value for item in found.enum_items] == list(range(len(entries)))


@pytest.mark.usefixtures("addon")
def test_numbers_have_the_limits_of_their_checks() -> None:
    limits = {
        path: (found.default, found.hard_min, found.hard_max, found.soft_max)
        for path in STORED
        if (found := property_at(path)).type == "INT"
    }
    assert limits == {
        "points": (50_000, 100, 5_000_000, 500_000),
        "target_faces": (20_000, 4, 20_000_000, 1_000_000),
        "most_parts": (0, 0, 10_000, 20),
        "smooth_steps": (0, 0, 1000, 20),
        "lods": (0, 0, 8, 8),
        "max_atlases": (0, 0, 16, 16),
        "training.mask_grow_px": (0, -200, 200, 200),
        "training.iterations": (0, 0, 1_000_000, 30_000),
        "training.max_gaussians": (0, 0, 20_000_000, 1_000_000),
        "training.max_image_px": (0, 0, 16_384, 4096),
        "training.more_iterations": (1000, 1, 1_000_000, 10_000),
    }
    for kind, name in ((bpy.types.Scene, "scene"), (bpy.types.Object, "object")):
        pointer = kind.bl_rna.properties["gwrap"].fixed_type.properties["edge_length"]
        assert (pointer.subtype, pointer.unit, pointer.soft_max) == ("DISTANCE", "LENGTH", 1.0), (
            name
        )
        assert pointer.hard_min == pytest.approx(1e-5)


@pytest.mark.usefixtures("addon")
def test_every_declared_property_is_there_and_drawn() -> None:
    properties = bpy.context.scene.gwrap
    drawn: set[str] = set(preferences.GWRAP_preferences.__annotations__)
    properties.source = properties.checked_source = "clip.mp4"
    properties.checked_kind = "video"
    for method, resolution in (("PAM", "EDGE_LENGTH"), ("PIVOTS", "POINTS")):
        properties.method, properties.resolution, properties.decimate = method, resolution, True
        for panel in (
            dataset_panel.GWRAP_PT_dataset,
            training_panel.GWRAP_PT_train,
            training_panel.GWRAP_PT_train_advanced,
            computers_panel.GWRAP_PT_computers,
            mesh_panel.GWRAP_PT_mesh,
            mesh_panel.GWRAP_PT_mesh_advanced,
            mesh_panel.GWRAP_PT_texture,
        ):
            drawn |= {field.name for field in draw(panel).fields}
    shown = [entry for entry in declarations(JobSettings) if entry.panel is not None]
    assert {entry.property_name for entry in shown} <= drawn


@pytest.mark.usefixtures("addon")
def test_the_device_is_the_machines_and_shown_with_the_training(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entry = declared("device")
    assert entry.property_owner == "preferences"
    assert [entry.from_panel(word) for word in ("AUTO", "CPU", "CUDA")] == ["auto", "cpu", "cuda"]
    panel = training_panel.GWRAP_PT_train_advanced
    assert "device" not in {field.name for field in draw(panel).fields}, "not as an add-on"
    mine = SimpleNamespace(
        bl_rna=SimpleNamespace(properties={"device"}), device="CUDA", threads=3,
        worker_python="", keep_running=False,
    )  # fmt: skip
    for module in (training_panel, worker_setup):
        monkeypatch.setattr(module, "addon_preferences", lambda _context: mine)
    assert "device" in {field.name for field in draw(panel).fields}
    choice = worker_setup.worker_choice(bpy.context)
    assert (choice.device, choice.threads) == ("cuda", 3)


@pytest.mark.parametrize("group", GROUPS)
def test_a_new_setting_needs_its_declaration_only(tmp_path: Path, group: str) -> None:
    folder = copy_with_fake_setting(tmp_path, group)
    found = said_by("tests.blender.fake_setting_play", folder, group)
    assert found["rna"] == ["Fake Number", "A number that only the test knows", 3, 1, 9]
    assert "fake_number" in found["drawn"]
    assert found["chosen"] == [3, 7]

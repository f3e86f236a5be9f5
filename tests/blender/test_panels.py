# SPDX-License-Identifier: GPL-3.0-or-later
"""Every panel draws in every state, with calls that Blender's layouts really have."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

from gaussian_wrapping_addon.core.jobs.commands.doctor import Diagnosis
from gaussian_wrapping_addon.core.jobs.store.job_folder import STATES, JobStatus
from gaussian_wrapping_addon.ops import job_timer, worker_setup
from gaussian_wrapping_addon.ops.scene_objects import import_result
from gaussian_wrapping_addon.ui import mesh_panel, preferences, result_panel, training_panel
from gaussian_wrapping_addon.ui.panel_base import progress_text
from tests.blender.fake_layout import FakeLayout, draw
from tests.blender.panel_states import Client
from tests.blender.synthetic_result import write_result

pytestmark = pytest.mark.usefixtures("addon")

TRAIN, MESH = training_panel.GWRAP_PT_train, mesh_panel.GWRAP_PT_mesh


@pytest.fixture(autouse=True)
def _no_jobs() -> None:
    job_timer.forget_all_jobs()


def show(status: JobStatus, command: str = "WRAP") -> None:
    scene = bpy.context.scene
    scene.gwrap.job_command = command
    job_timer.watch(scene, Path("/tmp/gwrap-none"), Client(status), imports=False)  # type: ignore[arg-type]


@pytest.mark.parametrize("state", STATES)
def test_states_of_a_mesh_job(state: str) -> None:
    error = "It broke." if state in ("FAILED", "LOST") else ""
    hint = "Do that." if state in ("FAILED", "LOST", "CANCELLED") else ""
    show(JobStatus(state, "train", 1.0000001, "step 5", None, error, hint), "MESH")
    mesh, train = draw(MESH), draw(TRAIN)
    running = state in ("NEW", "RUNNING", "CANCELLING")
    assert ("gwrap.cancel_job" in mesh.operators) == running
    assert "gwrap.cancel_job" not in train.operators
    assert ("Train · 100 %" in mesh.texts) == running
    assert ("Cancelling…" in mesh.texts) == (state == "CANCELLING")
    assert "left" not in mesh.texts
    assert error in mesh.texts
    assert hint in mesh.texts
    assert ("gwrap.resume_job" in mesh.operators) == (state in ("FAILED", "LOST", "CANCELLED"))
    assert error == "" or error not in train.texts


def fields(panel: type) -> set[str]:
    return {field.name for field in draw(panel).fields}


def test_panels_ask_for_what_decides() -> None:
    gwrap = bpy.context.scene.gwrap
    assert fields(TRAIN) == {"preset", "output"}
    for resolution, name in (
        ("AUTOMATIC", None),
        ("EDGE_LENGTH", "edge_length"),
        ("POINTS", "points"),
    ):
        gwrap.resolution = resolution
        assert fields(MESH) == {"resolution", name} - {None}
    shared = {
        "most_parts", "decimate", "smooth_steps", "method", "boundary", "unseen", "mesh_cameras",
    }  # fmt: skip
    for method, own in (("PAM", {"spacing"}), ("PIVOTS", {"pivots", "pivot_box", "pivot_samples"})):
        gwrap.method, gwrap.decimate = method, False
        assert fields(mesh_panel.GWRAP_PT_mesh_advanced) == shared | own
        gwrap.decimate = True
        assert fields(mesh_panel.GWRAP_PT_mesh_advanced) == shared | own | {"target_faces"}
    assert fields(mesh_panel.GWRAP_PT_texture) == {
        "texture_size", "max_atlases", "texture_source", "normal_map", "ambient_occlusion", "lods",
    }  # fmt: skip


def test_scene_tools_with_a_result(tmp_path: Path) -> None:
    assert draw(result_panel.GWRAP_PT_scene_tools).operators == []
    imported = import_result(write_result(tmp_path / "job"), bpy.context.scene)
    bpy.context.view_layer.update()
    layout = draw(result_panel.GWRAP_PT_scene_tools)
    assert "Show Photo Cameras" in layout.texts
    assert "Scale 1" in layout.texts
    assert layout.operators == [
        "gwrap.view_photo", "gwrap.view_photo", "gwrap.view_photo", "gwrap.add_point",
        "gwrap.set_scale", "gwrap.set_ground", "gwrap.auto_ground", "gwrap.set_origin",
        "gwrap.keep_placement", "gwrap.reset_placement",
    ]  # fmt: skip
    for x in (0.0, 0.25):
        bpy.context.scene.cursor.location = (x, 0, 0)
        bpy.ops.gwrap.add_point()
    assert "2 points selected, 25 cm apart" in draw(result_panel.GWRAP_PT_scene_tools).texts
    imported.frame.scale = (1, 2, 1)
    bpy.context.view_layer.update()
    assert "scaled differently" in draw(result_panel.GWRAP_PT_scene_tools).texts
    bpy.context.view_layer.objects.active = imported.meshes[0]
    bpy.ops.object.mode_set(mode="EDIT")
    assert "Select vertices" in draw(result_panel.GWRAP_PT_scene_tools).texts


def test_preferences_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [Diagnosis("torch", False, "cannot be imported", "pip install torch")]
    monkeypatch.setattr(worker_setup, "_findings", [*found, Diagnosis("numpy", True, "1.26.4")])
    layout = FakeLayout()
    names = preferences.GWRAP_preferences.__annotations__
    owner = SimpleNamespace(properties=set(names))
    fake = SimpleNamespace(layout=layout, bl_rna=SimpleNamespace(properties=owner.properties))
    preferences.GWRAP_preferences.draw(fake, bpy.context)
    assert "pip install torch" in layout.texts
    assert "gwrap.set_up_worker" in layout.operators
    assert {a[1] for name, a, _ in layout.log if name == "prop"} == set(names)
    assert worker_setup.as_text().splitlines()[0].startswith("BAD  torch: cannot be imported")


def test_progress_text() -> None:
    assert progress_text("", 0.0, None) == "Starting · 0 %"
    show(JobStatus("RUNNING", "train", -0.5, "step 5", 1e6))
    assert "left" in draw(TRAIN).texts
    for seconds, text in (
        (59.4, "59 s"), (59.6, "1 min 00 s"), (600, "10 min"), (3599, "1 h 00 min"),
        (-5, "0 s"),
    ):  # fmt: skip
        assert progress_text("train", 0.256, seconds) == f"Train · 26 % · {text} left"

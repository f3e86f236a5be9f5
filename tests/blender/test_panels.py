# SPDX-License-Identifier: GPL-3.0-or-later
"""Every panel draws in every state, with calls that Blender's layouts really have."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

from gaussian_wrapping_addon import registration
from gaussian_wrapping_addon.core.jobs.commands.doctor import Diagnosis
from gaussian_wrapping_addon.core.jobs.store.job_folder import STATES, JobStatus
from gaussian_wrapping_addon.ops import addon, job_timer, worker_setup
from gaussian_wrapping_addon.ops.scene_objects import import_result
from gaussian_wrapping_addon.ui import mesh_panel, preferences, result_panel, training_panel
from gaussian_wrapping_addon.ui.panel_base import progress_text
from tests.blender.fake_layout import FakeLayout, draw
from tests.blender.synthetic_result import write_result

pytestmark = pytest.mark.usefixtures("addon")

PANELS = [cls for cls in registration.CLASSES if issubclass(cls, bpy.types.Panel)]
REGION = next(cls for cls in PANELS if cls.bl_label == "Region")
TRAIN, MESH = training_panel.GWRAP_PT_train, mesh_panel.GWRAP_PT_mesh


class FakeClient:
    """Answers with one status."""

    def __init__(self, status: JobStatus) -> None:
        self.status = status

    def poll(self) -> JobStatus:
        return self.status


@pytest.fixture(autouse=True)
def _no_jobs() -> None:
    job_timer.forget_all_jobs()


def show(status: JobStatus, command: str = "WRAP") -> None:
    scene = bpy.context.scene
    scene.gwrap.job_command = command
    job_timer.watch(scene, Path("/tmp/gwrap-none"), FakeClient(status), imports=False)  # type: ignore[arg-type]


@pytest.mark.parametrize("panel", [p for p in PANELS if p.bl_label != "Details"])
def test_every_panel_draws_in_an_empty_file(panel: type) -> None:
    layout = draw(panel)
    assert layout.log
    assert not [t for t in layout.texts.split() if t.isupper() and len(t) > 4], "no ALL CAPS"


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("command", ["WRAP", "MESH"])
def test_job_states(state: str, command: str) -> None:
    error = "It broke." if state in ("FAILED", "LOST") else ""
    hint = "Do that." if state in ("FAILED", "LOST", "CANCELLED") else ""
    show(JobStatus(state, "train", 1.0000001, "step 5", 75.0, error, hint), command)
    here, other = map(draw, (TRAIN, MESH) if command == "WRAP" else (MESH, TRAIN))
    running = state in ("NEW", "RUNNING", "CANCELLING")
    assert ("gwrap.cancel_job" in here.operators) == running
    assert "gwrap.cancel_job" not in other.operators
    assert ("Train · 100 %" in here.texts) == running
    assert ("Cancelling…" in here.texts) == (state == "CANCELLING")
    assert error in here.texts
    assert hint in here.texts
    assert ("gwrap.resume_job" in here.operators) == (state in ("FAILED", "LOST", "CANCELLED"))
    assert error == "" or error not in other.texts


@pytest.mark.parametrize("left", [None, 0.0, 1e6])
def test_any_time_left_is_drawn(left: float | None) -> None:
    show(JobStatus("RUNNING", "train", -0.5, "step 5", left))
    assert ("left" in draw(TRAIN).texts) == (left is not None)


def test_a_first_wrap_can_be_started_at_one_glance() -> None:
    layout = draw(TRAIN)
    assert layout.operators == ["gwrap.wrap_scene"]
    assert [field.name for field in layout.fields] == ["preset", "output"]


@pytest.mark.parametrize(
    ("resolution", "shown"),
    [("AUTOMATIC", set()), ("EDGE_LENGTH", {"edge_length"}), ("POINTS", {"points"})],
)
def test_mesh_panel_shows_what_decides(resolution: str, shown: set[str]) -> None:
    bpy.context.scene.gwrap.resolution = resolution
    properties = {a[1] for name, a, _ in draw(MESH).log if name == "prop"}
    assert properties == {"resolution"} | shown


@pytest.mark.parametrize("method", ["PAM", "PIVOTS"])
def test_advanced_panel_asks_for_what_counts_by_the_method(method: str) -> None:
    bpy.context.scene.gwrap.method = method
    log = draw(mesh_panel.GWRAP_PT_mesh_advanced).log
    properties = {a[1] for name, a, _ in log if name == "prop"}
    own = {"PAM": {"spacing"}, "PIVOTS": {"pivots", "pivot_box", "pivot_samples"}}[method]
    shared = {
        "most_parts", "decimate", "smooth_steps", "method", "boundary", "unseen", "mesh_cameras",
    }  # fmt: skip
    assert properties == shared | own


def test_texture_panel_has_every_map() -> None:
    names = [field.name for field in draw(mesh_panel.GWRAP_PT_texture).fields]
    assert names == [
        "texture_size",
        "max_atlases",
        "texture_source",
        "normal_map",
        "ambient_occlusion",
        "lods",
    ]


@pytest.mark.parametrize("decimate", [False, True])
def test_mesh_panel_asks_for_faces_only_where_they_are_limited(decimate: bool) -> None:
    bpy.context.scene.gwrap.decimate = decimate
    log = draw(mesh_panel.GWRAP_PT_mesh_advanced).log
    properties = {a[1] for name, a, _ in log if name == "prop"}
    assert ("target_faces" in properties) == decimate


def test_region_and_result_panels_with_a_result(tmp_path: Path) -> None:
    import_result(write_result(tmp_path / "job"), bpy.context.scene)
    bpy.context.view_layer.update()
    assert "auto region" in draw(REGION).texts
    layout = draw(result_panel.GWRAP_PT_result)
    assert layout.operators.count("gwrap.set_shading") == 2


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


@pytest.mark.parametrize(
    "text", ["", "[]", "{", "[" * 5000, "3", '{"psnr": "x", "regions": {"a": 3}}']
)
def test_result_panel_survives_edited_properties(tmp_path: Path, text: str) -> None:
    imported = import_result(write_result(tmp_path / "job"), bpy.context.scene)
    imported.frame[addon.FIGURES] = text
    imported.frame[addon.RESULT] = 5
    imported.meshes[0].data.materials.clear()
    for panel in PANELS:
        draw(panel)


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


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (599, "9 min 59 s"),
        (600, "10 min"),
        (3599, "1 h 00 min"),
        (7260, "2 h 01 min"),
        (-5, "0 s"),
    ],
)
def test_time_span(seconds: float, text: str) -> None:
    assert progress_text("train", 0.5, seconds).endswith(f" {text} left")


def test_progress_text() -> None:
    assert progress_text("train", 0.256, 90) == "Train · 26 % · 1 min 30 s left"
    assert progress_text("", 0.0, None) == "Starting · 0 %"

# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs from the buttons to the objects, with a worker process that obeys the protocol."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.devices import choice
from gaussian_wrapping_addon.core.errors import DeviceError
from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.core.loading.check import Finding
from gaussian_wrapping_addon.ops import addon, background, job_timer, jobs, worker_setup
from gaussian_wrapping_addon.ui import dataset_panel, mesh_panel, result_panel, training_panel
from tests.blender.fake_layout import draw
from tests.blender.job_play import (
    start_wrap,
    status,
    wait_for,
    wait_until_it_says_something,
)
from tests.blender.synthetic_result import BOX_SCENE, WORLD_FROM_SCENE

HERE = Path(__file__).parent

pytestmark = pytest.mark.usefixtures("ended_workers")


def test_wrap_scene_runs_and_imports(photos: Path, worker: object) -> None:
    properties = bpy.context.scene.gwrap
    properties.preset = "DRAFT"
    properties.texture_size = "2048"
    properties.texture_source = "GAUSSIANS"
    start_wrap(photos)
    folder = photos.with_name(photos.name + "_wrap")
    assert Path(properties.output) == Path(properties.job_folder) == folder
    job = read_job(folder / "job.json")
    assert (job.command, job.source) == ("wrap", str(photos))
    assert (job.settings.preset, job.settings.texture.size_px) == ("draft", 2048)
    assert job.settings.texture.source == "gaussians"
    assert job.settings.training.iterations == 800
    wait_for("DONE")
    kinds = sorted(addon.kind_of(o) for o in bpy.context.scene.objects)
    assert kinds == ["camera"] * 4 + ["frame", "mesh", "region"]
    assert not job_timer.poll_jobs(), "the timer must stop when idle"
    assert background.poll() is None
    layout = draw(result_panel.GWRAP_PT_report)
    for text in ("27.2 dB", "4,321", "Faces\n12\n", "Closed\nYes\n", "87.5 %", "1 min 23 s"):
        assert text in layout.texts
    assert list(photos.iterdir()) == [], "nothing may be written into the photo folder"


def test_progress_cancel_and_resume(photos: Path, worker: Callable[[str], None]) -> None:
    worker("slow")
    start_wrap(photos)
    wait_until_it_says_something(photos)
    layout = draw(training_panel.GWRAP_PT_train)
    assert "Train · 25 % · 1 min 08 s left" in layout.texts
    assert layout.header == "25 %"
    assert "gwrap.cancel_job" in layout.operators
    assert "gwrap.wrap_scene" not in layout.operators
    assert not bpy.ops.gwrap.wrap_scene.poll(), "one job at a time"
    assert not bpy.ops.gwrap.resume_job.poll()
    begun_s = time.monotonic()
    bpy.ops.gwrap.cancel_job()
    bpy.ops.gwrap.cancel_job()
    wait_for("CANCELLED")
    assert time.monotonic() - begun_s < 12.0
    layout = draw(training_panel.GWRAP_PT_train)
    assert "Cancelled at 25 %" in layout.texts
    assert {"gwrap.resume_job", "gwrap.wrap_scene"} <= set(layout.operators)
    assert not bpy.ops.gwrap.cancel_job.poll()
    worker("quick")
    assert bpy.ops.gwrap.resume_job() == {"FINISHED"}
    wait_for("DONE")
    assert len(list(addon.objects_of_kind(bpy.context.scene, "mesh"))) == 1


@pytest.mark.parametrize(
    ("mode", "state", "words"),
    [
        ("crash", "LOST", "worker"),
        ("refuse", "FAILED", "There are no photos."),
    ],
)
def test_failures_are_shown_with_the_next_step(
    photos: Path, worker: Callable[[str], None], mode: str, state: str, words: str
) -> None:
    worker(mode)
    start_wrap(photos)
    wait_for("FAILED", "LOST")
    job = job_timer.jobs[job_timer.key_of(bpy.context.scene.gwrap.job_folder)]
    job.client._process.wait(10)  # type: ignore[union-attr]
    assert words in status().error  # type: ignore[attr-defined]
    assert status().state == state  # type: ignore[attr-defined]
    layout = draw(training_panel.GWRAP_PT_train)
    assert status().hint.split()[0] in layout.texts  # type: ignore[attr-defined]
    assert "gwrap.resume_job" in layout.operators
    worker("quick")
    bpy.ops.gwrap.resume_job()
    wait_for("DONE")


def test_a_worker_killed_from_outside_is_lost_and_can_be_resumed(
    photos: Path, worker: Callable[[str], None]
) -> None:
    worker("slow")
    start_wrap(photos)
    wait_until_it_says_something(photos)
    os.kill(status().pid, signal.SIGKILL)  # type: ignore[attr-defined]
    wait_for("LOST")
    worker("quick")
    bpy.ops.gwrap.resume_job()
    wait_for("DONE")


def test_a_worker_that_ignores_cancelling_is_ended(
    photos: Path, worker: Callable[[str], None]
) -> None:
    worker("hang")
    start_wrap(photos)
    wait_until_it_says_something(photos)
    pid = status().pid  # type: ignore[attr-defined]
    bpy.ops.gwrap.cancel_job()
    wait_for("CANCELLED", clock=lambda: time.monotonic() + limits.CANCEL_GRACE_S + 0.1)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def finished_wrap(photos: Path) -> bpy.types.Object:
    """Wrap, and return the only region."""
    start_wrap(photos)
    wait_for("DONE")
    (region,) = addon.objects_of_kind(bpy.context.scene, "region")
    return region


def select(*things: bpy.types.Object) -> None:
    bpy.context.view_layer.update()
    for thing in bpy.context.view_layer.objects:
        thing.select_set(thing in things)
    bpy.context.view_layer.objects.active = things[0] if things else None


def test_mesh_region_sends_world_coordinates_and_adds_a_mesh(photos: Path, worker: object) -> None:
    region = finished_wrap(photos)
    folder = Path(bpy.context.scene.gwrap.job_folder)
    frame = addon.frame_of(region)
    assert frame is not None
    frame.scale = (2, 2, 2)
    frame.rotation_euler = (0.3, -0.2, 1.0)
    frame.location = (3, 1, -2)
    properties = bpy.context.scene.gwrap
    properties.resolution = "EDGE_LENGTH"
    properties.edge_length = 0.1
    properties.decimate, properties.target_faces, properties.smooth_steps = True, 1234, 2
    properties.method, properties.pivots = "PIVOTS", "9"
    properties.pivot_box, properties.pivot_samples = "GOF", "NONE"
    properties.mesh_cameras = "ALL"
    properties.boundary, properties.unseen = "OPEN", "OCCUPIED"
    properties.spacing = "UNIFORM"
    properties.normal_map, properties.ambient_occlusion, properties.lods = "OFF", True, 3
    properties.max_atlases = 4
    select(region)
    region.name = "Front Door"
    assert "Mesh Region" in draw(mesh_panel.GWRAP_PT_mesh).texts
    assert bpy.ops.gwrap.mesh_region() == {"FINISHED"}
    job = read_job(folder / "job.json")
    assert job.command == "mesh"
    assert job.settings.preset == "standard"
    assert job.settings.meshing.edge_length == pytest.approx(0.1 / 2 * WORLD_FROM_SCENE.scale)
    assert (job.settings.meshing.target_faces, job.settings.meshing.smooth_steps) == (1234, 2)
    meshing = job.settings.meshing
    assert (meshing.method, meshing.pivots) == ("pivots", 9)
    assert (meshing.pivot_box, meshing.pivot_samples) == ("gof", "none")
    assert meshing.cameras == "all"
    assert meshing.spacing == "uniform"
    texture = job.settings.texture
    assert (texture.normal_map, texture.ambient_occlusion, texture.lods) == ("off", "on", 3)
    assert texture.max_atlases == 4
    assert (meshing.boundary, meshing.unseen) == ("open", "occupied")
    ((_, body),) = job.region_bodies.items()
    expected = WORLD_FROM_SCENE.points(BOX_SCENE)
    distances = np.linalg.norm(np.array(body["vertices"])[:, None] - expected, axis=2)
    assert distances.min(0).max() < 1e-4
    wait_for("DONE")
    meshes = {m[addon.REGION] for m in addon.objects_of_kind(bpy.context.scene, "mesh")}
    assert meshes == {"auto", "Front_Door"}
    regions = list(addon.objects_of_kind(bpy.context.scene, "region"))
    assert len(regions) == 2, "the automatic box comes back, the edited one is not doubled"


def test_a_name_that_is_no_folder_name_is_kept_and_protected(photos: Path, worker: object) -> None:
    """Its folder has a simpler name, which another region may not take."""
    region = finished_wrap(photos)
    folder = Path(bpy.context.scene.gwrap.job_folder)
    select(region)
    region.name = "Front Door"
    assert bpy.ops.gwrap.mesh_region() == {"FINISHED"}
    wait_for("DONE")
    stored = folder / "result" / "Front_Door" / "region.json"
    values = json.loads(stored.read_text())
    stored.write_text(json.dumps({**values, "blender_object_name": "Front Door"}))  # as it is
    select(region)
    assert bpy.ops.gwrap.mesh_region() == {"FINISHED"}, "the same region, meshed again"
    wait_for("DONE")
    stored.write_text(json.dumps({**values, "blender_object_name": "Front Door"}))
    ((_, body),) = read_job(folder / "job.json").region_bodies.items()
    assert body["blender_object_name"] == "Front Door"
    bpy.ops.gwrap.add_region_box()
    bpy.context.view_layer.objects.active.name = "Front/Door"
    with pytest.raises(RuntimeError, match="would replace the result of region 'Front Door'"):
        bpy.ops.gwrap.mesh_region()
    assert status().state == "DONE"  # type: ignore[attr-defined]


def test_mesh_region_refuses_what_cannot_be_meshed(photos: Path, worker: object) -> None:
    assert not bpy.ops.gwrap.mesh_region.poll()
    region = finished_wrap(photos)
    select()
    assert bpy.ops.gwrap.mesh_region.poll(), "a result's only region need not be selected"
    bpy.ops.gwrap.add_region_box()
    select()
    assert not bpy.ops.gwrap.mesh_region.poll()
    select(region)
    region.scale.z = 0.0
    with pytest.raises(RuntimeError, match="flat"):
        bpy.ops.gwrap.mesh_region()
    region.scale.z = 1.0
    bpy.context.scene.gwrap.resolution = "EDGE_LENGTH"
    bpy.context.scene.gwrap.edge_length = 1e4
    with pytest.raises(RuntimeError, match="too coarse"):
        bpy.ops.gwrap.mesh_region()
    bpy.context.scene.gwrap.resolution = "AUTOMATIC"
    region.parent = None
    with pytest.raises(RuntimeError, match="belongs to no result"):
        bpy.ops.gwrap.mesh_region()
    assert read_job(Path(bpy.context.scene.gwrap.job_folder) / "job.json").command == "wrap"


def test_wrap_scene_refuses(photos: Path, worker: object) -> None:
    assert not bpy.ops.gwrap.wrap_scene.poll()
    scene = bpy.context.scene
    scene.gwrap.source = str(photos / "missing")
    with pytest.raises(RuntimeError, match="does not exist"):
        bpy.ops.gwrap.wrap_scene()
    scene.gwrap.source = str(photos)
    scene.gwrap.output = str(photos / "inside")
    with pytest.raises(RuntimeError, match="inside the photo folder"):
        bpy.ops.gwrap.wrap_scene()
    other = photos.with_name("other")
    other.mkdir()
    (other / "mine.txt").write_text("keep")
    scene.gwrap.output = str(other)
    with pytest.raises(RuntimeError, match="holds other files"):
        bpy.ops.gwrap.wrap_scene()
    assert [p.name for p in other.iterdir()] == ["mine.txt"]
    assert scene.gwrap.job_folder == ""


def test_a_missing_worker_python_is_named(
    photos: Path, worker: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PYTHON_VARIABLE, "/nowhere/python")
    bpy.context.scene.gwrap.source = str(photos)
    with pytest.raises(RuntimeError, match="/nowhere/python does not exist"):
        bpy.ops.gwrap.wrap_scene()


def test_import_waits_for_object_mode(photos: Path, worker: Callable[[str], None]) -> None:
    bpy.ops.mesh.primitive_cube_add()
    worker("slow")
    start_wrap(photos)
    wait_until_it_says_something(photos)
    bpy.ops.object.mode_set(mode="EDIT")
    (Path(bpy.context.scene.gwrap.job_folder) / "finish").touch()
    wait_for("DONE")
    assert job_timer.poll_jobs(), "the timer goes on"
    assert not list(addon.objects_of_kind(bpy.context.scene, "mesh"))
    assert "Leave Edit Mode" in draw(training_panel.GWRAP_PT_train).texts.replace("\n", " ")
    bpy.ops.object.mode_set(mode="OBJECT")
    assert not job_timer.poll_jobs()
    assert len(list(addon.objects_of_kind(bpy.context.scene, "mesh"))) == 1


def test_undo_does_not_lose_a_running_job(photos: Path, worker: Callable[[str], None]) -> None:
    worker("slow")
    start_wrap(photos)
    folder = bpy.context.scene.gwrap.job_folder
    bpy.context.scene.gwrap.job_folder = ""  # what undo does to a job started after the step
    assert jobs.after_undo in bpy.app.handlers.undo_post
    jobs.after_undo(bpy.context.scene)
    assert bpy.context.scene.gwrap.job_folder == folder


def test_undo_of_an_import_keeps_the_job(photos: Path, worker: object) -> None:
    start_wrap(photos)
    wait_for("DONE")
    properties = bpy.context.scene.gwrap
    folder = properties.job_folder
    properties.job_folder, properties.job_command = "", "MESH"
    jobs.after_undo(bpy.context.scene)
    assert (properties.job_folder, properties.job_command) == (folder, "WRAP")


def test_a_deleted_job_folder_is_survived(photos: Path, worker: Callable[[str], None]) -> None:

    worker("slow")
    start_wrap(photos)
    wait_until_it_says_something(photos)
    pid = status().pid  # type: ignore[attr-defined]
    shutil.rmtree(bpy.context.scene.gwrap.job_folder)
    job_timer.poll_jobs()
    draw(training_panel.GWRAP_PT_train)
    os.kill(pid, signal.SIGKILL)
    wait_for("FAILED", "LOST")
    with pytest.raises(RuntimeError, match="holds no job"):
        bpy.ops.gwrap.resume_job()


def test_check_photos_lists_findings(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        Finding("error", "Only 1 photo.", "Take more."),
        Finding("warning", "w" * 200),
    ]
    check = ModuleType("check")
    check.check_input = lambda source, **_: found if source == photos else []  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gaussian_wrapping_addon.core.loading.check", check)
    assert not bpy.ops.gwrap.check_photos.poll()
    bpy.context.scene.gwrap.source = str(photos)
    bpy.ops.gwrap.check_photos()
    texts = draw(dataset_panel.GWRAP_PT_dataset).texts
    assert "Only 1 photo." in texts
    assert "Take more." in texts
    assert max(len(line) for line in texts.splitlines()) < 60
    bpy.context.scene.gwrap.source = str(photos.parent)
    assert "Only 1 photo." not in draw(dataset_panel.GWRAP_PT_dataset).texts


def test_check_photos_of_a_folder_that_is_no_data_set(photos: Path) -> None:
    (photos / "notes.txt").write_text("no photo")
    bpy.context.scene.gwrap.source = str(photos)
    assert bpy.ops.gwrap.check_photos() == {"FINISHED"}
    found = list(bpy.context.scene.gwrap.findings)
    assert [f.severity for f in found].count("error") >= 1
    assert found[0].message
    assert all(f.hint for f in found if f.severity == "error")


def test_job_status_of_a_half_written_file_is_survived(
    photos: Path, worker: Callable[[str], None]
) -> None:
    worker("slow")
    start_wrap(photos)
    wait_until_it_says_something(photos)
    folder = Path(bpy.context.scene.gwrap.job_folder)
    (folder / "status.json").write_text('{"state": "RUNN')
    assert job_timer.poll_jobs()
    (folder / "status.json").write_text(json.dumps([1, 2]))
    assert job_timer.poll_jobs()
    draw(training_panel.GWRAP_PT_train)


def test_worker_choice_without_preferences() -> None:
    assert worker_setup.worker_choice(bpy.context) == worker_setup.WorkerChoice()


def test_the_device_of_the_preferences_is_the_jobs(
    photos: Path, worker: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(choice, "device_count", lambda: 1)
    worker("refuse")
    scene = bpy.context.scene
    scene.gwrap.source = str(photos)
    folder = jobs.start_wrap(scene, worker_setup.WorkerChoice(device="cuda"))
    assert read_job(folder / "job.json").settings.device == "cuda"
    wait_for("FAILED")
    job_timer.jobs[job_timer.key_of(str(folder))].client._process.wait(10)  # type: ignore[union-attr]
    jobs.resume(scene, worker_setup.WorkerChoice(device="cpu"))
    assert read_job(folder / "job.json").settings.device == "cpu"
    wait_for("FAILED")
    job_timer.jobs[job_timer.key_of(str(folder))].client._process.wait(10)  # type: ignore[union-attr]


def test_a_gpu_that_is_missing_starts_no_job(
    photos: Path, worker: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> int:
        raise DeviceError("There is no driver here.")

    monkeypatch.setattr(choice, "device_count", missing)
    worker("quick")
    scene = bpy.context.scene
    scene.gwrap.source = str(photos)
    with pytest.raises(DeviceError, match="cuda cannot be used: There is no driver here"):
        jobs.start_wrap(scene, worker_setup.WorkerChoice(device="cuda"))
    assert not photos.with_name(photos.name + "_wrap").exists()

# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs from the buttons to the objects, with a worker process that obeys the protocol."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.devices import choice
from gaussian_wrapping_addon.core.errors import DeviceError
from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.core.settings import to_json
from gaussian_wrapping_addon.ops import addon, background, job_timer, jobs, worker_setup
from gaussian_wrapping_addon.ui import mesh_panel, region_panel, result_panel, training_panel
from tests.blender.fake_layout import draw
from tests.blender.job_play import (
    running_job,
    select,
    start_wrap,
    status,
    wait_for,
)
from tests.blender.synthetic_result import BOX_SCENE, WORLD_FROM_SCENE

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
    assert job.settings.training.iterations == 1500
    wait_for("DONE")
    kinds = sorted(addon.kind_of(o) for o in bpy.context.scene.objects)
    assert kinds == ["camera"] * 4 + ["frame", "mesh", "region"]
    assert not job_timer.poll_jobs(), "the timer must stop when idle"
    assert background.poll() is None
    layout = draw(result_panel.GWRAP_PT_report)
    for text in ("27.2 dB", "4,321", "Faces\n12\n", "Closed\nYes\n", "87.5 %", "1 min 23 s"):
        assert text in layout.texts
    assert list(photos.iterdir()) == [], "nothing may be written into the photo folder"


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
    assert words in status().error
    assert status().state == state
    layout = draw(training_panel.GWRAP_PT_train)
    assert status().hint.split()[0] in layout.texts
    assert "gwrap.resume_job" in layout.operators
    worker("quick")
    bpy.ops.gwrap.resume_job()
    wait_for("DONE")


def test_a_worker_killed_from_outside_is_lost_and_can_be_resumed(
    photos: Path, worker: Callable[[str], None]
) -> None:
    running_job(photos, worker)
    os.kill(status().pid, signal.SIGKILL)
    wait_for("LOST")
    worker("quick")
    bpy.ops.gwrap.resume_job()
    wait_for("DONE")


def test_a_worker_that_ignores_cancelling_is_ended(
    photos: Path, worker: Callable[[str], None]
) -> None:
    running_job(photos, worker, "hang")
    pid = status().pid
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


def test_mesh_region_sends_world_coordinates_and_adds_a_mesh(photos: Path, worker: object) -> None:
    region = finished_wrap(photos)
    folder = Path(bpy.context.scene.gwrap.job_folder)
    frame = addon.frame_of(region)
    assert frame is not None
    frame.scale = (2, 2, 2)
    frame.rotation_euler = (0.3, -0.2, 1.0)
    frame.location = (3, 1, -2)
    properties = bpy.context.scene.gwrap
    chosen = {
        "decimate": True, "target_faces": 1234, "smooth_steps": 2, "method": "PIVOTS",
        "pivots": "9", "pivot_box": "GOF", "pivot_samples": "NONE", "mesh_cameras": "ALL",
        "boundary": "OPEN", "unseen": "OCCUPIED", "spacing": "UNIFORM", "normal_map": "OFF",
        "ambient_occlusion": True, "lods": 3, "max_atlases": 4, "resolution": "EDGE_LENGTH",
        "edge_length": 0.1,
    }  # fmt: skip
    for name, value in chosen.items():
        setattr(properties, name, value)
    select(region)
    region.name = "Front Door"
    assert "Mesh Region" in draw(mesh_panel.GWRAP_PT_mesh).texts
    assert bpy.ops.gwrap.mesh_region() == {"FINISHED"}
    job = read_job(folder / "job.json")
    assert job.command == "mesh"
    assert job.settings.preset == "standard"
    meshing = to_json(job.settings)["meshing"]
    assert meshing["edge_length"] == pytest.approx(0.1 / 2 * WORLD_FROM_SCENE.scale)
    assert meshing.items() >= {
        "target_faces": 1234, "smooth_steps": 2, "method": "pivots", "pivots": 9,
        "pivot_box": "gof", "pivot_samples": "none", "cameras": "all", "boundary": "open",
        "unseen": "occupied", "spacing": "uniform",
    }.items()  # fmt: skip
    texture = job.settings.texture
    assert (texture.normal_map, texture.ambient_occlusion, texture.lods) == ("off", "on", 3)
    assert texture.max_atlases == 4
    ((_, body),) = job.region_bodies.items()
    expected = WORLD_FROM_SCENE.points(BOX_SCENE)
    distances = np.linalg.norm(np.array(body["vertices"])[:, None] - expected, axis=2)
    assert distances.min(0).max() < 1e-4
    wait_for("DONE")
    meshes = {m[addon.REGION] for m in addon.objects_of_kind(bpy.context.scene, "mesh")}
    assert meshes == {"auto", "Front_Door"}
    regions = list(addon.objects_of_kind(bpy.context.scene, "region"))
    assert len(regions) == 2, "the automatic box comes back, the edited one is not doubled"


@pytest.mark.usefixtures("worker")
def test_train_for_regions_trains_the_same_photos_for_the_checked_ones(photos: Path) -> None:
    region = finished_wrap(photos)
    folder = Path(bpy.context.scene.gwrap.job_folder)
    first = read_job(folder / "job.json")
    assert first.settings.training.focus == '["auto"]'
    assert not bpy.ops.gwrap.train_for_regions.poll()
    region.gwrap.checked = True
    region.name = "Head"
    assert "Train for 1 Checked" in draw(region_panel.GWRAP_PT_region).texts
    assert bpy.ops.gwrap.train_for_regions() == {"FINISHED"}
    job = read_job(folder / "job.json")
    assert (job.command, job.source) == ("wrap", str(photos))
    ((_, body),) = job.region_bodies.items()
    (shape,) = json.loads(job.settings.training.focus)
    assert body["blender_object_name"] == "Head"
    assert shape.items() <= body.items()
    assert "blender_object_name" not in shape
    assert Path(bpy.context.scene.gwrap.job_folder) == folder
    wait_for("DONE")


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
    assert status().state == "DONE"


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
    folder = running_job(photos, worker)
    bpy.ops.object.mode_set(mode="EDIT")
    (folder / "finish").touch()
    wait_for("DONE")
    assert job_timer.poll_jobs(), "the timer goes on"
    assert not list(addon.objects_of_kind(bpy.context.scene, "mesh"))
    assert "Leave Edit Mode" in draw(training_panel.GWRAP_PT_train).texts.replace("\n", " ")
    bpy.ops.object.mode_set(mode="OBJECT")
    assert not job_timer.poll_jobs()
    assert len(list(addon.objects_of_kind(bpy.context.scene, "mesh"))) == 1


def test_undo_does_not_lose_a_running_job(photos: Path, worker: Callable[[str], None]) -> None:
    folder = running_job(photos, worker)
    properties = bpy.context.scene.gwrap
    properties.job_folder = ""  # what undo does to a job started after the step
    jobs.after_undo(bpy.context.scene)
    assert properties.job_folder == str(folder)
    (folder / "finish").touch()
    wait_for("DONE")
    properties.job_folder, properties.job_command = "", "MESH"  # undo of the import
    jobs.after_undo(bpy.context.scene)
    assert (properties.job_folder, properties.job_command) == (str(folder), "WRAP")


def test_job_status_of_a_half_written_file_is_survived(
    photos: Path, worker: Callable[[str], None]
) -> None:
    folder = running_job(photos, worker)
    (folder / "status.json").write_text('{"state": "RUNN')
    assert job_timer.poll_jobs()
    (folder / "status.json").write_text(json.dumps([1, 2]))
    assert job_timer.poll_jobs()
    draw(training_panel.GWRAP_PT_train)


def test_the_device_of_the_preferences_is_the_jobs(
    photos: Path, worker: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> int:
        raise DeviceError("There is no driver here.")

    worker("refuse")
    scene = bpy.context.scene
    scene.gwrap.source = str(photos)
    monkeypatch.setattr(choice, "device_count", missing)
    with pytest.raises(DeviceError, match="cuda cannot be used: There is no driver here"):
        jobs.start_wrap(scene, worker_setup.WorkerChoice(device="cuda"))
    folder = photos.with_name(photos.name + "_wrap")
    assert not folder.exists(), "no job without the GPU"
    monkeypatch.setattr(choice, "device_count", lambda: 1)
    for device, start in (("cuda", jobs.start_wrap), ("cpu", jobs.resume)):
        start(scene, worker_setup.WorkerChoice(device=device))
        assert read_job(folder / "job.json").settings.device == device
        wait_for("FAILED")
        job_timer.jobs[job_timer.key_of(str(folder))].client._process.wait(10)  # type: ignore[union-attr]

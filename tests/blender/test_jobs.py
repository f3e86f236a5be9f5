# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs from the buttons to the objects, with a worker process that obeys the protocol."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import stat
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import bpy
import numpy as np
import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.ops.common import background, known_jobs, tags
from gaussian_wrapping_addon.ops.jobs import job_attach, job_timer, watched_jobs
from gaussian_wrapping_addon.ops.worker import preferred_worker
from gaussian_wrapping_addon.ui.dataset import dataset_panel
from gaussian_wrapping_addon.ui.meshing import mesh_panel
from gaussian_wrapping_addon.ui.results import report_panel
from gaussian_wrapping_addon.ui.training import train_panel
from tests.blender.fake_layout import draw
from tests.blender.synthetic_result import BOX_SCENE, WORLD_FROM_SCENE

HERE = Path(__file__).parent

pytestmark = pytest.mark.usefixtures("ended_workers")


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos of été"
    folder.mkdir()
    return folder


@pytest.fixture
def worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Put the fake in the place of the worker's Python; the value says how it behaves."""
    script = tmp_path / "fake-python"
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{HERE / "fake_worker.py"}" "$@"\n')
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv(PYTHON_VARIABLE, str(script))

    def behave(mode: str) -> None:
        monkeypatch.setenv("GW_FAKE", mode)

    behave("quick")
    return behave


def start_wrap(photos: Path) -> None:
    bpy.context.scene.gwrap.source = str(photos)
    assert bpy.ops.gwrap.wrap_scene() == {"FINISHED"}


def status() -> object:
    return watched_jobs.status_of(bpy.context.scene.gwrap.job_folder)


def wait_for(*states: str, clock: Callable[[], float] = time.monotonic) -> None:
    """Play the timer, which never fires in background Blender."""
    end_s = time.monotonic() + 20.0
    while time.monotonic() < end_s:
        job_timer.poll_jobs(clock)
        if status().state in states:  # type: ignore[attr-defined]
            return
        time.sleep(0.02)
    pytest.fail(f"the job is {status()}")


def wait_until_it_says_something(folder: Path) -> None:
    end_s = time.monotonic() + 20.0
    while time.monotonic() < end_s:
        job_timer.poll_jobs()
        if status().fraction == 0.25:  # type: ignore[attr-defined]
            return
        time.sleep(0.02)
    pytest.fail(f"no word from the worker in {folder}")


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
    kinds = sorted(tags.kind_of(o) for o in bpy.context.scene.objects)
    assert kinds == ["camera"] * 4 + ["frame", "mesh", "region"]
    assert not job_timer.poll_jobs(), "the timer must stop when idle"
    assert background.poll() is None
    layout = draw(report_panel.GWRAP_PT_report)
    for text in ("27.2 dB", "4,321", "Faces\n12\n", "Closed\nYes\n", "87.5 %", "1 min 23 s"):
        assert text in layout.texts
    assert list(photos.iterdir()) == [], "nothing may be written into the photo folder"


def test_progress_cancel_and_resume(photos: Path, worker: Callable[[str], None]) -> None:
    worker("slow")
    start_wrap(photos)
    wait_until_it_says_something(photos)
    layout = draw(train_panel.GWRAP_PT_train)
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
    layout = draw(train_panel.GWRAP_PT_train)
    assert "Cancelled at 25 %" in layout.texts
    assert {"gwrap.resume_job", "gwrap.wrap_scene"} <= set(layout.operators)
    assert not bpy.ops.gwrap.cancel_job.poll()
    worker("quick")
    assert bpy.ops.gwrap.resume_job() == {"FINISHED"}
    wait_for("DONE")
    assert len(list(tags.objects_of_kind(bpy.context.scene, "mesh"))) == 1


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
    job = watched_jobs.jobs[watched_jobs.key_of(bpy.context.scene.gwrap.job_folder)]
    job.client._process.wait(10)  # type: ignore[union-attr]
    assert words in status().error  # type: ignore[attr-defined]
    assert status().state == state  # type: ignore[attr-defined]
    layout = draw(train_panel.GWRAP_PT_train)
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
    (region,) = tags.objects_of_kind(bpy.context.scene, "region")
    return region


def select(*things: bpy.types.Object) -> None:
    bpy.context.view_layer.update()
    for thing in bpy.context.view_layer.objects:
        thing.select_set(thing in things)
    bpy.context.view_layer.objects.active = things[0] if things else None


def test_mesh_region_sends_world_coordinates_and_adds_a_mesh(photos: Path, worker: object) -> None:
    region = finished_wrap(photos)
    folder = Path(bpy.context.scene.gwrap.job_folder)
    frame = tags.frame_of(region)
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
    meshes = {m[tags.REGION] for m in tags.objects_of_kind(bpy.context.scene, "mesh")}
    assert meshes == {"auto", "Front_Door"}
    regions = list(tags.objects_of_kind(bpy.context.scene, "region"))
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
    assert not list(tags.objects_of_kind(bpy.context.scene, "mesh"))
    assert "Leave Edit Mode" in draw(train_panel.GWRAP_PT_train).texts.replace("\n", " ")
    bpy.ops.object.mode_set(mode="OBJECT")
    assert not job_timer.poll_jobs()
    assert len(list(tags.objects_of_kind(bpy.context.scene, "mesh"))) == 1


def test_a_file_finds_its_running_job_again(
    photos: Path, tmp_path: Path, worker: Callable[[str], None]
) -> None:
    worker("slow")
    start_wrap(photos)
    wait_until_it_says_something(photos)
    folder = Path(bpy.context.scene.gwrap.job_folder)
    blend = tmp_path / "work.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    bpy.ops.wm.read_homefile(use_empty=True)
    (folder / "finish").touch()
    end_s = time.monotonic() + 20
    while watched_jobs.jobs[str(folder)].status.state != "DONE" and time.monotonic() < end_s:
        job_timer.poll_jobs()
        time.sleep(0.02)
    assert len(bpy.data.objects) == 0, "another file gets nothing"
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert status().state == "DONE"  # type: ignore[attr-defined]
    job_timer.poll_jobs()
    wait_for("DONE")
    assert len(list(tags.objects_of_kind(bpy.context.scene, "mesh"))) == 1


def test_another_blender_finds_the_job_and_offers_its_result(
    photos: Path, tmp_path: Path, worker: object
) -> None:
    start_wrap(photos)
    blend = tmp_path / "work.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    wait_for("DONE")
    job_timer.forget_all()  # as after a crash of Blender
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert status().state == "DONE"  # type: ignore[attr-defined]
    assert not job_timer.poll_jobs()
    assert len(bpy.data.objects) == 0, "opening a file imports nothing by itself"
    assert "Import Finished Result" in draw(train_panel.GWRAP_PT_train).texts
    bpy.ops.gwrap.import_result(directory=watched_jobs.result_to_import(bpy.context.scene))
    assert "Import Finished Result" not in draw(train_panel.GWRAP_PT_train).texts


def test_a_project_folder_that_was_moved_asks_before_its_job_is_read(
    photos: Path, tmp_path: Path, worker: object
) -> None:
    project = tmp_path / "project"
    bpy.context.scene.gwrap.output = str(project / "job")
    start_wrap(photos)
    wait_for("DONE")
    bpy.ops.wm.save_as_mainfile(filepath=str(project / "work.blend"))
    job_timer.forget_all()
    os.rename(project, tmp_path / "moved")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "moved" / "work.blend"))
    assert watched_jobs.jobs == {}, "a downloaded folder beside a file looks the same"
    assert "gwrap.find_job" in draw(train_panel.GWRAP_PT_train).operators
    bpy.ops.gwrap.find_job(directory=str(tmp_path / "moved" / "job"))
    assert status().state == "DONE"  # type: ignore[attr-defined]
    job_timer.forget_all()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "moved" / "work.blend"))
    assert status().state == "DONE"  # type: ignore[attr-defined]
    assert Path(bpy.context.scene.gwrap.job_folder) == tmp_path / "moved" / "job"


@pytest.mark.skipif(os.name == "nt", reason="Windows has no named pipes in folders")
@pytest.mark.parametrize("asked", [False, True])
@pytest.mark.parametrize("name", ["status.json", "lock.json", "job-finished.json", "job.json"])
def test_opening_a_file_never_waits_for_a_pipe_in_the_folder_beside_it(
    photos: Path, tmp_path: Path, worker: object, name: str, asked: bool
) -> None:
    bpy.context.scene.gwrap.output = str(tmp_path / "job")
    start_wrap(photos)
    wait_for("DONE")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"))
    job_timer.forget_all()
    (tmp_path / "job" / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / "job" / name)
    if not asked:
        known_jobs._session.clear()  # another person's machine
    begun_s = time.monotonic()
    with alarm(5):
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "work.blend"))
        assert (watched_jobs.jobs != {}) == asked
        job_timer.poll_jobs()
        draw(train_panel.GWRAP_PT_train)
    assert time.monotonic() - begun_s < 4.0


@contextlib.contextmanager
def alarm(seconds: int) -> Iterator[None]:
    """End this process, rather than hang, where a pipe is opened and nobody writes to it."""
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)


def test_a_job_whose_folder_was_deleted_is_told_and_forgotten(
    photos: Path, tmp_path: Path, worker: object
) -> None:
    start_wrap(photos)
    wait_for("DONE")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"))
    job_timer.forget_all()
    shutil.rmtree(bpy.context.scene.gwrap.job_folder)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "work.blend"))
    assert "is gone" in draw(train_panel.GWRAP_PT_train).texts
    assert not bpy.ops.gwrap.resume_job.poll()
    assert bpy.ops.gwrap.wrap_scene.poll()
    start_wrap(photos)
    wait_for("DONE")
    assert "is gone" not in draw(train_panel.GWRAP_PT_train).texts


@pytest.mark.parametrize("stored", ["{job}", "/", "//../../..", r"\\server\share\job", "//x\0y"])
def test_a_file_from_elsewhere_opens_no_job_unasked(
    photos: Path, tmp_path: Path, worker: object, stored: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    start_wrap(photos)
    wait_for("DONE")
    folder = bpy.context.scene.gwrap.job_folder
    bpy.context.scene.gwrap.job_folder = stored.format(job=folder)
    elsewhere = tmp_path / "downloads"
    elsewhere.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(elsewhere / "work.blend"))
    job_timer.forget_all()
    monkeypatch.setattr(known_jobs, "_session", [])  # another person's machine
    bpy.ops.wm.open_mainfile(filepath=str(elsewhere / "work.blend"))
    assert watched_jobs.jobs == {}
    if bpy.context.scene.gwrap.job_folder:
        assert "gwrap.find_job" in draw(train_panel.GWRAP_PT_train).operators
    bpy.ops.gwrap.find_job(directory=folder)
    assert status().state == "DONE"  # type: ignore[attr-defined]


def test_find_job_refuses_other_folders(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="holds no job"):
        bpy.ops.gwrap.find_job(directory=str(tmp_path))


def test_undo_does_not_lose_a_running_job(photos: Path, worker: Callable[[str], None]) -> None:
    worker("slow")
    start_wrap(photos)
    folder = bpy.context.scene.gwrap.job_folder
    bpy.context.scene.gwrap.job_folder = ""  # what undo does to a job started after the step
    assert job_attach.after_undo in bpy.app.handlers.undo_post
    job_attach.after_undo(bpy.context.scene)
    assert bpy.context.scene.gwrap.job_folder == folder


def test_undo_of_an_import_keeps_the_job(photos: Path, worker: object) -> None:
    start_wrap(photos)
    wait_for("DONE")
    properties = bpy.context.scene.gwrap
    folder = properties.job_folder
    properties.job_folder, properties.job_command = "", "MESH"
    job_attach.after_undo(bpy.context.scene)
    assert (properties.job_folder, properties.job_command) == (folder, "WRAP")


def test_disabling_the_addon_leaves_the_job_to_be_found(
    photos: Path, tmp_path: Path, worker: Callable[[str], None], addon: ModuleType
) -> None:
    worker("slow")
    start_wrap(photos)
    wait_until_it_says_something(photos)
    folder = Path(bpy.context.scene.gwrap.job_folder)
    client = watched_jobs.jobs[str(folder)].client
    addon.unregister()
    assert client.poll().active, "the worker goes on"
    addon.register()
    job_attach.attach_later()
    assert watched_jobs.is_running(bpy.context.scene.gwrap.job_folder)
    (folder / "finish").touch()
    wait_for("DONE")
    assert len(list(tags.objects_of_kind(bpy.context.scene, "mesh"))) == 1


def test_a_deleted_job_folder_is_survived(photos: Path, worker: Callable[[str], None]) -> None:
    import shutil

    worker("slow")
    start_wrap(photos)
    wait_until_it_says_something(photos)
    pid = status().pid  # type: ignore[attr-defined]
    shutil.rmtree(bpy.context.scene.gwrap.job_folder)
    job_timer.poll_jobs()
    draw(train_panel.GWRAP_PT_train)
    os.kill(pid, signal.SIGKILL)
    wait_for("FAILED", "LOST")
    with pytest.raises(RuntimeError, match="holds no job"):
        bpy.ops.gwrap.resume_job()


def test_check_photos_lists_findings(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = [
        SimpleNamespace(severity="error", message="Only 1 photo.", hint="Take more.", short=""),
        SimpleNamespace(severity="warning", message="w" * 200, hint="", short=""),
    ]
    check = ModuleType("check")
    check.check_input = lambda source: found if source == photos else []  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gaussian_wrapping_addon.core.dataset.loading.check", check)
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
    draw(train_panel.GWRAP_PT_train)


def test_worker_choice_without_preferences() -> None:
    assert preferred_worker.worker_choice(bpy.context) == preferred_worker.WorkerChoice()

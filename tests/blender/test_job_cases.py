# SPDX-License-Identifier: GPL-3.0-or-later
"""What people and machines do to a job while it runs, by number of the list of bad cases.

| number | case | tests |
|---|---|---|
| 38 | undo, File New, open another, save elsewhere, disable, reload, in each stage | test_38 |
| 38 | quit | test_killed_blender.py |
| 39 | two jobs; two Blenders; stale lock, re-used pid, clock moved back | test_39 |
| 40 | worker crashed, killed | test_jobs.py; out of memory: core/jobs/test_worker.py |
| 41 | cancel in each stage, twice, in the import, not listened to | test_41, test_jobs.py |
| 43 | folder long, not to be written, deleted while running | test_43 |
| 43 | folder moved | test_found_jobs.py |
| 44 | worker's Python missing | test_jobs.py |
| 45 | .blend or job folder from elsewhere | test_45, test_found_jobs.py |
| - | Blender is never blocked | test_no_tick, test_bringing_in |
"""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest

import gaussian_wrapping_addon
from gaussian_wrapping_addon import registration
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.jobs import client as client_module
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.worker.spawn import process_start_ticks
from gaussian_wrapping_addon.ops import background, job_timer, jobs
from gaussian_wrapping_addon.ops.result_files import read_result
from gaussian_wrapping_addon.ui import training_panel
from tests.blender.fake_layout import draw
from tests.blender.job_play import (
    meshes,
    play_to,
    play_to_stage,
    play_until,
    running_job,
    start_wrap,
    status_of,
)
from tests.blender.synthetic_result import npy_bytes, png_bytes

PREVIEW_PX = 640
"""Width of the pictures that trainings write (training/live_view.py)."""

pytestmark = pytest.mark.usefixtures("ended_workers")

STAGES = ("cameras", "train", "texture", "import")
STALL_S = 0.05
POLL_WAIT_S = job_timer.POLL_WAIT_S
"""As people have it; the fixture ``addon`` waits longer, so that one look is enough."""

GRID = 317
"""Vertices a side of the typical mesh: 199 712 faces."""


class _HeldReading(background.Task):
    """A reading that lasts until the test lets it end."""

    hold = threading.Event()

    def __init__(self, folder: Path) -> None:
        super().__init__(lambda: read_result(folder))
        threading.Thread(target=self.run, daemon=True).start()

    def finished(self, wait_s: float = 0.0) -> bool:
        return self.hold.is_set() and super().finished(wait_s)


@pytest.fixture
def hold(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Let the reading of results last until this is set."""
    monkeypatch.setattr(_HeldReading, "hold", threading.Event())
    monkeypatch.setattr(job_timer, "_reading", _HeldReading)
    return _HeldReading.hold


def job_in(stage: str, photos: Path, worker: Callable[[str, str], None]) -> Path:
    """Start a job and play it into a stage, where it stays."""
    worker("slow", "export" if stage == "import" else stage)
    folder = start_wrap(photos)
    if stage == "import":
        (folder / "finish").touch()
    play_to_stage(folder, stage)
    return folder


# 38


def _undo(_blend: Path) -> None:
    bpy.context.scene.gwrap.job_folder = ""  # what undo does to a job started after the step
    jobs.after_undo(bpy.context.scene)


def _file_new(blend: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    bpy.ops.wm.read_homefile(use_empty=True)
    job_timer.poll_jobs()
    assert len(bpy.data.objects) == 0
    bpy.ops.wm.open_mainfile(filepath=str(blend))


def _open_another(blend: Path) -> None:
    other = blend.with_name("other.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    folder = bpy.context.scene.gwrap.job_folder
    bpy.context.scene.gwrap.job_folder = ""
    bpy.ops.wm.save_as_mainfile(filepath=str(other), copy=True)
    bpy.context.scene.gwrap.job_folder = folder
    bpy.ops.wm.open_mainfile(filepath=str(other))
    job_timer.poll_jobs()
    assert bpy.context.scene.gwrap.job_folder == ""
    assert meshes() == 0, "another file gets nothing"
    bpy.ops.wm.open_mainfile(filepath=str(blend))


def _save_elsewhere(blend: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    (blend.parent / "deep" / "er").mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(blend.parent / "deep" / "er" / "work.blend"))


def _disable(blend: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    gaussian_wrapping_addon.unregister()
    gaussian_wrapping_addon.register()
    jobs.attach_later()


def _reload(blend: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    gaussian_wrapping_addon.unregister()
    importlib.reload(registration)
    gaussian_wrapping_addon.register()
    jobs.attach_later()


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize(
    "action", [_undo, _file_new, _open_another, _save_elsewhere, _disable, _reload]
)
def test_38_the_job_is_found_again(
    action: Callable[[Path], None],
    stage: str,
    photos: Path,
    tmp_path: Path,
    worker: Callable[[str, str], None],
    hold: threading.Event,
) -> None:
    folder = job_in(stage, photos, worker)
    action(tmp_path / "work.blend")
    assert Path(bpy.context.scene.gwrap.job_folder) == folder
    hold.set()
    if stage != "import":
        assert status_of(folder).active
        assert bpy.ops.gwrap.cancel_job.poll()
        (folder / "finish").touch()
    play_to(folder, "DONE")
    if stage == "import" and action in (_disable, _reload):
        assert meshes() == 0, "what was finished before is offered, not imported unasked"
        assert "Import Finished Result" in draw(training_panel.GWRAP_PT_train).texts
        bpy.ops.gwrap.import_result(directory=job_timer.result_to_import(bpy.context.scene))
    else:
        play_until(lambda: meshes() == 1, "never imported")
    assert meshes() == 1
    play_until(lambda: not JobFolder(folder).locked(), "still locked")


# 39


def test_39_two_jobs_in_two_scenes(
    photos: Path, tmp_path: Path, worker: Callable[[str, str], None]
) -> None:
    worker("slow")
    first = start_wrap(photos)
    other_photos = tmp_path / "others"
    other_photos.mkdir()
    scene = bpy.data.scenes.new("Second")
    with bpy.context.temp_override(scene=scene):
        second = start_wrap(other_photos, scene)
    for folder in (first, second):
        play_until(lambda folder=folder: status_of(folder).fraction == 0.25, "never at work")  # type: ignore[misc]
        (folder / "finish").touch()
    play_to(first, "DONE")
    play_to(second, "DONE")
    for found in bpy.data.scenes:
        assert sum(o.get("gwrap_kind") == "mesh" for o in found.objects) == 1


def test_39_a_second_blender_is_refused_with_words(
    photos: Path, worker: Callable[[str, str], None]
) -> None:
    folder = job_in("train", photos, worker)
    job = read_job(folder / "job.json")
    before = (folder / "job.json").read_bytes()
    for start in (lambda: JobClient.start(folder, job), lambda: JobClient.resume(folder)):
        with pytest.raises(UsageError, match="A job is running in"):
            start()
    assert (folder / "job.json").read_bytes() == before
    assert status_of(folder).active
    job_timer.forget_all_jobs()  # a Blender that did not start the job opens the same file
    bpy.ops.gwrap.find_job(directory=str(folder))
    assert not bpy.ops.gwrap.wrap_scene.poll()
    bpy.ops.gwrap.cancel_job()
    play_to(folder, "CANCELLED")


def test_39_a_stale_lock_is_taken_over(photos: Path, worker: Callable[[str, str], None]) -> None:
    folder = job_in("train", photos, worker)
    bpy.ops.gwrap.cancel_job()
    play_to(folder, "CANCELLED")
    target, here = JobFolder(folder), os.getpid()
    play_until(lambda: not target.locked(), "still locked")
    owner = {"pid": here, "started": process_start_ticks(here) + 1}  # its number was used again
    (folder / "lock.json").write_text(json.dumps(owner))
    status = target.read_status()
    target.write_status(replace(status, state="RUNNING", pid=here, pid_started=1, heartbeat_s=0.0))
    bpy.ops.gwrap.find_job(directory=str(folder))
    assert status_of(folder).state == "LOST"
    assert "gwrap.resume_job" in draw(training_panel.GWRAP_PT_train).operators
    assert (folder / "lock.json").is_file(), "it is the worker that takes over"
    worker("quick", "train")
    bpy.ops.gwrap.resume_job()
    play_to(folder, "DONE")
    play_until(lambda: not (folder / "lock.json").exists(), "still locked")


# 41


@pytest.mark.parametrize("stage", STAGES)
def test_41_cancelled_twice_in_each_stage(
    stage: str, photos: Path, worker: Callable[[str, str], None], hold: threading.Event
) -> None:
    folder = job_in(stage, photos, worker)
    begun_s = time.monotonic()
    if stage != "import":
        assert not bpy.ops.gwrap.wrap_scene.poll(), "one job at a time"
        assert not bpy.ops.gwrap.resume_job.poll()
    bpy.ops.gwrap.cancel_job()
    if stage == "import":
        assert status_of(folder).state == "DONE", "nothing of a finished job is lost"
        assert not (folder / "cancel").exists()
        hold.set()
        assert not job_timer.poll_jobs()
        assert meshes() == 0
        assert "Import Finished Result" in draw(training_panel.GWRAP_PT_train).texts
        return
    bpy.ops.gwrap.cancel_job()
    play_to(folder, "CANCELLED")
    assert time.monotonic() - begun_s < 12.0
    play_until(lambda: not JobFolder(folder).locked(), "still locked")
    worker("quick", stage)
    hold.set()
    bpy.ops.gwrap.resume_job()
    play_to(folder, "DONE")
    assert meshes() == 1


def test_41_a_worker_of_another_blender_that_does_not_listen_is_killed(
    photos: Path, worker: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client_module, "KILL_GRACE_S", 0.2)
    folder = running_job(photos, worker, "hang")
    process = job_timer.jobs[str(folder)].client._process
    job_timer.forget_all_jobs()
    bpy.ops.gwrap.find_job(directory=str(folder))
    job_timer.jobs[str(folder)].client.kill()
    assert process is not None
    assert process.wait(5) == -9
    play_to(folder, "LOST")


# 43


def test_43_a_folder_deleted_while_the_job_runs(
    photos: Path, worker: Callable[[str, str], None]
) -> None:
    folder = job_in("train", photos, worker)
    shutil.rmtree(folder)
    play_to(folder, "FAILED", "LOST")
    assert status_of(folder).error
    draw(training_panel.GWRAP_PT_train)
    with pytest.raises(RuntimeError, match="holds no job"):
        bpy.ops.gwrap.resume_job()


def test_43_a_folder_that_cannot_be_written(photos: Path, worker: object) -> None:
    bpy.context.scene.gwrap.output = "/proc/gwrap" if os.path.isdir("/proc") else "/gwrap"
    bpy.context.scene.gwrap.source = str(photos)
    with pytest.raises(RuntimeError, match="cannot be written"):
        bpy.ops.gwrap.wrap_scene()
    assert bpy.context.scene.gwrap.job_folder == ""


def test_43_a_long_path_in_other_letters(
    photos: Path, tmp_path: Path, worker: Callable[[str, str], None]
) -> None:
    folder = tmp_path / ("ä ö 写真 " * 10) / ("x" * 120) / "job"
    bpy.context.scene.gwrap.output = str(folder)
    assert start_wrap(photos) == folder
    play_to(folder, "DONE")
    assert meshes() == 1


# 45


@pytest.mark.parametrize(
    "values",
    [
        {"state": "RUNNING", "pid": "7", "fraction": 0.5},
        {"state": "SOMETHING"},
        {"state": "DONE", "result": "//server/share/result"},
        {"figures": [1], "message": {}},
    ],
)
def test_45_a_status_from_elsewhere_breaks_nothing(
    values: dict[str, object], photos: Path, worker: object
) -> None:
    folder = start_wrap(photos)
    play_to(folder, "DONE")
    (folder / "status.json").write_text(json.dumps(values))
    job_timer.forget_all_jobs()
    bpy.ops.gwrap.find_job(directory=str(folder))
    job_timer.poll_jobs()
    draw(training_panel.GWRAP_PT_train)
    shown = status_of(folder)
    assert shown.result in ("", str(folder / "result")), "nothing outside the folder is read"


def test_45_cancelling_a_job_from_elsewhere_ends_no_other_program(
    photos: Path, worker: object
) -> None:
    folder = start_wrap(photos)
    play_to(folder, "DONE")
    victim = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        JobFolder(folder).write_status(
            JobStatus("RUNNING", pid=victim.pid, pid_started=process_start_ticks(victim.pid))
        )
        job_timer.forget_all_jobs()
        bpy.ops.gwrap.find_job(directory=str(folder))
        assert status_of(folder).active
        job_timer.jobs[str(folder)].client.kill()
        time.sleep(0.1)
        assert victim.poll() is None
    finally:
        victim.kill()
        victim.wait()


# Blender is never blocked


def _waited_s() -> float:
    """Return how long this thread has waited for a processor that others had; Linux tells."""
    try:
        return int(Path("/proc/thread-self/schedstat").read_text().split()[1]) * 1e-9
    except OSError:
        return 0.0


def _longest_s(folder: Path, rounds: int) -> float:
    """Return the longest time that Blender's thread spends in one tick or one drawing."""
    longest_s = 0.0
    for _ in range(rounds):
        for work in (job_timer.poll_jobs, lambda: draw(training_panel.GWRAP_PT_train)):
            begun_s = time.perf_counter() - _waited_s()
            work()
            longest_s = max(longest_s, time.perf_counter() - _waited_s() - begun_s)
        time.sleep(0.005)  # for the thread that reads pictures
    assert status_of(folder).active
    return longest_s


def test_no_tick_blocks_blender(
    photos: Path, worker: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a long log and new pictures of the size that trainings write, at every look."""
    folder = job_in("train", photos, worker)
    monkeypatch.setattr(job_timer, "EVERY_S", 0.0)
    monkeypatch.setattr(job_timer, "POLL_WAIT_S", POLL_WAIT_S)
    for name in ("log.txt", "worker-output.txt"):
        (folder / name).write_bytes(b"2026-01-01 12:00:00 INFO train 12.3 % a line\n" * 200_000)
    random = np.random.default_rng(0)
    noise = random.integers(0, 255, (240, PREVIEW_PX, 3)).astype(np.uint8)
    path = folder / "stages" / "train-now" / job_timer.PICTURE
    longest_s = []
    for attempt in range(3):
        path.write_bytes(npy_bytes(noise[:, :: -1 if attempt % 2 else 1]))
        longest_s.append(_longest_s(folder, 20))
    assert min(longest_s) < STALL_S, longest_s
    assert len(job_timer.icons_of(str(folder))) == 2, "pictures were shown meanwhile"


def test_bringing_in_a_typical_mesh_blocks_for_less_than_a_second(
    photos: Path, worker: object, hold: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    """200 000 faces, a texture of 4096 pixels, 100 cameras."""
    folder = start_wrap(photos)
    play_to_stage(folder, "import")
    result = folder / "result"
    _make_typical(result)
    reading = _HeldReading(result)
    hold.set()
    job_timer.jobs[str(folder)].reading = reading
    longest_s = 0.0
    while status_of(folder).stage == "import" and not meshes():
        begun_s = time.perf_counter() - _waited_s()
        job_timer.poll_jobs()
        longest_s = max(longest_s, time.perf_counter() - _waited_s() - begun_s)
        time.sleep(0.01)
    (mesh,) = (o for o in bpy.context.scene.objects if o.get("gwrap_kind") == "mesh")
    assert len(mesh.data.polygons) == 2 * (GRID - 1) ** 2
    assert not mesh.data.validate(), "Blender finds nothing to repair"
    assert longest_s < 1.0


def _make_typical(result: Path) -> None:
    i, j = np.meshgrid(np.arange(GRID), np.arange(GRID), indexing="ij")
    vertices = np.stack([i, j, 5 * np.sin(0.1 * i)], -1).reshape(-1, 3) / GRID  # (v, 3)
    k = np.arange(GRID * GRID).reshape(GRID, GRID)
    first = np.stack([k[:-1, :-1], k[1:, :-1], k[1:, 1:]], -1).reshape(-1, 3)
    second = np.stack([k[:-1, :-1], k[1:, 1:], k[:-1, 1:]], -1).reshape(-1, 3)
    faces = np.concatenate([first, second]).astype(np.int32)  # (f, 3)
    uvs = vertices[faces][..., :2].astype(np.float32)  # (f, 3, 2)
    np.savez(result / "auto" / "mesh.npz", vertices=vertices, faces=faces, corner_uvs=uvs)
    rows = np.arange(4096, dtype=np.uint8)
    pixels = np.broadcast_to(rows[:, None, None], (4096, 4096, 3))
    (result / "auto" / "albedo.png").write_bytes(png_bytes(pixels))
    scene = json.loads((result / "scene.json").read_text())
    known = scene["cameras"]
    scene["cameras"] = [{**known[n % 4], "photo": f"/photos/{n}.jpg"} for n in range(100)]
    (result / "scene.json").write_text(json.dumps(scene))

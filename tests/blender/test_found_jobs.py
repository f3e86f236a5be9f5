# SPDX-License-Identifier: GPL-3.0-or-later
"""A file finds its job again, or does not take one from elsewhere unasked."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import pytest

from gaussian_wrapping_addon.ops import addon, job_timer
from gaussian_wrapping_addon.ui import training_panel
from tests.blender.fake_layout import draw
from tests.blender.job_play import (
    meshes,
    play_to,
    running_job,
    start_wrap,
    status,
    wait_for,
)

pytestmark = pytest.mark.usefixtures("ended_workers")


def test_a_file_finds_its_running_job_again(
    photos: Path, tmp_path: Path, worker: Callable[[str], None]
) -> None:
    folder = running_job(photos, worker)
    blend = tmp_path / "work.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    bpy.ops.wm.read_homefile(use_empty=True)
    (folder / "finish").touch()
    play_to(folder, "DONE")
    assert len(bpy.data.objects) == 0, "another file gets nothing"
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert status().state == "DONE"
    job_timer.poll_jobs()
    wait_for("DONE")
    assert meshes() == 1


def test_another_blender_finds_the_job_and_offers_its_result(
    photos: Path, tmp_path: Path, worker: object
) -> None:
    start_wrap(photos)
    blend = tmp_path / "work.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    wait_for("DONE")
    job_timer.forget_all_jobs()  # as after a crash of Blender
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert status().state == "DONE"
    assert not job_timer.poll_jobs()
    assert len(bpy.data.objects) == 0, "opening a file imports nothing by itself"
    assert "Import Finished Result" in draw(training_panel.GWRAP_PT_train).texts
    bpy.ops.gwrap.import_result(directory=job_timer.result_to_import(bpy.context.scene))
    assert "Import Finished Result" not in draw(training_panel.GWRAP_PT_train).texts


def test_a_project_folder_that_was_moved_asks_before_its_job_is_read(
    photos: Path, tmp_path: Path, worker: object
) -> None:
    project = tmp_path / "project"
    bpy.context.scene.gwrap.output = str(project / "job")
    start_wrap(photos)
    wait_for("DONE")
    bpy.ops.wm.save_as_mainfile(filepath=str(project / "work.blend"))
    job_timer.forget_all_jobs()
    os.rename(project, tmp_path / "moved")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "moved" / "work.blend"))
    assert job_timer.jobs == {}, "a downloaded folder beside a file looks the same"
    assert "gwrap.find_job" in draw(training_panel.GWRAP_PT_train).operators
    bpy.ops.gwrap.find_job(directory=str(tmp_path / "moved" / "job"))
    assert status().state == "DONE"
    job_timer.forget_all_jobs()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "moved" / "work.blend"))
    assert status().state == "DONE"
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
    job_timer.forget_all_jobs()
    (tmp_path / "job" / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / "job" / name)
    if not asked:
        addon._session.clear()  # another person's machine
    begun_s = time.monotonic()
    with alarm(5):
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "work.blend"))
        assert (job_timer.jobs != {}) == asked
        job_timer.poll_jobs()
        draw(training_panel.GWRAP_PT_train)
    assert time.monotonic() - begun_s < 4.0


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_a_file_whose_folders_are_links_in_a_circle_opens(tmp_path: Path, addon: object) -> None:
    circle = tmp_path / "circle"
    circle.symlink_to(circle)
    properties = bpy.context.scene.gwrap
    properties.source = properties.output = properties.job_folder = str(circle)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work.blend"))
    job_timer.forget_all_jobs()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "work.blend"))
    assert job_timer.jobs == {}
    draw(training_panel.GWRAP_PT_train)
    with pytest.raises(RuntimeError, match="circle") as refused:
        bpy.ops.gwrap.wrap_scene()
    assert "Traceback" not in str(refused.value)


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
    job_timer.forget_all_jobs()
    shutil.rmtree(bpy.context.scene.gwrap.job_folder)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "work.blend"))
    assert "is gone" in draw(training_panel.GWRAP_PT_train).texts
    assert not bpy.ops.gwrap.resume_job.poll()
    assert bpy.ops.gwrap.wrap_scene.poll()
    start_wrap(photos)
    wait_for("DONE")
    assert "is gone" not in draw(training_panel.GWRAP_PT_train).texts


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
    job_timer.forget_all_jobs()
    monkeypatch.setattr(addon, "_session", [])  # another person's machine
    bpy.ops.wm.open_mainfile(filepath=str(elsewhere / "work.blend"))
    assert job_timer.jobs == {}
    if bpy.context.scene.gwrap.job_folder:
        assert "gwrap.find_job" in draw(training_panel.GWRAP_PT_train).operators
    bpy.ops.gwrap.find_job(directory=folder)
    assert status().state == "DONE"


def test_find_job_refuses_other_folders(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="holds no job"):
        bpy.ops.gwrap.find_job(directory=str(tmp_path))

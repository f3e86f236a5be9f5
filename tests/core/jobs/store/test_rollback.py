# SPDX-License-Identifier: GPL-3.0-or-later
"""A failed mesh rolls a finished job back; later commands see no trace of it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, read_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.jobs.store.rollback import NAME, finished_job, save_rollback
from gaussian_wrapping_addon.core.settings import JobSettings

WORKER = """
import sys
sys.path[:0] = {path!r}
from gaussian_wrapping_addon.core.errors import {error}
from gaussian_wrapping_addon.core.jobs import runner, worker
from gaussian_wrapping_addon.core.jobs.store.stage_folder import run_stage
from gaussian_wrapping_addon.core.progress import Progress
def work(folder, progress):
    (folder / "tiles").mkdir(exist_ok=True)
    raise {raised}
def run_job(folder, job, event, cancelled):
    for name in ("train", "mesh-first"):
        run_stage(folder.stages, name, "done", Progress(), lambda *_: {{}})
    {failing}
runner.run_job = run_job
sys.exit(worker.main([{root!r}, "0"]))
"""


def work(folder: JobFolder, raised: str = 'MeshingError("No surface.", "Draw it elsewhere.")'):
    """Run a worker whose meshing ends like this; in order where it is empty."""
    text = WORKER.format(
        path=sys.path, error=raised.split("(")[0] or "WrapError", raised=raised or "0",
        failing='run_stage(folder.stages, "mesh-bad", "k", Progress(), work)' if raised else "pass",
        root=str(folder.root),
    )  # fmt: skip
    return subprocess.run([sys.executable, "-c", text], check=False).returncode


@pytest.fixture
def folder(tmp_path: Path) -> JobFolder:
    (tmp_path / "photos").mkdir()
    folder = JobFolder(tmp_path / "out")
    folder.create()
    write_job(folder.job_path, make_job("wrap", tmp_path / "photos", JobSettings()))
    (folder.stages / "train-before").mkdir()
    (folder.stages / "mesh-auto-begun").mkdir()  # of a mesh that was stopped, some time ago
    folder.write_status(JobStatus("DONE", "export", 1.0, exit_code=0, result=str(folder.result)))
    return folder


def begin(folder: JobFolder, command: str = "mesh", **settings: object) -> JobFile:
    """Write a job into the folder as the client does."""
    changed = replace(read_job(folder.job_path).settings, **settings)
    job = make_job(command, folder.root.parent / "photos", changed)
    save_rollback(folder, job)
    write_job(folder.job_path, job)
    folder.write_status(JobStatus())
    return job


def test_a_failed_mesh_leaves_the_job_as_it_was(folder: JobFolder) -> None:
    job, status = read_job(folder.job_path), folder.read_status()
    begin(folder, regions=("all",))
    assert finished_job(folder) == job
    client = JobClient.attach(folder.root)
    client._seen_active = True
    assert work(folder) == 3
    assert read_job(folder.job_path) == job
    after = folder.read_status()
    assert (after.error, after.hint, after.exit_code) == ("No surface.", "Draw it elsewhere.", 3)
    assert after.put_back
    same = {"error": "", "hint": "", "exit_code": 0, "heartbeat_s": status.heartbeat_s}
    assert replace(after, **same, put_back=False) == status
    assert {path.name for path in folder.stages.iterdir()} == {
        "train-before", "train-done", "mesh-first-done", "mesh-auto-begun",
    }  # fmt: skip
    assert not (folder.root / NAME).exists()
    # Who waited for the mesh is told that it failed; who comes later finds a finished job.
    assert client.poll().state == "FAILED"
    assert JobClient.attach(folder.root).poll().state == "DONE"
    assert work(folder, "") == 0
    assert (folder.read_status().error, folder.read_status().put_back) == ("", False)


def test_a_copy_that_is_put_back_names_its_own_place(folder: JobFolder) -> None:
    begin(folder, regions=("all",))
    copy = JobFolder(folder.root.parent / "copy")
    shutil.copytree(folder.root, copy.root)
    assert work(copy) == 3
    assert copy.read_status().result == str(copy.result)


def test_an_unexpected_failure_and_one_after_another_do_as_well(folder: JobFolder) -> None:
    job = read_job(folder.job_path)
    for raised in ('MeshingError("a")', "MeshingError(1 / 0)", "MeshingError(bytes(10**15))"):
        begin(folder, regions=("all",))
        assert work(folder, raised) != 0
        assert read_job(folder.job_path) == job
        assert folder.read_status().state == "DONE"
        assert folder.read_status().error


def test_a_mesh_that_was_stopped_can_be_resumed_but_is_not_the_finished_job(
    folder: JobFolder,
) -> None:
    job = read_job(folder.job_path)
    stopped = begin(folder, regions=("all",))
    assert work(folder, "Cancelled()") == 5
    assert folder.read_status().state == "CANCELLED"
    assert read_job(folder.job_path) == stopped
    assert (folder.stages / "mesh-bad-k" / "tiles").is_dir()
    assert finished_job(folder) == job
    # Another one that fails leaves the job from before both, and the stages of that time.
    (folder.stages / "mesh-bad-k").rename(folder.stages / "mesh-stopped-k")
    begin(folder, regions=("auto",), seed=7)
    assert work(folder, 'MeshingError("a")') == 3
    assert read_job(folder.job_path) == job
    assert sorted(p.name for p in folder.stages.glob("mesh-*")) == [
        "mesh-auto-begun", "mesh-first-done",
    ]  # fmt: skip


def test_a_mesh_that_ends_well_is_the_finished_job(folder: JobFolder) -> None:
    meshed = begin(folder, regions=("all",))
    assert work(folder, "") == 0
    assert finished_job(folder) == meshed
    assert not (folder.root / NAME).exists()


def test_a_job_that_is_done_counts_whatever_was_kept(folder: JobFolder) -> None:
    """A worker of an earlier version forgets nothing."""
    meshed = begin(folder, regions=("all",))
    folder.write_status(JobStatus("DONE"))
    assert finished_job(folder) == meshed
    begin(folder, regions=("auto",), seed=9)
    assert work(folder) == 3
    assert read_job(folder.job_path) == meshed


@pytest.mark.parametrize("command", ["wrap", "more"])
def test_a_failed_training_is_a_failed_job(folder: JobFolder, command: str) -> None:
    begin(folder, regions=("all",))
    job = begin(folder, command)
    assert work(folder) == 3
    assert (folder.read_status().state, read_job(folder.job_path)) == ("FAILED", job)


def test_without_a_finished_job_nothing_is_put_back(folder: JobFolder) -> None:
    folder.write_status(JobStatus("FAILED", error="no"))
    job = begin(folder, regions=("all",))
    assert not (folder.root / NAME).exists()
    assert work(folder) == 3
    assert (folder.read_status().state, read_job(folder.job_path)) == ("FAILED", job)


@pytest.mark.parametrize("content", [[], {"job": 1}, {"job": {}, "status": {}, "stages": []}])
def test_a_broken_file_puts_nothing_back(folder: JobFolder, content: object) -> None:
    job = begin(folder, regions=("all",))
    write_json(folder.root / NAME, content)
    assert work(folder) == 3
    assert (folder.read_status().state, read_job(folder.job_path)) == ("FAILED", job)


@pytest.mark.parametrize("stage", [{}, [], 1, None])
def test_a_list_with_other_things_than_names_puts_nothing_back(
    folder: JobFolder, stage: object
) -> None:
    job = begin(folder, regions=("all",))
    saved = read_json(folder.root / NAME)
    write_json(folder.root / NAME, {**saved, "stages": [*saved["stages"], stage]})
    assert work(folder) == 3
    assert (folder.read_status().state, read_job(folder.job_path)) == ("FAILED", job)

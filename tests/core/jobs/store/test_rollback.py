# SPDX-License-Identifier: GPL-3.0-or-later
"""A failed export or mesh leaves the earlier result; later commands see no trace."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.stages import texture
from gaussian_wrapping_addon.core.jobs.stages.texture import export_results
from gaussian_wrapping_addon.core.jobs.store import rollback
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, read_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.jobs.store.rollback import (
    NAME,
    finished_job,
    new_result,
    recover,
    save_rollback,
)
from gaussian_wrapping_addon.core.jobs.store.stage_folder import Stage
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Similarity
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
    meshed = begin(folder, regions=("all",))
    copy = JobFolder(folder.root.parent / "copy")
    shutil.copytree(folder.root, copy.root)
    assert work(copy) == 3
    assert copy.read_status().result == str(copy.result), "a copy names its own place"
    assert work(folder, "") == 0
    assert (folder.read_status().error, folder.read_status().put_back) == ("", False)
    assert finished_job(folder) == meshed
    assert not (folder.root / NAME).exists()


@pytest.mark.proof
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


def test_a_job_that_is_done_counts_whatever_was_kept(folder: JobFolder) -> None:
    """A worker of an earlier version forgets nothing."""
    meshed = begin(folder, regions=("all",))
    folder.write_status(JobStatus("DONE"))
    assert finished_job(folder) == meshed
    begin(folder, regions=("auto",), seed=9)
    assert work(folder) == 3
    assert read_job(folder.job_path) == meshed


@pytest.mark.parametrize("earlier", ["wrap", "more", "none"])
def test_a_failed_training_or_a_mesh_without_a_finished_job_is_a_failed_job(
    folder: JobFolder, earlier: str
) -> None:
    if earlier == "none":
        folder.write_status(JobStatus("FAILED", error="no"))
        job = begin(folder, regions=("all",))
    else:
        begin(folder, regions=("all",))
        job = begin(folder, earlier)
    assert not (folder.root / NAME).exists()
    assert work(folder) == 3
    assert (folder.read_status().state, read_job(folder.job_path)) == ("FAILED", job)


@pytest.mark.parametrize("change", [[], {"job": {}}, {"stages": ["train-before", {}]}])
def test_a_broken_file_puts_nothing_back(folder: JobFolder, change: Any) -> None:
    job = begin(folder, regions=("all",))
    saved = read_json(folder.root / NAME)
    write_json(folder.root / NAME, {**saved, **change} if change else change)
    assert work(folder) == 3
    assert (folder.read_status().state, read_job(folder.job_path)) == ("FAILED", job)


def content(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def fill(folder: Path, text: str, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


@pytest.fixture
def result(tmp_path: Path) -> Path:
    fill(tmp_path / "result", "old", "scene.json", "box/a", "box/b", "report.json", "mine.txt")
    return tmp_path / "result"


def test_entries_are_replaced_whole_and_others_stay(result: Path) -> None:
    with new_result(result) as new:
        fill(new, "new", "scene.json", "box/a", "other/a", "report.json")
        assert content(result)["box/a"] == b"old"
    assert content(result) == {
        "scene.json": b"new", "box/a": b"new", "other/a": b"new", "report.json": b"new",
        "mine.txt": b"old",
    }  # fmt: skip
    assert not list(result.glob(".*"))


def half_written(result: Path) -> None:
    with new_result(result) as new:
        fill(new, "new", "scene.json", "box/a")
        raise OSError(errno.ENOSPC, "full")


@pytest.mark.parametrize("at", [1, 2, 4, 7])
def test_an_error_while_renaming_changes_nothing(
    result: Path, at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, calls, replace = content(result), [], os.replace

    def failing(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) == at:
            raise PermissionError(errno.EACCES, "open elsewhere")
        replace(source, target)

    monkeypatch.setattr(rollback.os, "replace", failing)
    with pytest.raises(PermissionError), new_result(result, last=("report.json",)) as new:
        fill(new, "new", "scene.json", "box/a", "other/a", "report.json")
    assert content(result) == before


@pytest.mark.parametrize("at", range(1, 8))
def test_a_change_that_is_killed_is_undone_later(
    result: Path, at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, calls, replace = content(result), [], os.replace

    def killed(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) >= at:
            raise SystemExit  # and so does what would undo it
        replace(source, target)

    with monkeypatch.context() as patched:
        patched.setattr(rollback.os, "replace", killed)
        patched.setattr(rollback.shutil, "rmtree", lambda *_, **__: None)
        with pytest.raises(SystemExit), new_result(result) as new:
            fill(new, "new", "scene.json", "box/a", "other/a", "report.json")
    recover(result)
    assert {k: v for k, v in content(result).items() if not k.startswith("other/")} == before
    with new_result(result) as new:
        fill(new, "newer", "scene.json")
    assert not list(result.glob(".*"))


def test_an_error_while_writing_changes_nothing(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="full"):
        half_written(tmp_path / "result")
    assert list(tmp_path.iterdir()) == []
    with new_result(tmp_path / "result") as new:
        fill(new, "new", "scene.json")
    before = content(tmp_path)
    assert before == {"result/scene.json": b"new"}
    with pytest.raises(OSError, match="full"):
        half_written(tmp_path / "result")
    assert content(tmp_path) == before


DONE = {"seconds": 1.0, "processor_seconds": 1.0, "finished_unix_s": 5.0, "held_out": []}


@pytest.fixture
def exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Export finished stages whose scene and Gaussians are not looked at."""
    for module, name in (
        ("scene.scene", "load_refined_scene"),
        ("gaussians.files", "load_gaussians"),
    ):
        frame = Similarity(1.0, np.eye(3), np.zeros(3))
        scene = SimpleNamespace(world_from_scene=frame, facts={})
        monkeypatch.setattr(f"gaussian_wrapping_addon.core.{module}.{name}", lambda *_, s=scene: s)
    monkeypatch.setattr(
        "gaussian_wrapping_addon.core.gaussians.files.write_splat_ply",
        lambda path, *_: path.write_bytes(b"gaussians"),
    )
    monkeypatch.setattr(texture, "write_scene_summary", lambda path, _: write_json(path, {}))
    monkeypatch.setattr(texture, "_in_world_units", lambda *_: {})
    folder = JobFolder(tmp_path / "out")
    folder.create()

    def run(name: str, text: str) -> None:
        def stage(kind: str, *names: str) -> Stage:
            fill(tmp_path / text / kind, text, *names)
            return Stage(kind, "train" if kind == "train" else text, tmp_path / text / kind, DONE,
                         False)  # fmt: skip

        meshed = stage(f"mesh-{name}", "region.json")
        textured = stage(f"texture-{name}", "files/mesh.ply", "comparison-0.jpg", "preview.png")
        (tmp_path / "photos").mkdir(exist_ok=True)
        export_results(
            folder, make_job("mesh", tmp_path / "photos", JobSettings()), stage("cameras"),
            stage("train"), [(name, meshed, textured)], {"source": text}, Progress(),
        )  # fmt: skip

    run.result = folder.result  # type: ignore[attr-defined]
    return run


def test_the_report_knows_regions_of_earlier_exports(exported: Any) -> None:
    for name in ("first", "report", "second"):
        exported(name, f"of {name}")
    result = exported.result
    assert list(json.loads((result / "report.json").read_text())["regions"]) == [
        "first", "report", "second",
    ]  # fmt: skip
    text = (result / "report.md").read_text()
    assert "# Report: of second" in text
    for name in ("first", "report", "second"):
        assert f"]({name}/preview.png)" in text
        assert (result / name / "mesh.ply").read_text() == f"of {name}"


@pytest.mark.parametrize("where", ["region.json", "comparison-0.jpg", "preview.png", "report.md"])
def test_a_full_disk_leaves_the_earlier_result(
    exported: Any, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    exported("box", "first")
    before = content(exported.result)
    copy, write = shutil.copy2, texture.write_report

    def full(source: Path, target: Path, **options: Any) -> Any:
        if Path(source).name == where:
            raise OSError(errno.ENOSPC, "No space left on device")
        return copy(source, target, **options)

    def full_report(*arguments: Any, **options: Any) -> None:
        write(*arguments, **options)
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(shutil, "copy2", full)
        if where == "report.md":
            patched.setattr(texture, "write_report", full_report)
        with pytest.raises(OSError, match="No space"):
            exported("box", "second")
    assert content(exported.result) == before
    exported("box", "second")
    assert content(exported.result)["box/mesh.ply"] == b"second"

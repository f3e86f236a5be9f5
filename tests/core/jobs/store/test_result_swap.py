# SPDX-License-Identifier: GPL-3.0-or-later
"""An export that fails at any point leaves the earlier result unchanged, byte for byte."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.stages import texture
from gaussian_wrapping_addon.core.jobs.stages.texture import export_results
from gaussian_wrapping_addon.core.jobs.store import rollback
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.rollback import new_result, recover
from gaussian_wrapping_addon.core.jobs.store.stage_folder import Stage
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.settings import JobSettings


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


def test_an_error_while_writing_changes_nothing(result: Path) -> None:
    before = content(result)
    with pytest.raises(OSError, match="full"):
        half_written(result)
    assert content(result) == before
    assert not list(result.glob(".*"))


@pytest.mark.parametrize("at", range(1, 8))
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


def test_no_result_is_left_where_there_was_none(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="full"):
        half_written(tmp_path / "result")
    assert list(tmp_path.iterdir()) == []
    with new_result(tmp_path / "result") as new:
        fill(new, "new", "scene.json")
    assert content(tmp_path) == {"result/scene.json": b"new"}


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

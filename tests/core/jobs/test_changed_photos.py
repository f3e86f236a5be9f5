# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshing a finished training does not train again, even if the photos have changed."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.stages.cameras import run_cameras
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, training_keys
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.stage_folder import (
    STAGE_VERSIONS,
    Stage,
    source_fingerprint,
    stage_key,
)
from gaussian_wrapping_addon.core.loading import load
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, save_scene
from gaussian_wrapping_addon.core.settings import JobSettings


@pytest.fixture
def job(tmp_path: Path) -> JobFile:
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("a.jpg", "b.jpg"):
        (photos / name).write_bytes(b"picture")
    return make_job("wrap", photos, JobSettings())


@pytest.fixture
def folder(tmp_path: Path, job: JobFile) -> JobFolder:
    """A job folder whose cameras and training are finished."""
    folder = JobFolder(tmp_path / "out")
    folder.create()
    key = stage_key(
        STAGE_VERSIONS["cameras"], job.source, source_fingerprint(Path(job.source)),
        job.settings.seed,
    )  # fmt: skip
    finish(folder, f"cameras-{key}", 1.0)
    scene = Scene((), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), Similarity())
    save_scene(scene, folder.stages / f"cameras-{key}")
    finish(folder, f"train-{training_keys(key, job)[0]}", 2.0)
    return folder


def finish(folder: JobFolder, name: str, finished_unix_s: float) -> None:
    (folder.stages / name).mkdir(parents=True)
    write_json(folder.stages / name / "done.json", {"finished_unix_s": finished_unix_s})


def cameras_of(folder: JobFolder, job: JobFile) -> Stage:
    return run_cameras(folder, job, Progress(), threads=1)


@pytest.fixture(autouse=True)
def no_loading(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> None:
        raise DatasetError("Loaded again.", "")

    monkeypatch.setattr(load, "load_scene", refused)


@pytest.mark.parametrize("change", ["dates", "another photo", "gone"])
def test_a_mesh_is_of_the_training_as_it_is(
    change: str, folder: JobFolder, job: JobFile, caplog: pytest.LogCaptureFixture
) -> None:
    photos = Path(job.source)
    if change == "dates":
        os.utime(photos / "a.jpg", (1, 1))
    elif change == "another photo":
        (photos / "c.jpg").write_bytes(b"picture")
    else:
        for path in photos.iterdir():
            path.unlink()
    with caplog.at_level(logging.WARNING):
        stage = cameras_of(folder, replace(job, command="mesh"))
    assert stage.reused
    assert (folder.stages / f"cameras-{stage.key}").samefile(stage.folder)
    assert "To train anew, run wrap" in caplog.text
    with pytest.raises(DatasetError, match="Loaded again"):
        cameras_of(folder, job)


def test_photos_that_are_the_same_say_nothing(
    folder: JobFolder, job: JobFile, caplog: pytest.LogCaptureFixture
) -> None:
    assert cameras_of(folder, replace(job, command="mesh")).reused
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


def test_the_newest_finished_training_counts(folder: JobFolder, job: JobFile) -> None:
    finish(folder, "cameras-other", 3.0)
    finish(folder, f"train-{training_keys('other', job)[0]}", 4.0)
    os.utime(Path(job.source) / "a.jpg", (1, 1))
    mesh = replace(job, command="mesh")
    assert cameras_of(folder, mesh).key == "other"
    for done in folder.stages.glob("train-*/done.json"):
        done.unlink()
    with pytest.raises(DatasetError, match="Loaded again"):
        cameras_of(folder, mesh)

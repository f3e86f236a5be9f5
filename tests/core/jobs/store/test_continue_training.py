# SPDX-License-Identifier: GPL-3.0-or-later
"""Continuing a training finds the right checkpoints and raises if there are none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import DatasetError, UsageError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, training_keys
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.rollback import (
    checkpoints,
    continue_training_job,
    lineage,
    link_checkpoints,
    shorter_training,
)
from gaussian_wrapping_addon.core.settings import JobSettings, TrainingSettings


def job_of(source: Path, **training: object) -> JobFile:
    return make_job("wrap", source, JobSettings(training=TrainingSettings(**training)))


def stage(stages: Path, name: str, *, base: str = "b", extra: int = 0, iterations: tuple = (9,)):
    folder = stages / f"train-{name}"
    folder.mkdir(parents=True)
    for iteration in iterations:
        (folder / f"checkpoint-{iteration:09d}.json").write_text(f"json {name} {iteration}")
        (folder / f"checkpoint-{iteration:09d}.npz").write_text(f"npz {name} {iteration}")
    write_json(folder / "done.json", {"lineage": lineage(base, extra)})
    return folder


def test_more_adds_up_and_keeps_all_else(tmp_path: Path) -> None:
    folder = JobFolder(tmp_path)
    stage(folder.stages, "a")
    job = job_of(tmp_path, iterations=70, extra_iterations=5)
    longer = continue_training_job(folder, job, 30)
    assert longer.command == "more"
    assert longer.settings.training.extra_iterations == 35
    training = replace(longer.settings.training, extra_iterations=5)
    assert replace(longer, command="wrap", settings=replace(job.settings, training=training)) == job
    assert JobFile.from_json(longer.to_json()) == longer


def test_more_without_a_finished_training_or_checkpoint_is_refused(tmp_path: Path) -> None:
    folder, job = JobFolder(tmp_path), job_of(tmp_path)
    with pytest.raises(DatasetError, match="no finished training"):
        continue_training_job(folder, job, 5)
    stage(folder.stages, "a", iterations=())
    with pytest.raises(DatasetError, match="no checkpoint") as caught:
        continue_training_job(folder, job, 5)
    assert "--iterations" in caught.value.hint
    with pytest.raises(UsageError, match="adds nothing"):
        continue_training_job(folder, job, 0)


def test_the_longest_shorter_training_of_the_same_base_is_found(tmp_path: Path) -> None:
    stage(tmp_path, "other", base="c", extra=8)
    stage(tmp_path, "longer", extra=20)
    stage(tmp_path, "bare", extra=9, iterations=())
    first = stage(tmp_path, "first", extra=0)
    assert shorter_training(tmp_path, "b", 10) == first
    second = stage(tmp_path, "second", extra=5)
    assert shorter_training(tmp_path, "b", 10) == second
    unfinished = stage(tmp_path, "unfinished", extra=7)
    (unfinished / "done.json").unlink()
    assert shorter_training(tmp_path, "b", 10) == second
    assert shorter_training(tmp_path, "d", 10) is None
    assert shorter_training(tmp_path, "b", 0) is None


def test_brought_checkpoints_are_equal_and_leave_the_origin_alone(tmp_path: Path) -> None:
    source = stage(tmp_path, "a", iterations=(90, 100))
    (source / "smaller.json").write_text("{}")
    before = {p.name: p.read_bytes() for p in source.iterdir()}
    target = tmp_path / "train-b"
    target.mkdir()
    link_checkpoints(source, target, ("smaller.json", "missing.json"))
    assert [p.name for p in checkpoints(target)] == [p.name for p in checkpoints(source)]
    assert {p.name: p.read_bytes() for p in target.iterdir()} == {
        name: data for name, data in before.items() if name != "done.json"
    }
    for path in target.iterdir():
        path.unlink()
    assert {p.name: p.read_bytes() for p in source.iterdir()} == before


def test_keys_tell_extra_iterations_from_everything_else(tmp_path: Path) -> None:
    splat = tmp_path / "start.ply"
    splat.write_bytes(b"ply")
    plain = job_of(tmp_path)
    started = replace(plain, settings=replace(plain.settings, start_splat=str(splat)))
    jobs = {
        "plain": plain,
        "more": job_of(tmp_path, extra_iterations=7),
        "other": job_of(tmp_path, iterations=77),
        "started": started,
    }
    keys = {name: training_keys(1, "cameras", job) for name, job in jobs.items()}
    assert len({key for key, _ in keys.values()}) == 4
    assert keys["plain"][1] == keys["more"][1]
    assert len({base for _, base in keys.values()}) == 3
    again = job_of(tmp_path, preview_every_s=1.0)
    assert training_keys(1, "cameras", again) == keys["plain"]
    splat.write_bytes(b"ply, changed")
    assert training_keys(1, "cameras", started)[0] != keys["started"][0]
    splat.unlink()
    with pytest.raises(DatasetError, match=r"start\.ply"):
        training_keys(1, "cameras", started)

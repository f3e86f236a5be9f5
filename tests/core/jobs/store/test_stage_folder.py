# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages used again or redone, checkpoints continued, a blend file renamed."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import Cancelled, DatasetError, UsageError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, training_keys
from gaussian_wrapping_addon.core.jobs.store.job_folder import (
    JobFolder,
    back_up_stale_blend,
    result_state,
)
from gaussian_wrapping_addon.core.jobs.store.rollback import (
    checkpoints,
    continue_training_job,
    lineage,
    link_checkpoints,
    shorter_training,
)
from gaussian_wrapping_addon.core.jobs.store.stage_folder import (
    record_interrupted_time,
    run_stage,
    source_fingerprint,
    stage_key,
)
from gaussian_wrapping_addon.core.names import JOB_MARKER
from gaussian_wrapping_addon.core.photos.finder import list_photos
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import JobSettings, TrainingSettings


def test_an_interrupted_stage_is_run_again_in_the_same_folder_a_finished_one_never(
    tmp_path: Path,
) -> None:
    def interrupted(folder: Path, progress: Progress) -> dict:
        (folder / "checkpoint").write_text("half")
        raise Cancelled

    def work(folder: Path, progress: Progress) -> dict:
        assert (folder / "checkpoint").read_text() == "half"
        return {"figure": 3}

    with pytest.raises(Cancelled):
        run_stage(tmp_path, "train", "abc", Progress(), interrupted)
    record_interrupted_time(tmp_path / "train-abc", 100.0)
    stage = run_stage(tmp_path, "train", "abc", Progress(), work)
    assert not stage.reused
    assert stage.done["seconds"] >= 100.0
    again = run_stage(tmp_path, "train", "abc", Progress(), interrupted)
    assert (again.reused, again.done["figure"]) == (True, 3)
    with pytest.raises(Cancelled):
        run_stage(tmp_path, "train", "abd", Progress(), interrupted)


def test_fingerprint_follows_size_time_and_names_of_inputs(tmp_path: Path) -> None:
    photo = tmp_path / "a.jpg"
    photo.write_bytes(b"12")
    before = source_fingerprint(tmp_path)
    os.utime(photo, ns=(1, 1))
    after = source_fingerprint(tmp_path)
    assert after != before
    for name in ("notes.md", "a.nef", "a.xmp", "list.csv", "a_wrap/stages/frame.jpg"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("no input, or the same photo again")
    (tmp_path / "a_wrap" / JOB_MARKER).touch()
    assert source_fingerprint(tmp_path) == after
    assert [path.name for path in list_photos(tmp_path / "a_wrap" / "stages")] == ["frame.jpg"]
    (tmp_path / "b.nef").write_bytes(b"4444")
    assert [name for name, _, _ in source_fingerprint(tmp_path)] == ["", "a.jpg", "b.nef"]
    assert stage_key("a", "b") != stage_key("ab")


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
    keys = {name: training_keys("cameras", job) for name, job in jobs.items()}
    assert len({key for key, _ in keys.values()}) == 4
    assert keys["plain"][1] == keys["more"][1]
    assert len({base for _, base in keys.values()}) == 3
    again = job_of(tmp_path, preview_every_s=1.0)
    assert training_keys("cameras", again) == keys["plain"]
    splat.write_bytes(b"ply, changed")
    assert training_keys("cameras", started)[0] != keys["started"][0]
    splat.unlink()
    with pytest.raises(DatasetError, match=r"start\.ply"):
        training_keys("cameras", started)


@pytest.mark.parametrize("region", ["ball", "cap"])
def test_a_changed_and_a_new_region_set_the_blend_file_aside(
    tmp_path: Path, region: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert result_state(tmp_path / "missing") == {}
    assert not back_up_stale_blend(tmp_path / "missing", {})
    (tmp_path / "ball").mkdir()
    (tmp_path / "ball" / "figures.json").write_text('{"seconds": 1}')
    (tmp_path / "scene.blend").write_bytes(b"first")
    before = result_state(tmp_path)
    (tmp_path / "ball" / "figures.json").write_text('{"seconds": 1}')
    assert not back_up_stale_blend(tmp_path, before), "nothing has changed"
    (tmp_path / region).mkdir(exist_ok=True)
    (tmp_path / region / "figures.json").write_text('{"seconds": 2}')
    with caplog.at_level("INFO", "gaussian_wrapping"):
        assert back_up_stale_blend(tmp_path, before)
    assert not (tmp_path / "scene.blend").exists()
    assert (tmp_path / "scene.blend1").read_bytes() == b"first"
    assert "scene.blend1" in caplog.text
    assert not back_up_stale_blend(tmp_path, before), "there is none to set aside"
    (tmp_path / "scene.blend").write_bytes(b"second")
    assert back_up_stale_blend(tmp_path, before)
    assert (tmp_path / "scene.blend1").read_bytes() == b"second"

# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages are re-used when their inputs are the same, and redone when they are not."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.jobs.store.stage_folder import (
    record_interrupted_time,
    run_stage,
    source_fingerprint,
    stage_key,
)
from gaussian_wrapping_addon.core.names import JOB_MARKER
from gaussian_wrapping_addon.core.photos.finder import list_photos
from gaussian_wrapping_addon.core.progress import Progress


def test_a_finished_stage_is_not_run_again(tmp_path: Path) -> None:
    runs = []

    def work(folder: Path, progress: Progress) -> dict:
        runs.append(folder)
        return {"figure": 3}

    first = run_stage(tmp_path, "train", "abc", Progress(), work)
    second = run_stage(tmp_path, "train", "abc", Progress(), work)
    other = run_stage(tmp_path, "train", "abd", Progress(), work)
    assert len(runs) == 2
    assert (first.reused, second.reused, other.reused) == (False, True, False)
    assert second.done["figure"] == 3


def test_an_interrupted_stage_is_run_again_in_the_same_folder(tmp_path: Path) -> None:
    def interrupted(folder: Path, progress: Progress) -> dict:
        (folder / "checkpoint").write_text("half")
        raise Cancelled

    def work(folder: Path, progress: Progress) -> dict:
        assert (folder / "checkpoint").read_text() == "half"
        return {}

    with pytest.raises(Cancelled):
        run_stage(tmp_path, "train", "abc", Progress(), interrupted)
    record_interrupted_time(tmp_path, "train", "abc", 100.0)
    stage = run_stage(tmp_path, "train", "abc", Progress(), work)
    assert not stage.reused
    assert stage.done["seconds"] >= 100.0


def test_fingerprint_follows_size_time_and_names(tmp_path: Path) -> None:
    photo = tmp_path / "a.jpg"
    photo.write_bytes(b"12")
    before = source_fingerprint(tmp_path)
    assert source_fingerprint(tmp_path) == before
    os.utime(photo, ns=(1, 1))
    assert source_fingerprint(tmp_path) != before
    (tmp_path / "notes.md").write_text("not an input")
    after = source_fingerprint(tmp_path)
    (tmp_path / "b.jpg").write_bytes(b"1")
    assert source_fingerprint(tmp_path) != after


def test_fingerprint_leaves_out_jobs_notes_and_second_copies(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"1")
    before = source_fingerprint(tmp_path)
    (tmp_path / "a.nef").write_bytes(b"22")
    (tmp_path / "a.xmp").write_text("<x:xmpmeta xmlns:x='adobe:ns:meta/'/>")
    (tmp_path / "list.csv").write_text("name,stars\na.jpg,5\n")
    job = tmp_path / "a_wrap"
    job.mkdir()
    (job / JOB_MARKER).touch()
    (job / "frame.jpg").write_bytes(b"333")
    assert source_fingerprint(tmp_path) == before
    (tmp_path / "b.nef").write_bytes(b"4444")
    assert [name for name, _, _ in source_fingerprint(tmp_path)] == ["", "a.jpg", "b.nef"]


def test_photos_of_a_job_are_no_input(tmp_path: Path) -> None:
    job = tmp_path / "clip_wrap" / "stages" / "frames"
    job.mkdir(parents=True)
    (tmp_path / "clip_wrap" / JOB_MARKER).touch()
    (job / "frame.jpg").write_bytes(b"1")
    assert list_photos(tmp_path) == []
    assert [path.name for path in list_photos(job)] == ["frame.jpg"]


def test_key_depends_on_every_part() -> None:
    assert stage_key("a", {"x": 1}) == stage_key("a", {"x": 1})
    assert stage_key("a", {"x": 1}) != stage_key("a", {"x": 2})
    assert stage_key("a", "b") != stage_key("ab")

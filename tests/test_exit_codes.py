# SPDX-License-Identifier: GPL-3.0-or-later
"""Exit codes of ``docs/command-line.md``: one code for one kind of failure."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import (
    EXIT_BAD_DATA,
    EXIT_RESOURCES,
    EXIT_USAGE,
    ResourceError,
    UsageError,
)
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.loading import check
from gaussian_wrapping_addon.core.names import JOB_MARKER
from gaussian_wrapping_addon.core.settings import JobSettings

LONG = "x" * 300
"""Longer than a name may be on any system."""
TRIANGLE = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Photos, a file, an empty folder, a job that has trained nothing, and one that has."""
    monkeypatch.chdir(tmp_path)
    for name in ("photos", "empty"):
        (tmp_path / name).mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "mesh.off").write_text(TRIANGLE)
    for name in ("begun", "trained"):
        job = tmp_path / name
        (job / "stages").mkdir(parents=True)
        (job / JOB_MARKER).touch()
        write_job(job / "job.json", JobFile("wrap", str(tmp_path / "photos"), JobSettings()))
    stage = tmp_path / "trained" / "stages" / "train-a"
    stage.mkdir()
    write_json(stage / "done.json", {"finished_unix_s": 1.0})
    write_json(stage / "checkpoint-000000010.json", {})
    return tmp_path


def code_of(words: str) -> int:
    return batch.main(words.split())


@pytest.mark.parametrize(
    "words",
    [
        "mesh --out empty --no-blend",
        "more --out empty --iterations 5 --no-blend",
        "resume empty --no-blend",
        "export empty --out new",
        "evaluate empty --truth mesh.off",
        "estimate-mesh --out empty",
        "status empty",
        "cancel empty",
        "set-up-worker --dry-run --to trained",
        "set-up-worker --dry-run --to file",
        "set-up-worker --to new --find-links file",
    ],
)
def test_a_folder_that_is_no_job(place: Path, words: str) -> None:
    assert code_of(words) == EXIT_USAGE
    assert list((place / "empty").iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="Windows says that such a path does not exist")
@pytest.mark.parametrize(
    "words",
    [
        f"status {LONG}",
        f"cancel {LONG}",
        f"resume {LONG}",
        f"export {LONG} --out new",
        f"estimate-mesh --out {LONG}",
        f"estimate {LONG}",
        f"wrap photos --out new --no-blend --region {LONG}.json",
        f"wrap photos --out new --no-blend --set start_splat={LONG}.ply",
        f"wrap {LONG} --out new --no-blend",
    ],
)
def test_a_path_that_no_system_stores(
    place: Path, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of(words) == EXIT_USAGE
    (said,) = capsys.readouterr().out.splitlines()
    assert "xxx" in said
    assert len(said) < 400 or "does not exist" in said
    assert not (place / "new").exists()


def test_a_job_folder_that_no_system_stores(place: Path) -> None:
    with pytest.raises((UsageError, ResourceError), match=r"xxx\.\.\. is longer|cannot be written"):
        JobFolder(place / LONG).create()


@pytest.mark.parametrize(
    "words",
    [
        "mesh --out begun --no-blend",
        "more --out begun --iterations 5 --no-blend",
        "export begun --out new",
        "evaluate begun --truth mesh.off",
        "estimate-mesh --out begun",
    ],
)
def test_a_job_without_what_the_command_needs(place: Path, words: str) -> None:
    """No training, no result, no mesh: resuming the job is the next step, not another command."""
    assert code_of(words) == EXIT_BAD_DATA
    assert not (place / "new").exists()


def test_a_result_without_a_mesh(place: Path) -> None:
    result = place / "begun" / "result"
    result.mkdir()
    identity = {"scale": 1.0, "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
                "translation": [0, 0, 0]}  # fmt: skip
    write_json(result / "scene.json", {"world_from_scene": identity, "cameras": []})
    assert code_of("export begun --out new") == EXIT_BAD_DATA
    assert code_of("evaluate begun --truth mesh.off") == EXIT_BAD_DATA


@pytest.mark.parametrize(
    "words",
    [
        "wrap missing --out new --no-blend",
        "wrap photos --out new --no-blend",
        "estimate missing",
        "estimate photos",
        "check photos",
        "evaluate missing.off --truth mesh.off",
        "evaluate mesh.off --truth missing.off",
        "mesh --out trained --region missing.json --no-blend",
        "estimate-mesh --out trained --region missing.json",
    ],
)
def test_input_that_cannot_be_used(place: Path, words: str) -> None:
    assert code_of(words) == EXIT_BAD_DATA
    assert not (place / "new").exists()


@pytest.mark.parametrize(
    "words",
    [
        "wrap photos --out file --no-blend",
        "export trained --out file",
        "evaluate mesh.off --truth mesh.off --out empty",
        "estimate photos --iterations -1",
        "mesh --out trained --edge-length nan --no-blend",
        "more --out trained --iterations 0 --no-blend",
        "resume trained --max-gaussians 0 --no-blend",
    ],
)
def test_a_command_line_that_is_wrong(
    place: Path, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(check, "check_input", lambda *_, **_keywords: [])
    (place / "trained" / "result").mkdir()
    identity = {"scale": 1.0, "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
                "translation": [0, 0, 0]}  # fmt: skip
    write_json(place / "trained" / "result" / "scene.json", {"world_from_scene": identity})
    assert code_of(words) == EXIT_USAGE
    assert (place / "file").read_text() == ""


@pytest.mark.parametrize(
    "words",
    [
        "wrap photos --out file/new --no-blend",
        "mesh --out trained --no-blend",
        "more --out trained --iterations 5 --no-blend",
        "resume trained --no-blend",
        "export trained --out file/new",
        "evaluate mesh.off --truth mesh.off --out missing/figures.json",
    ],
)
def test_a_place_that_cannot_be_written(
    place: Path, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Root may write anywhere: here a folder stands where the file is to be, or a file is above."""
    monkeypatch.setattr(check, "check_input", lambda *_, **_keywords: [])
    (place / "trained" / "status.json").mkdir()
    (place / "trained" / "result").mkdir()
    identity = {"scale": 1.0, "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
                "translation": [0, 0, 0]}  # fmt: skip
    write_json(place / "trained" / "result" / "scene.json", {"world_from_scene": identity})
    started: list[object] = []
    monkeypatch.setattr(JobClient, "poll", lambda self: started.append(self))
    assert code_of(words) == EXIT_RESOURCES
    assert started == []


def test_a_disk_without_room_has_the_same_code_everywhere(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object, **__: object) -> Callable[[], None]:
        raise OSError(28, "No space left on device", str(place / "trained" / "job.json"))

    monkeypatch.setattr(check, "check_input", full)
    assert code_of("wrap photos --out new --no-blend") == EXIT_RESOURCES
    said = capsys.readouterr().out
    assert "job.json" in said
    assert "No room" in said

# SPDX-License-Identifier: GPL-3.0-or-later
"""A finished job folder that version 0.1.0 made still opens, is meshed again and trained on.

``tests/data/job-0.1.0/README.md`` says what it is and how it was made.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder

ROOT = Path(__file__).resolve().parents[3]
STORED = ROOT / "tests" / "data" / "job-0.1.0"
MODIFIED_UNIX_S = 1_700_000_000
"""Modification time of the photos' files when the job was made: stage hashes depend on it."""
ITERATIONS = 60


@pytest.fixture
def job(tmp_path: Path) -> JobFolder:
    """Return a copy; commands that train run in the folder above it, where ``photos`` lies."""
    shutil.copytree(STORED, tmp_path / "copy")
    for path in (tmp_path / "copy" / "photos").rglob("*"):
        os.utime(path, (MODIFIED_UNIX_S, MODIFIED_UNIX_S))
    return JobFolder(tmp_path / "copy" / "job")


def batch(job: JobFolder, *arguments: str, timeout_s: float = 240.0) -> str:
    done = subprocess.run(
        [sys.executable, str(ROOT / "gaussian_wrapping_addon" / "batch.py"), *arguments],
        cwd=job.root.parent, capture_output=True, text=True, check=False,
        timeout=timeout_s,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def stages(job: JobFolder) -> set[str]:
    return {path.name for path in job.stages.iterdir()}


def contents(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


def report(job: JobFolder) -> dict[str, Any]:
    return json.loads((job.result / "report.json").read_text(encoding="utf-8"))


def reused(job: JobFolder) -> dict[str, bool]:
    return {stage["name"]: stage["reused"] for stage in report(job)["stages"]}


def test_it_is_read_and_its_files_are_exported(job: JobFolder, tmp_path: Path) -> None:
    assert (job.is_job(), job.read_status().state) == (True, "DONE")
    described = read_job(job.job_path)
    assert (described.command, described.source) == ("wrap", "photos")
    assert described.settings.meshing.points == 110
    batch(job, "export", "job", "--out", str(tmp_path / "files"), "--format", "glb,splat")
    with np.load(job.result / "ball" / "mesh.npz", allow_pickle=False) as arrays:
        faces = len(arrays["faces"])
    assert faces == report(job)["regions"]["ball"]["statistics"]["faces"]
    assert len(list((tmp_path / "files").glob("*.glb"))) == 1
    assert len(list((tmp_path / "files").glob("*.ply"))) == 1


@pytest.mark.slow
def test_resume_makes_anew_what_is_computed_otherwise_since(job: JobFolder) -> None:
    before = contents(job.stages)
    batch(job, "resume", "job", "--no-blend", timeout_s=540.0)
    assert set(reused(job).values()) == {False}
    assert contents(job.stages).items() >= before.items()
    after = report(job)
    assert after["training"]["iterations"] == ITERATIONS
    assert after["regions"]["ball"]["check"]["good"] is True
    # Its setting of the cameras is the default: those that were trained on.
    assert after["regions"]["ball"]["provenance"]["cameras"] == "training"


@pytest.mark.slow
def test_another_region_is_meshed_from_its_training(job: JobFolder) -> None:
    before = stages(job)
    trained = contents(next(job.stages.glob("train-*")))
    region = json.loads((job.root.parent / "ball.json").read_text())
    corners = np.array(region["vertices"])
    middle = corners.mean(0)
    region |= {
        "blender_object_name": "half",
        "vertices": (middle + (corners - middle) * [0.5, 1.0, 1.0]).tolist(),
    }
    path = job.root.parent / "half.json"
    path.write_text(json.dumps(region))
    batch(
        job, "mesh", "--out", "job", "--region", str(path), "--points", "110",
        "--texture-size", "64", "--threads", "2", "--no-blend",
    )  # fmt: skip
    assert {name.rpartition("-")[0] for name in stages(job) - before} == {
        "mesh-half", "texture-half",
    }  # fmt: skip
    assert contents(next(job.stages.glob("train-*"))) == trained
    assert reused(job) == {
        "cameras": True, "train": True, "mesh-half": False, "texture-half": False,
    }  # fmt: skip
    assert set(report(job)["regions"]) == {"ball", "half"}
    assert report(job)["regions"]["half"]["check"]["good"] is True


@pytest.mark.proof
def test_more_goes_on_from_its_checkpoint(job: JobFolder) -> None:
    before, earlier = stages(job), report(job)["training"]
    batch(job, "more", "--out", "job", "--iterations", "20", "--no-blend")
    assert {name.rpartition("-")[0] for name in stages(job) - before} == {
        "train", "mesh-ball", "texture-ball",
    }  # fmt: skip
    assert before < stages(job)
    after = report(job)["training"]
    assert after["iterations"] == ITERATIONS + 20
    assert after["lineage"]["base"] == earlier["lineage"]["base"]
    # Trained anew, it would have noted nothing at the end of the shorter training.
    assert after["history"][: len(earlier["history"])] == earlier["history"]
    assert [entry["iteration"] for entry in after["history"]] == [ITERATIONS, ITERATIONS + 20]
    # What version 0.1.0 stored is kept; it did not store whether the photos were measured.
    assert [
        {key: value for key, value in decision.items() if key != "measured"}
        for decision in after["decisions"]
    ] == earlier["decisions"]

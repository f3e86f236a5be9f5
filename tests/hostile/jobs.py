# SPDX-License-Identifier: GPL-3.0-or-later
"""Job folders for cases: begun, trained, with a result; and what may be put into them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.names import JOB_MARKER
from gaussian_wrapping_addon.core.settings import JobSettings
from gaussian_wrapping_addon.core.worker.spawn import process_start_ticks
from tests.core.jobs.commands.test_export_files import write_result
from tests.core.jobs.finished_sphere import write_finished_sphere
from tests.hostile.case import Build

JOB = "out"
_IDENTITY = {
    "scale": 1.0, "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [0, 0, 0],
}  # fmt: skip


def begun(folder: Path) -> None:
    """Make a job that was cancelled before it had done anything; its photos are no photos."""
    (folder / "photos").mkdir()
    job = JobFolder(folder / JOB)
    job.create()
    write_job(job.job_path, make_job("wrap", folder / "photos", JobSettings()))
    job.write_status(JobStatus("CANCELLED", "train", 0.3))


def trained(folder: Path) -> None:
    """Make a job whose training seems finished, but holds no arrays, and whose result is empty."""
    begun(folder)
    stage = folder / JOB / "stages" / "train-a"
    stage.mkdir()
    write_json(stage / "done.json", {"finished_unix_s": 1.0})
    write_json(stage / "checkpoint-000000010.json", {})
    (folder / JOB / "result").mkdir()
    write_json(folder / JOB / "result" / "scene.json", {"world_from_scene": _IDENTITY})


def with_result(folder: Path) -> None:
    """Make a job with the textured mesh of a cube as its result."""
    write_result(folder / JOB)
    (folder / JOB / JOB_MARKER).touch()


def sphere(folder: Path) -> None:
    """Make a job whose training is finished: Gaussians on a sphere, and its photos."""
    write_finished_sphere(folder)


def status(**values: Any) -> Build:
    """Return what writes ``status.json`` of a job with entries of any kind."""
    return lambda folder: (folder / JOB / "status.json").write_text(json.dumps(values)) and None


def job_entry(place: str, value: Any) -> Build:
    """Return what changes one entry of ``job.json``, named with dots."""

    def build(folder: Path) -> None:
        path = folder / JOB / "job.json"
        values = json.loads(path.read_text())
        *parents, last = place.split(".")
        entry = values
        for name in parents:
            entry = entry[name]
        entry[last] = value
        path.write_text(json.dumps(values))

    return build


def locked_by(pid: Callable[[], int]) -> Build:
    """Return what locks a job for a process; its start time is that of the process."""

    def build(folder: Path) -> None:
        owner = {"pid": pid(), "started": process_start_ticks(pid())}
        write_json(folder / JOB / "lock.json", owner)

    return build


this_process = os.getpid

# SPDX-License-Identifier: GPL-3.0-or-later
"""What a job folder held before it was meshed again: a mesh that fails leaves it as it was.

A file beside ``job.json`` keeps the finished job while ``mesh`` works. It goes when that is done;
where ``mesh`` fails, job and status are those of the finished job again, and what it has begun is
removed. One that was stopped can be resumed, as any job.
"""

from __future__ import annotations

import logging
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from ...errors import ParseError, UsageError
from ...files import read_json, write_json
from .job_file import JobFile, read_job, write_job
from .job_folder import JobFolder, JobStatus
from .result_swap import recover
from .stage_folder import read_done

_logger = logging.getLogger(__name__)

NAME = "job-finished.json"


def save_rollback(folder: JobFolder, job: JobFile) -> None:
    """Keep what a folder holds before ``job`` is written there.

    Of several meshes without an end in between, the job before the first is kept: where the last
    one fails, what the others have begun goes as well. Commands that train change the result
    itself: nothing is kept.
    """
    path = folder.root / NAME
    if job.command != "mesh":
        path.unlink(missing_ok=True)
        return
    status = folder.read_status()
    if status.state != "DONE":
        return  # what is kept already, its list of stages too, is of the time before all of them
    try:
        finished = read_job(folder.job_path)
    except (UsageError, ParseError):
        path.unlink(missing_ok=True)
        return  # nothing that could be put back
    saved = {"job": finished.to_json(), "status": asdict(_without_error(status))}
    write_json(path, {**saved, "stages": sorted(p.name for p in folder.stages.iterdir())})


def finished_job(folder: JobFolder) -> JobFile:
    """Return the job that a folder's result is of: not a mesh that has not come to its end.

    Raises
    ------
    UsageError, ParseError
        There is no job.
    """
    saved = _read(folder.root / NAME)
    if saved is None or folder.read_status().state == "DONE":
        return read_job(folder.job_path)
    return JobFile.from_json(saved["job"])


def discard_rollback(folder: JobFolder) -> None:
    """Take the job at hand for the finished one."""
    (folder.root / NAME).unlink(missing_ok=True)


def roll_back(folder: JobFolder) -> JobStatus | None:
    """Make a folder what it was before a mesh that has failed; return its status then.

    ``None`` where there was no finished job, or another command has failed.
    """
    saved = _read(folder.root / NAME)
    if saved is None:
        return None
    try:
        job = JobFile.from_json(saved["job"])
        status = JobStatus.from_json(saved["status"])
    except (UsageError, TypeError, ValueError):
        return None
    known = set(saved["stages"])
    for stage in (*folder.stages.glob("mesh-*"), *folder.stages.glob("texture-*")):
        if stage.name not in known and read_done(stage) is None:
            shutil.rmtree(stage, ignore_errors=True)
    if folder.result.is_dir():
        recover(folder.result)
    write_job(folder.job_path, job)
    discard_rollback(folder)
    _logger.info("the job is again as it was before this mesh")
    # The folder may be a copy, whose status names the place of the other one.
    return replace(status, result=str(folder.result) if status.result else "")


def _without_error(status: JobStatus) -> JobStatus:
    return replace(status, error="", hint="", exit_code=0, put_back=False)


def _read(path: Path) -> dict[str, Any] | None:
    try:
        values = read_json(path)
    except (OSError, ParseError):
        return None
    wanted = {"job": dict, "status": dict, "stages": list}
    if not isinstance(values, dict) or set(values) != set(wanted):
        return None
    return values if all(isinstance(values[k], kind) for k, kind in wanted.items()) else None

# SPDX-License-Identifier: GPL-3.0-or-later
"""Roll a job folder back to its finished job when meshing it again, or a bake, fails.

A file beside ``job.json`` keeps the finished job while ``mesh`` or ``bake`` runs, and is removed
when that is done. If it fails, job and status of the finished job are restored and the stages it
began are removed. A cancelled one can be resumed, as any job.
"""

from __future__ import annotations

import logging
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from ...errors import ParseError, UsageError
from ...files import read_json, write_json
from ...regular_files import is_real_folder
from .job_file import JobFile, read_job, write_job
from .job_folder import JobFolder, JobStatus
from .result_swap import recover
from .stage_folder import read_done

_logger = logging.getLogger(__name__)

NAME = "job-finished.json"


def save_rollback(folder: JobFolder, job: JobFile) -> None:
    """Save the state of a folder before ``job`` is written there.

    Of several meshes in a row that did not finish, the state before the first is kept: if the last
    one fails, the stages begun by the others are removed as well. Commands that train change the
    result itself: nothing is saved.
    """
    path = folder.root / NAME
    if job.command not in ("mesh", "bake"):
        path.unlink(missing_ok=True)
        return
    status = folder.read_status()
    if status.state != "DONE":
        return  # an earlier rollback file, with its list of stages, stays valid
    try:
        finished = read_job(folder.job_path)
    except (UsageError, ParseError):
        path.unlink(missing_ok=True)
        return  # nothing to restore
    saved = {"job": finished.to_json(), "status": asdict(_without_error(status))}
    write_json(path, {**saved, "stages": sorted(p.name for p in folder.stages.iterdir())})


def finished_job(folder: JobFolder) -> JobFile:
    """Return the job that produced a folder's result, not one whose mesh is unfinished.

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
    """Delete the saved state: the current job is the finished one."""
    (folder.root / NAME).unlink(missing_ok=True)


def roll_back(folder: JobFolder) -> JobStatus | None:
    """Restore a folder to its state before a failed mesh; return its status at that time.

    Returns ``None`` if there was no finished job, or if another command failed.
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
    begun = [
        stage for kind in ("mesh", "texture", "bake") for stage in folder.stages.glob(f"{kind}-*")
    ]
    for stage in begun if is_real_folder(folder.stages) else ():
        if is_real_folder(stage) and stage.name not in known and read_done(stage) is None:
            shutil.rmtree(stage, ignore_errors=True)
    for files in (folder.result, folder.baked):
        if is_real_folder(files):
            recover(files)
    write_job(folder.job_path, job)
    discard_rollback(folder)
    _logger.info("the job was restored to its state before this mesh")
    # The folder may be a copy whose status names the original's path.
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
    if not all(isinstance(values[name], kind) for name, kind in wanted.items()):
        return None
    return values if all(isinstance(stage, str) for stage in values["stages"]) else None

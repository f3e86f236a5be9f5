# SPDX-License-Identifier: GPL-3.0-or-later
"""Submit a job folder to a Manager: its parts become the tasks of one Flamenco job."""

from __future__ import annotations

import contextlib
import getpass
import json
import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from ...errors import FarmError, ResourceError, UsageError, unwritable_error
from ...files import real_path
from ...jobs.parts.graph import Part, PartsGraph, read_parts
from ...jobs.store.job_file import JobFile, read_job
from ...jobs.store.job_folder import JobFolder
from ...names import SHARED_VARIABLE
from .exchange import NotFoundError
from .job_record import JobRecord, read_record, write_record
from .manager import JOB_TYPE, SCRIPT_VERSION, UNFINISHED, Manager, platform

SHARED, PYTHON, PROGRAM = "gw_shared", "gw_python", "gw_batch"
"""Variables of the Manager: the shared folder, the worker's Python, ``batch.py`` of the add-on."""

MAX_PRIORITY = 100
MAX_TAG_CHARACTERS = 200


@dataclass(frozen=True)
class Choices:
    """How a job is submitted."""

    priority: int = 50
    """0 to 100; jobs with higher numbers are first."""
    tag: str = ""
    """Name of a tag: only workers that have it run the job."""
    shared: str = ""
    """The shared folder on this computer; empty: of the environment, or as the Manager says."""
    root: str = ""
    """The shared folder as all workers name it; empty: by the Manager's variable."""

    def validated(self) -> Choices:
        """Return self.

        Raises
        ------
        UsageError
            A value is out of range.
        """
        if not 0 <= self.priority <= MAX_PRIORITY:
            raise UsageError(
                f"The priority {self.priority} is out of range.", f"Give from 0 to {MAX_PRIORITY}."
            )
        if len(self.tag) > MAX_TAG_CHARACTERS or not (self.tag.isprintable()):
            raise UsageError("The tag is no name of one.", "Give a name from Flamenco's page Tags.")
        return self


@dataclass(frozen=True)
class Submission:
    """What was submitted."""

    record: JobRecord
    parts: int
    notes: tuple[str, ...]
    """What the user should look at, in sentences."""


@dataclass(frozen=True)
class Farm:
    """What a Manager said about itself, once for all jobs submitted to it."""

    manager: Manager
    version: str
    etag: str
    tag: str
    """Id of the tag; empty for none."""
    shared: Path
    """The shared folder on this computer."""
    root: str
    """The same as workers name it."""
    notes: tuple[str, ...]


def ask_farm(manager: Manager, choices: Choices) -> Farm:
    """Ask a Manager for all that a submission depends on; changes nothing there.

    Raises
    ------
    FarmError
        It does not answer as a Manager of a fitting version with our job type.
    UsageError
        The choices do not fit: no such tag, no shared folder.
    """
    choices.validated()
    version, etag = manager.version(), manager.job_type_etag()
    tag = manager.tag_id(choices.tag) if choices.tag else ""
    users, workers = manager.variables("users"), manager.variables("workers")
    shared = choices.shared or os.environ.get(SHARED_VARIABLE, "") or users.get(SHARED, "")
    if not shared:
        raise UsageError(
            f"Nothing says which folder of this computer the farm shares: the Manager at "
            f"{manager.address} has no variable {SHARED} for {platform()}.",
            f"Add {SHARED} to flamenco-manager.yaml (docs/farm.md), or give --shared.",
        )
    if not choices.root and SHARED not in {**users, **workers}:
        raise UsageError(
            f"The Manager at {manager.address} has no variable {SHARED} for {platform()}, so "
            "workers would not find the job folder.",
            f"Add {SHARED} to flamenco-manager.yaml (docs/farm.md), or give --root.",
        )
    if shared == users.get(SHARED) and shared.replace("\\", "/").startswith("//"):
        # Windows would send the user's name to whatever server stands there.
        raise UsageError(
            f"The Manager at {manager.address} names the shared folder by its server: {shared}.",
            f"Give {SHARED} a drive letter in flamenco-manager.yaml.",
        )
    if not Path(shared).is_dir():
        raise UsageError(
            f"The shared folder {shared} does not exist on this computer.",
            f"Mount it, or name it: --shared, or {SHARED_VARIABLE}.",
        )
    missing = [name for name in (PYTHON, PROGRAM) if name not in workers]
    notes = [
        f"The Manager has no variable {name} for workers on {platform()}: tasks fail on those. "
        "Add it to flamenco-manager.yaml."
        for name in missing
    ]
    root = choices.root or f"{{{SHARED}}}"
    return Farm(manager, version, etag, tag, real_path(shared), root, tuple(notes))


def submit(farm: Farm, folder: Path, choices: Choices) -> Submission:
    """Submit one job folder whose parts are planned; keep the job's id in the folder.

    Raises
    ------
    FarmError, UsageError, ParseError
        The Manager refuses; the folder lies outside of the shared one, is at work, is submitted
        already, or its parts are damaged or not all known yet.
    """
    target = JobFolder(real_path(folder))
    listed = checked_parts(target)
    where = folder_on_farm(target.root, farm.shared, farm.root)
    _refuse_twice(target.root)
    try:
        target.cancel_path.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable_error(target.cancel_path, error) from None
    body = job_body(target.root.name, listed, where, farm, choices)
    record = JobRecord(farm.manager.address, farm.manager.submit(body))
    try:
        write_record(target.root, record)
    except ResourceError:
        with contextlib.suppress(FarmError):
            farm.manager.cancel(record.job)  # nobody would find it again
        raise
    return Submission(record, len(listed.parts), farm.notes)


def checked_parts(target: JobFolder, planned: PartsGraph | None = None) -> PartsGraph:
    """Return the parts of a job folder that can be submitted.

    Parameters
    ----------
    planned : PartsGraph, optional
        Its parts, if they are not written yet.

    Raises
    ------
    UsageError, ParseError, DatasetError
        It is no job, a job runs there, or a region's tiles are decided only while it runs.
    """
    if not target.is_job():
        raise UsageError(f"{target.root} holds no job.", "Choose a job folder.")
    target.check_entries()
    job = read_job(target.job_path)
    if target.locked():
        raise UsageError(f"A job is running in {target.root}.", "Cancel it, or wait for its end.")
    listed = read_parts(target.root) if planned is None else planned
    _refuse_open_plans(job, listed)
    return listed


def _refuse_open_plans(job: JobFile, listed: PartsGraph) -> None:
    """Raise where a region's number of tiles is not known yet: all tasks must be."""
    meshing = job.settings.meshing
    if meshing.tiles != "auto" or meshing.method != "pam":  # others mesh in one piece
        return
    points = {need for part in listed.parts if part.kind == "points" for need in part.needs}
    for part in listed.parts:
        if part.kind == "plan" and part.name not in points:
            raise UsageError(
                f"How many tiles {part.name} makes is known only while the job runs, but Flamenco "
                "needs all tasks at once.",
                "Give the number: --tiles N, or off for one piece; Tiles in the panel.",
            )


def folder_on_farm(folder: Path, shared: Path, root: str) -> str:
    """Return a job folder's path as workers name it.

    Raises
    ------
    UsageError
        It lies outside of the shared folder, or a name in it would not reach a worker as it is.
    """
    if not folder.is_relative_to(shared) or folder == shared:
        raise UsageError(
            f"{folder} is not in the folder that the farm shares, {shared}.",
            f"Make the job there, or name another folder: --shared, or {SHARED_VARIABLE}.",
        )
    inside = PurePosixPath(*folder.relative_to(shared).parts)
    if any(character in str(inside) for character in "{}\\") or not str(inside).isprintable():
        raise UsageError(
            f"The name {inside} has braces, a backslash or control characters, which do not reach "
            "the workers as they are.",
            "Rename the folder.",
        )
    return f"{root.rstrip('/')}/{inside}"


def _refuse_twice(root: Path) -> None:
    """Raise where a folder is a Manager's job that is not over: two would run the same parts."""
    record = read_record(root)
    if record is None:
        return
    try:
        status = Manager(record.address).job_status(record.job)
    except NotFoundError:
        return  # deleted there
    except FarmError as error:
        raise FarmError(
            f"{root} was submitted before, and whether that job is over is not known: "
            f"{error.message}",
            "Start that Manager; or delete flamenco.json in the job folder, if it is gone.",
        ) from None
    if status in UNFINISHED:
        raise UsageError(
            f"{root} is already submitted to {record.address}: job {record.job} is {status}.",
            "Wait for it, or cancel it: batch.py farm cancel DIR.",
        )


def job_body(
    name: str, listed: PartsGraph, where: str, farm: Farm, choices: Choices
) -> dict[str, Any]:
    """Return the JSON values of a submission."""
    body = {
        "name": name,
        "type": JOB_TYPE,
        "type_etag": farm.etag,
        "priority": choices.priority,
        "submitter_platform": platform(),
        "settings": {
            "parts": parts_text(listed.parts),
            "job_folder": where,
            "python": f"{{{PYTHON}}}",
            "program": f"{{{PROGRAM}}}",
            "threads": 0,
            "device": "",
            "script_version": SCRIPT_VERSION,
        },
        "metadata": {
            "user.name": _user(),
            "project": name,
            "gaussian-wrapping.code": listed.code,
            "gaussian-wrapping.plan": listed.plan,
        },
    }
    return {**body, "worker_tag": farm.tag} if farm.tag else body


def parts_text(parts: tuple[Part, ...]) -> str:
    """Return the setting ``parts``: what the job type's script makes tasks of."""
    listed = [{"name": p.name, "kind": p.kind, "needs": list(p.needs)} for p in parts]
    return json.dumps({"version": 1, "parts": listed}, separators=(",", ":"))


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # no name in the environment, none in the system
        return ""

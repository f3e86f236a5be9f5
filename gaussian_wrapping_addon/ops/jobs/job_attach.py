# SPDX-License-Identifier: GPL-3.0-or-later
"""Find the jobs named by the open file, and keep scenes and jobs connected across undo."""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ...core.errors import WrapError
from ...core.jobs.client import JobClient
from ...core.jobs.store.job_folder import JobStatus
from ..common import known_jobs, tags
from ..common.addon import properties_of
from . import job_timer, watched_jobs
from .watched_jobs import WatchedJob, gone, jobs, key_of

_logger = logging.getLogger(__name__)


def find_job_folder(stored: str) -> Path | None:
    """Return the job folder named by the open file, or None if there is none.

    A folder that has moved together with the .blend file is found beside it.
    """
    if not stored:
        return None
    folder = Path(bpy.path.abspath(stored))
    candidates = [folder]
    if bpy.data.filepath:
        candidates.append(Path(bpy.data.filepath).parent / folder.name)
    for candidate in candidates:
        if known_jobs.is_trusted(candidate) and candidate.is_dir():
            return candidate
    return None


def attach(scene: bpy.types.Scene, folder: Path) -> JobStatus:
    """Watch the job of a folder; a running one is imported when done.

    Raises
    ------
    UsageError
        The folder contains no job.
    """
    client = JobClient.attach(folder)
    status = client.poll()
    watched_jobs.show(scene, folder, WatchedJob(client, status, scene.session_uid, status.active))
    if status.active:
        job_timer.start_timer()
    return status


def attach_open_file() -> None:
    """Find the jobs of the open file again; only reads their status."""
    for known in jobs.values():
        known.scene_uid = 0
    for scene in bpy.data.scenes:
        stored = properties_of(scene).job_folder
        job = jobs.get(key_of(stored))
        if job is not None:
            job.scene_uid = scene.session_uid
            if job.imports:  # finished while another file was open
                job.waits_for_mode = not job.status.active
                job_timer.start_timer()
            continue
        folder = find_job_folder(stored)
        if folder is None:
            place = Path(key_of(stored))
            # Folders known from the file alone are not touched: they may be on any network.
            if stored and known_jobs.is_trusted(place) and not place.is_dir():
                gone.add(str(place))
            continue
        try:
            attach(scene, folder)
        except (WrapError, OSError) as error:
            _logger.info("job of scene %s: %s", scene.name, error)


def attach_later() -> bool:
    """Attach once scripts can access the open file, at one tick of the timer."""
    attach_open_file()
    return False


@persistent
def after_load(_arguments: object = None, _unused: object = None) -> None:
    """``load_post``: find the jobs of the file that was opened."""
    with contextlib.suppress(AttributeError):  # the add-on is being removed
        attach_open_file()


@persistent
def after_undo(_scene: object = None, _unused: object = None) -> None:
    """``undo_post``, ``redo_post``: a scene keeps its job; starting one is no undo step."""
    newest = {job.scene_uid: folder for folder, job in jobs.items() if job.scene_uid}
    for uid, folder in newest.items():
        scene = tags.scene_of_uid(uid)
        if scene is not None and key_of(properties_of(scene).job_folder) != folder:
            properties_of(scene).job_folder = folder
            properties_of(scene).job_command = jobs[folder].command

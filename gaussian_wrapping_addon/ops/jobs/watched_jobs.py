# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs watched by this Blender, by folder, and queries of the panels about them.

No Blender objects are kept: undo and file loading invalidate every reference, so scenes are found
by their session uid and jobs by their folder. No function here reads a file.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import bpy

from ...core.jobs.client import JobClient
from ...core.jobs.store.job_folder import JobStatus
from ..baking.baked_files import BakedFiles
from ..common import tags
from ..common.addon import properties_of
from ..common.background import Lane, Task
from ..results.result_files import ResultFiles


@dataclass
class WatchedJob:
    """A watched job and its state."""

    client: JobClient
    status: JobStatus
    scene_uid: int
    """Session uid of the scene that shows the job; 0 if none in the open file does."""
    imports: bool
    """Whether its result is still wanted in the scene."""
    cancel_requested_s: float | None = None
    ending: Lane | None = None
    """Kills the worker if it does not stop; set once cancelling was requested."""
    command: str = "WRAP"
    waits_for_mode: bool = False
    """Finished, but Blender's mode does not allow the import."""
    status_read: Task[JobStatus] | None = None
    """Pending read of the job's status from the disk."""
    reading: Task[ResultFiles | BakedFiles] | None = None
    """The result while it is read, until it can be imported."""
    target_uid: int = 0
    """Session uid of the object that photos are baked onto; 0 if there is none, or unknown."""

    def release(self) -> None:
        """End the thread that kills the worker, if there is one."""
        if self.ending is not None:
            self.ending.stop()


jobs: dict[str, WatchedJob] = {}
"""By :func:`key_of` the folder; the newest job of a scene comes last."""

gone: set[str] = set()
"""Folders of this machine's jobs that were missing when their file was opened."""


def key_of(folder: str) -> str:
    """Return the key in :data:`jobs` of a stored folder; ``""`` for none."""
    return str(Path(bpy.path.abspath(folder))) if folder else ""


def show(scene: bpy.types.Scene, folder: Path, job: WatchedJob) -> None:
    """Show a job in a scene."""
    properties = properties_of(scene)
    properties.job_folder = str(folder)
    job.command = properties.job_command
    key = key_of(properties.job_folder)
    gone.discard(key)
    earlier = jobs.pop(key, None)
    if earlier is not None:
        earlier.release()
        job.target_uid = job.target_uid or earlier.target_uid  # resumed
    jobs[key] = job


def detach(scene: bpy.types.Scene) -> None:
    """Stop showing a job in a scene; the job's folder and result stay."""
    for job in jobs.values():
        if job.scene_uid == scene.session_uid:
            job.scene_uid, job.imports = 0, False
    properties_of(scene).job_folder = ""


def forget_all() -> None:
    """Stop watching all jobs; workers continue."""
    for job in jobs.values():
        job.release()
    jobs.clear()


def status_of(folder: str) -> JobStatus | None:
    """Return the last known status of a scene's job folder; None where it is not watched."""
    job = jobs.get(key_of(folder))
    return job.status if job else None


def is_gone(folder: str) -> bool:
    """Return whether a scene's job folder is missing."""
    return key_of(folder) in gone


def is_running(folder: str) -> bool:
    """Return whether a watched job is running in this folder."""
    status = status_of(folder)
    return status is not None and status.active


def waits_for_object_mode(folder: str) -> bool:
    """Return whether a finished job waits for Object Mode to be imported."""
    job = jobs.get(key_of(folder))
    return job is not None and job.waits_for_mode


def result_to_import(scene: bpy.types.Scene) -> str:
    """Return the result folder of a finished job that the scene does not show, or ``""``."""
    status = status_of(properties_of(scene).job_folder)
    if status is None or status.state != "DONE" or not status.result:
        return ""
    wanted = os.path.normpath(status.result)
    shown = (
        os.path.normpath(bpy.path.abspath(str(frame.get(tags.RESULT, ""))))
        for frame in tags.objects_of_kind(scene, "frame")
    )
    return "" if wanted in shown else status.result

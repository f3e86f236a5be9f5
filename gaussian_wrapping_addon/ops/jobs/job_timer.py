# SPDX-License-Identifier: GPL-3.0-or-later
"""Poll the watched jobs from Blender's timer and import their results."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bpy

from ...core import limits
from ...core.errors import UsageError, WrapError
from ...core.jobs.client import JobClient
from ...core.jobs.store.job_file import read_job
from ...core.jobs.store.job_folder import JobFolder, JobStatus
from ..baking.baked_files import BakedFiles, read_baked
from ..baking.baked_objects import apply_bake
from ..common import background, known_jobs, tags
from ..common.background import Lane, Task
from ..common.redrawing import redraw, redraw_status_bars
from ..results.result_files import ResultFiles, read_result
from ..results.scene_objects import import_result
from . import live_points, live_preview, watched_jobs
from .watched_jobs import WatchedJob, jobs

_logger = logging.getLogger(__name__)

POLL_WAIT_S = 0.0
"""Time that a poll waits for the disk; a later answer is used by the next poll."""

IMPORT_STAGE = "import"
"""Shown as a stage of the job while its result is read."""

_status_reads, _readings = Lane(), Lane()


def watch(
    scene: bpy.types.Scene,
    folder: Path,
    client: JobClient,
    *,
    imports: bool = True,
    target_uid: int = 0,
) -> None:
    """Show a job in a scene and follow it to its end.

    Parameters
    ----------
    imports : bool
        Whether its result is wanted in the scene.
    target_uid : int, optional
        Session uid of the object that photos are baked onto.
    """
    known_jobs.remember(folder)
    job = WatchedJob(client, client.poll(), scene.session_uid, imports, target_uid=target_uid)
    watched_jobs.show(scene, folder, job)
    start_timer()


def cancel(folder: str) -> None:
    """Request a job to stop; it is killed if it does not.

    A finished job whose result is being read stays finished, and its result is offered.

    Raises
    ------
    UsageError
        No job is watched in this folder.
    """
    job = jobs.get(watched_jobs.key_of(folder))
    if job is None:
        raise UsageError("No job is running.", "Start one first.")
    if job.reading is not None:
        job.imports, job.reading, job.waits_for_mode = False, None, False
        job.status = job.client.poll()
        return
    job.client.cancel()
    if job.cancel_requested_s is None:
        job.cancel_requested_s = time.monotonic()
        job.ending = Lane()
        job.ending.start()  # now: the timer starts no thread


def forget_all() -> None:
    """Stop watching; workers go on, and are found again by ``attach_open_file``."""
    watched_jobs.forget_all()
    _status_reads.stop()
    _readings.stop()


def start_timer() -> None:
    """Poll the jobs as long as one is running."""
    _status_reads.start()
    _readings.start()
    live_preview.start()
    live_points.start()
    background.watch(tick)


def tick() -> bool:
    """Poll all jobs once, from the add-on's timer."""
    return poll_jobs()


def poll_jobs(clock: Callable[[], float] = time.monotonic) -> bool:
    """Poll all jobs once and import finished ones; return whether to poll again."""
    busy = changed = False
    for folder, job in list(jobs.items()):
        if not (job.status.active or job.waits_for_mode):
            continue
        before = (job.status, job.waits_for_mode)
        now_s = clock()
        try:
            _poll(folder, job, now_s)
        except Exception as error:  # a timer that raises would be dropped silently
            _logger.exception("looking at the job in %s", folder)
            job.status = replace(
                job.status,
                state="FAILED",
                error=f"The job folder cannot be read: {error}",
                hint="See the system console, then choose Find Job.",
            )
        if not job.status.active:
            job.release()
            live_preview.forget(folder)
            live_points.forget(folder)
        elif job.status.stage == "train":
            changed = live_preview.refresh(folder, now_s) or changed
            changed = live_points.refresh(folder, now_s) or changed
        busy = busy or job.status.active or job.waits_for_mode
        changed = changed or before != (job.status, job.waits_for_mode)
    if changed:
        redraw()
        redraw_status_bars()
    return busy


def _poll(folder: str, job: WatchedJob, now_s: float) -> None:
    requested_s = job.cancel_requested_s if job.status.active else None
    if requested_s is not None and now_s - requested_s > limits.CANCEL_GRACE_S:
        _logger.warning("job in %s does not stop; ending it", folder)
        job.cancel_requested_s = now_s
        if job.ending is not None:
            job.ending.submit(job.client.kill)
    if job.status_read is None:
        client = job.client
        job.status_read = _status_reads.submit(lambda: _read_status(client))
    if not job.status_read.finished(POLL_WAIT_S):
        return
    status_read, job.status_read = job.status_read, None
    job.status = status_read.result()
    job.waits_for_mode = False
    if job.status.active:
        return
    if job.status.state == "LOST" and job.cancel_requested_s is not None:
        hint = "Resume continues from the last checkpoint."
        job.status = replace(job.status, state="CANCELLED", error="", hint=hint)
    if job.status.state == "DONE" and job.imports:
        _bring_in(folder, job)


def _read_status(client: JobClient) -> JobStatus:
    """Read a job's status from its folder; runs in a thread."""
    status = client.poll()
    # It may have written its last status between our reads of the file and of the process.
    return client.poll() if status.state == "LOST" else status


def _bring_in(folder: str, job: WatchedJob) -> None:
    """Read a finished job's result in the background, then import it in one step."""
    scene = tags.scene_of_uid(job.scene_uid)
    if scene is None:
        job.reading = None  # another file is open: opening the old one again imports it
        return
    if job.reading is None:
        job.reading = _reading(Path(job.status.result))
    if not job.reading.finished():
        job.status = replace(
            job.status, state="RUNNING", stage=IMPORT_STAGE, message="reading the result"
        )
        return
    job.waits_for_mode = bpy.context.mode != "OBJECT"
    if not job.waits_for_mode:
        reading, job.imports, job.reading = job.reading, False, None
        _import(folder, job, scene, reading.result)


def _reading(result: Path) -> Task[ResultFiles | BakedFiles]:
    return _readings.submit(lambda: _read_outcome(result))


def _read_outcome(result: Path) -> ResultFiles | BakedFiles:
    """Read what a finished job has made; runs in a thread."""
    folder = JobFolder(result.parent)
    try:
        bake = read_job(folder.job_path).bake
    except WrapError:
        bake = None  # of a job that was made elsewhere, only the result counts
    if bake is not None:
        return read_baked(folder.baked / bake.name)
    return read_result(result)


def _import(
    folder: str,
    job: WatchedJob,
    scene: bpy.types.Scene,
    files: Callable[[], ResultFiles | BakedFiles],
) -> None:
    try:
        found = files()
        if isinstance(found, BakedFiles):
            apply_bake(scene, _frame_of(scene, job.client.folder), found, job.target_uid)
            _push_undo("Bake Photos")
        else:
            import_result(Path(job.status.result), scene, found)
            _push_undo("Import Wrap Result")
    except WrapError as error:
        job.status = replace(job.status, state="FAILED", error=error.message, hint=error.hint)
    except Exception as error:
        _logger.exception("importing the result of %s", folder)
        job.status = replace(
            job.status,
            state="FAILED",
            error=f"The result could not be imported: {error}",
            hint="See the system console, then try Import Result.",
        )


def _frame_of(scene: bpy.types.Scene, folder: JobFolder) -> bpy.types.Object:
    """Return the frame in a scene of a job's result."""
    for frame in tags.objects_of_kind(scene, "frame"):
        with contextlib.suppress(UsageError):
            if tags.result_folder(frame).resolve() == folder.result.resolve():
                return frame
    raise UsageError(
        f"The scene does not show the result of {folder.root.name}.",
        "Import it, then press Bake Photos again: what is baked already is used.",
    )


def _push_undo(message: str) -> None:
    windows = bpy.context.window_manager.windows
    if bpy.app.background or not windows:
        return  # no undo without a window
    with bpy.context.temp_override(window=bpy.context.window or windows[0]):
        bpy.ops.ed.undo_push(message=message)

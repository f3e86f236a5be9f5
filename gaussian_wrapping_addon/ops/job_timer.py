# SPDX-License-Identifier: GPL-3.0-or-later
"""Watch jobs from one Blender timer, and import what they have made.

Nothing of Blender is kept from one tick to the next: undo and file loading invalidate every
reference, so that scenes are found by their session uid and jobs by their folder. The panel draws
from :func:`status_of`, which reads no file.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..core import limits
from ..core.errors import UsageError, WrapError
from ..core.jobs.client import JobClient
from ..core.jobs.job_folder import JobStatus
from . import known_jobs, live_preview, tags
from .in_background import InBackground, Lane
from .redrawing import redraw
from .result_files import ResultFiles, read_result
from .scene_objects import import_result

_logger = logging.getLogger(__name__)

POLL_S = 0.3
LOOK_WAIT_S = 0.0
"""For the disk to tell of a job; what it has told is seen at the next look."""
IMPORT_STAGE = "import"
"""Shown as a stage of the job while its result is read."""


@dataclass
class _Job:
    client: JobClient
    status: JobStatus
    scene_uid: int
    """Session uid of the scene that shows the job; 0 where the open file has none."""
    imports: bool
    """Whether its result is still wanted in the scene."""
    cancel_asked_s: float | None = None
    command: str = "WRAP"
    waits_for_mode: bool = False
    """Finished, but Blender is in a mode in which nothing can be imported."""
    look: InBackground[JobStatus] | None = None
    """A look at the job's folder that the disk has not answered yet."""
    reading: InBackground[ResultFiles] | None = None
    """The result while it is read, and until it can be imported."""


_looks, _readings = Lane(), Lane()
_jobs: dict[str, _Job] = {}
_gone: set[str] = set()
"""Folders of this machine's jobs that were not there when their file was opened."""


def key_of(folder: str) -> str:
    """Return the name by which the job of a stored folder is known; ``""`` for none."""
    return str(Path(bpy.path.abspath(folder))) if folder else ""


def watch(scene: bpy.types.Scene, folder: Path, client: JobClient, *, imports: bool = True) -> None:
    """Show a job in a scene and follow it to its end."""
    known_jobs.remember(folder)
    _show(scene, folder, _Job(client, client.poll(), scene.session_uid, imports))
    start_timer()


def _show(scene: bpy.types.Scene, folder: Path, job: _Job) -> None:
    properties = scene.gwrap
    properties.job_folder = str(folder)
    job.command = properties.job_command
    key = key_of(properties.job_folder)
    _gone.discard(key)
    _jobs.pop(key, None)  # the newest job of a scene is the last
    _jobs[key] = job


def status_of(folder: str) -> JobStatus | None:
    """Return the last known status of a scene's job folder; None where it is not watched."""
    job = _jobs.get(key_of(folder))
    return job.status if job else None


def is_gone(folder: str) -> bool:
    """Tell whether a scene's job folder was not to be found; reads nothing."""
    return key_of(folder) in _gone


def result_to_import(scene: bpy.types.Scene) -> str:
    """Return the result folder of a finished job that the scene does not show, or ``""``."""
    status = status_of(scene.gwrap.job_folder)
    if status is None or status.state != "DONE" or not status.result:
        return ""
    wanted = os.path.normpath(status.result)
    shown = (
        os.path.normpath(bpy.path.abspath(str(frame.get(tags.RESULT, ""))))
        for frame in tags.objects_of_kind(scene, "frame")
    )
    return "" if wanted in shown else status.result


def is_running(folder: str) -> bool:
    """Tell whether a job works in this folder, as far as this Blender knows."""
    status = status_of(folder)
    return status is not None and status.active


def waits_for_object_mode(folder: str) -> bool:
    """Tell whether a finished job waits for Object Mode to be imported."""
    job = _jobs.get(key_of(folder))
    return job is not None and job.waits_for_mode


def cancel(folder: str) -> None:
    """Ask a job to stop; it is ended by force when it does not.

    A finished job whose result is being read stays finished, and its result is offered.

    Raises
    ------
    UsageError
        No job is watched in this folder.
    """
    job = _jobs.get(key_of(folder))
    if job is None:
        raise UsageError("No job is running.", "Start one first.")
    if job.reading is not None:
        job.imports, job.reading, job.waits_for_mode = False, None, False
        job.status = job.client.poll()
        return
    job.client.cancel()
    if job.cancel_asked_s is None:
        job.cancel_asked_s = time.monotonic()


def detach(scene: bpy.types.Scene) -> None:
    """Let a scene show no job any more; the job's folder and its result stay."""
    for job in _jobs.values():
        if job.scene_uid == scene.session_uid:
            job.scene_uid, job.imports = 0, False
    scene.gwrap.job_folder = ""


def forget_all() -> None:
    """Stop watching; workers go on, and are found again by :func:`attach_open_file`."""
    _jobs.clear()
    _looks.stop()
    _readings.stop()


def start_timer() -> None:
    """Let Blender call :func:`tick`."""
    _looks.start()
    _readings.start()
    live_preview.start()
    if not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=POLL_S, persistent=True)


def stop_timer() -> None:
    """Take the timer out."""
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)


def tick() -> float | None:
    """Look at all jobs once; return the seconds to the next look, None when idle."""
    return POLL_S if poll_jobs() else None


def poll_jobs(clock: Callable[[], float] = time.monotonic) -> bool:
    """Look at all jobs once and import what is done; tell whether another look is needed."""
    busy = changed = False
    for folder, job in list(_jobs.items()):
        if not (job.status.active or job.waits_for_mode):
            continue
        before = (job.status, job.waits_for_mode)
        now_s = clock()
        try:
            _poll(folder, job, now_s)
        except Exception as error:  # a timer that raises would be dropped without a word
            _logger.exception("looking at the job in %s", folder)
            job.status = replace(
                job.status,
                state="FAILED",
                error=f"The job folder cannot be read: {error}",
                hint="See the system console, then choose Find Job.",
            )
        if not job.status.active:
            live_preview.forget(folder)
        elif job.status.stage == "train":
            changed = live_preview.refresh(folder, now_s) or changed
        busy = busy or job.status.active or job.waits_for_mode
        changed = changed or before != (job.status, job.waits_for_mode)
    if changed:
        redraw()
    return busy


def _poll(folder: str, job: _Job, now_s: float) -> None:
    asked_s = job.cancel_asked_s if job.status.active else None
    if asked_s is not None and now_s - asked_s > limits.CANCEL_GRACE_S:
        _logger.warning("job in %s does not stop; ending it", folder)
        job.cancel_asked_s = now_s
        # It waits for the process to end, which Blender must not.
        threading.Thread(target=job.client.kill, daemon=True).start()
    if job.look is None:
        client = job.client
        job.look = _looks.run(lambda: _looked(client))
    if not job.look.finished(LOOK_WAIT_S):
        return
    look, job.look = job.look, None
    job.status = look.answer()
    job.waits_for_mode = False
    if job.status.active:
        return
    if job.status.state == "LOST" and job.cancel_asked_s is not None:
        hint = "Resume continues from the last checkpoint."
        job.status = replace(job.status, state="CANCELLED", error="", hint=hint)
    if job.status.state == "DONE" and job.imports:
        _bring_in(folder, job)


def _looked(client: JobClient) -> JobStatus:
    """Look at a job's folder; runs in a thread."""
    status = client.poll()
    # It may have written its last word between our look at the file and at the process.
    return client.poll() if status.state == "LOST" else status


def _bring_in(folder: str, job: _Job) -> None:
    """Read a finished job's result in the background, then import it in one piece."""
    scene = scene_of_uid(job.scene_uid)
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
        _import(folder, job, scene, reading.answer)


def _reading(folder: Path) -> InBackground[ResultFiles]:
    return _readings.run(lambda: read_result(folder))


def _import(
    folder: str, job: _Job, scene: bpy.types.Scene, files: Callable[[], ResultFiles]
) -> None:
    try:
        import_result(Path(job.status.result), scene, files())
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


def _push_undo(message: str) -> None:
    windows = bpy.context.window_manager.windows
    if bpy.app.background or not windows:
        return  # no undo without a window
    with bpy.context.temp_override(window=bpy.context.window or windows[0]):
        bpy.ops.ed.undo_push(message=message)


def scene_of_uid(uid: int) -> bpy.types.Scene | None:
    """Return the scene of a session uid in the open file."""
    return next((s for s in bpy.data.scenes if s.session_uid == uid), None)


def find_job_folder(stored: str) -> Path | None:
    """Return the job folder that the open file means, or None where there is none to be had.

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
    """Watch a job that lies in a folder; a running one is imported when it is done.

    Raises
    ------
    UsageError
        The folder holds no job.
    """
    client = JobClient.attach(folder)
    status = client.poll()
    _show(scene, folder, _Job(client, status, scene.session_uid, status.active))
    if status.active:
        start_timer()
    return status


def attach_open_file() -> None:
    """Find the jobs of the open file again; only reads their status, starts and asks nothing."""
    for job in _jobs.values():
        job.scene_uid = 0
    for scene in bpy.data.scenes:
        stored = scene.gwrap.job_folder
        job = _jobs.get(key_of(stored))
        if job is not None:
            job.scene_uid = scene.session_uid
            if job.imports:  # finished while another file was open
                job.waits_for_mode = not job.status.active
                start_timer()
            continue
        folder = find_job_folder(stored)
        if folder is None:
            place = Path(key_of(stored))
            # Folders that only the file names are not touched: they may be on anybody's network.
            if stored and known_jobs.is_trusted(place) and not place.is_dir():
                _gone.add(str(place))
            continue
        try:
            attach(scene, folder)
        except (WrapError, OSError) as error:
            _logger.info("job of scene %s: %s", scene.name, error)


def attach_later() -> None:
    """Timer function: attach once Blender lets scripts see the open file."""
    attach_open_file()


@persistent
def after_load(_arguments: object = None, _unused: object = None) -> None:
    """``load_post``: find the jobs of the file that was opened."""
    with contextlib.suppress(AttributeError):  # the add-on is being removed
        attach_open_file()


@persistent
def after_undo(_scene: object = None, _unused: object = None) -> None:
    """``undo_post``, ``redo_post``: a scene keeps its job; starting one is no undo step."""
    newest = {job.scene_uid: folder for folder, job in _jobs.items() if job.scene_uid}
    for uid, folder in newest.items():
        scene = scene_of_uid(uid)
        if scene is not None and key_of(scene.gwrap.job_folder) != folder:
            scene.gwrap.job_folder = folder
            scene.gwrap.job_command = _jobs[folder].command

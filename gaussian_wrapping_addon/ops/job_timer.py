# SPDX-License-Identifier: GPL-3.0-or-later
"""One timer watches all jobs; what a running one shows: figures, points, picture."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bpy
import bpy.utils.previews
import numpy as np

from ..core import limits
from ..core.errors import UsageError, WrapError
from ..core.files import read_bounded
from ..core.gaussians.preview_points import MAX_POINTS_BYTES, POINTS_FILE, parse_points
from ..core.jobs.client import JobClient
from ..core.jobs.store.job_file import read_job
from ..core.jobs.store.job_folder import JobFolder, JobStatus
from . import addon, background
from .addon import properties_of, redraw, redraw_status_bars
from .background import Lane, Task
from .bake_objects import BakedFiles, apply_bake, read_baked
from .result_files import ResultFiles, read_result
from .scene_objects import import_result

# -- Jobs watched by this Blender, by folder, and queries of the panels about them ----------------
#
# No Blender objects are kept: undo and file loading invalidate every reference, so scenes are
# found by their session uid and jobs by their folder. No function here reads a file.


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
    shown = map(_named, addon.objects_of_kind(scene, "frame"))
    return "" if os.path.normpath(status.result) in shown else status.result


# -- What a running training shows: a picture for the panel, points for the 3D view ---------------
#
# Panels and views draw often and must neither read the disk nor create data: they call
# :func:`icons_of` and :func:`points_of`. Pictures are in a preview collection, not in ``bpy.data``,
# so that nothing is saved, part of undo, or left behind. Files are searched and read in a thread,
# pictures as plain pixels: Blender takes longer to decode its first image than its window may wait.


_logger = logging.getLogger(__name__)

PICTURE = "preview-training.npy"
WHOLE_TRAININGS = ("train-*", "blocks-*/coarse-*")
"""Folders of trainings of the whole scene, in that of the stages."""
ALL_TRAININGS = (*WHOLE_TRAININGS, "blocks-*/block-*")
EVERY_S = 3.0
"""Interval between two searches of the folder."""
MAX_BYTES = 8 * 2**20
"""Larger files are not a preview; drawing them would be noticeable."""

Stamp = tuple[str, int, int]
"""Path, time in ns and size in bytes of a file."""


@dataclass(frozen=True)
class LivePoints:
    """Points of a running training."""

    stamp: Stamp
    positions: np.ndarray
    """(n, 3) float32, scene frame."""
    colors: np.ndarray
    """(n, 4) float32, 0 to 1."""


@dataclass(frozen=True)
class _Picture:
    stamp: Stamp
    parts: tuple[np.ndarray, ...]
    """Each (h, w, 4) float32, as Blender wants them: from the bottom up."""


@dataclass
class _Shown:
    searched_s: float = float("-inf")
    stamp: Stamp | None = None
    reading: Task[Any] | None = None


@dataclass
class _ShownPreview(_Shown):
    names: tuple[str, ...] = ()
    icons: tuple[int, ...] = ()


@dataclass
class _ShownPoints(_Shown):
    points: LivePoints | None = None


_live_readings = Lane()
_shown_previews: dict[str, _ShownPreview] = {}
_shown_points: dict[str, _ShownPoints] = {}
_pictures: Any = None  # ImagePreviewCollection, created with the first image
_count = 0


def icons_of(folder: str) -> tuple[int, ...]:
    """Return the icons of a job folder's image, or none; reads no file.

    A photo beside its rendering gives two: an icon is drawn in a square.
    """
    shown = _shown_previews.get(folder)
    return shown.icons if shown else ()


def points_of(scene: bpy.types.Scene) -> LivePoints | None:
    """Return the points to draw in a scene; None if there are none or they are not wanted."""
    properties = properties_of(scene)
    status = status_of(properties.job_folder)
    if not properties.show_points or status is None or not status.active or status.stage != "train":
        return None
    shown = _shown_points.get(key_of(properties.job_folder))
    return shown.points if shown else None


def frame_of_job(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Return the frame of an earlier result of the scene's job; None before the first."""
    wanted = os.path.join(key_of(properties_of(scene).job_folder), "result")
    return next((f for f in addon.objects_of_kind(scene, "frame") if _named(f) == wanted), None)


def _named(frame: bpy.types.Object) -> str:
    """Return the result folder that a frame names, without a look at the disk."""
    return os.path.normpath(bpy.path.abspath(str(frame.get(addon.RESULT, ""))))


def newest_picture(
    folder: Path, name: str = PICTURE, places: tuple[str, ...] = ALL_TRAININGS
) -> Stamp | None:
    """Return the image of the running training, or another of its files, or None."""
    found = []
    for path in (p for place in places for p in (folder / "stages").glob(f"{place}/{name}")):
        try:
            state = path.stat()
            if path.is_symlink() or (path.parent / "done.json").exists():
                continue
        except OSError:
            continue
        found.append((state.st_mtime_ns, state.st_size, str(path)))
    if not found:
        return None
    time_ns, size_bytes, text = max(found)
    return text, time_ns, size_bytes


def refresh(folder: str, now_s: float) -> bool:
    """Search for a new image, at most every few seconds; return whether a new one is shown.

    It is read in a thread and shown by a later call. The old image stays until then: an incomplete
    or broken file changes nothing.
    """
    shown = _shown_previews.setdefault(folder, _ShownPreview())

    def keep(picture: _Picture) -> None:
        loaded = _load(picture.parts)
        _drop(shown.names)
        shown.names, shown.icons = loaded

    return _refreshed(shown, folder, now_s, _read_preview, keep)


def refresh_points(folder: str, now_s: float) -> bool:
    """Search for new points, as :func:`refresh`; return whether there are new ones."""
    shown = _shown_points.setdefault(folder, _ShownPoints())

    def keep(points: LivePoints) -> None:
        shown.points = points

    return _refreshed(shown, folder, now_s, _read_points, keep)


def _refreshed(
    shown: _Shown,
    folder: str,
    now_s: float,
    read: Callable[[Path, Stamp | None], Any],
    keep: Callable[[Any], None],
) -> bool:
    if shown.reading is None:
        if now_s - shown.searched_s >= EVERY_S:
            shown.searched_s, known = now_s, shown.stamp
            shown.reading = _live_readings.submit(lambda: read(Path(folder), known))
        return False
    if not shown.reading.finished():
        return False
    reading, shown.reading = shown.reading, None
    try:
        found = reading.result()
        if found is None:
            return False
        keep(found)
    except Exception:  # whatever the file contains: the job continues without it
        _logger.info("no picture or points of %s", folder, exc_info=True)
        return False
    shown.stamp = found.stamp
    return True


def forget(folder: str) -> None:
    """Remove the image and the points of a job that has ended."""
    _shown_points.pop(folder, None)
    shown = _shown_previews.pop(folder, None)
    if shown is not None:
        _drop(shown.names)


def stop() -> None:
    """Remove all images and points; Blender warns about collections left behind."""
    global _pictures
    _shown_previews.clear()
    _shown_points.clear()
    _live_readings.stop()
    if _pictures is not None:
        bpy.utils.previews.remove(_pictures)
        _pictures = None


def _read_preview(folder: Path, known: Stamp | None) -> _Picture | None:
    """Return the newest image, cut in two if it is wide; None if there is no new one.

    Raises Exception: the file cannot be read or contains no image; NumPy raises many types.
    """
    stamp = newest_picture(folder)
    if stamp is None or stamp == known or stamp[2] > MAX_BYTES:
        return None
    data = read_bounded(Path(stamp[0]), MAX_BYTES)  # not mapped: the file may be replaced meanwhile
    pixels = np.load(io.BytesIO(data), allow_pickle=False)
    if not isinstance(pixels, np.ndarray):
        raise ValueError(f"{stamp[0]} holds several arrays")
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8 or not pixels.size:
        raise ValueError(f"{stamp[0]} holds {pixels.dtype} of shape {pixels.shape}")
    height, width, _ = pixels.shape
    values = np.ones((height, width, 4), np.float32)
    values[..., :3] = pixels[::-1] / np.float32(255.0)
    if width < 2 * height:
        return _Picture(stamp, (values,))
    return _Picture(stamp, (values[:, : width // 2], values[:, -(width // 2) :]))


def _read_points(folder: Path, known: Stamp | None) -> LivePoints | None:
    """Return the newest points, None if there are no new ones."""
    stamp = newest_picture(folder, POINTS_FILE, WHOLE_TRAININGS)
    if stamp is None or stamp == known or stamp[2] > MAX_POINTS_BYTES:
        return None
    return LivePoints(stamp, *parse_points(read_bounded(Path(stamp[0]), MAX_POINTS_BYTES)))


def _load(parts: tuple[np.ndarray, ...]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Create previews from (h, w, 4) values; return names and icons."""
    global _pictures, _count
    if _pictures is None:
        _pictures = bpy.utils.previews.new()
    _count += 1  # new names each time: Blender caches what it has drawn under a name
    names = tuple(f"{_count} {part}" for part in ("photo", "rendering")[: len(parts)])
    return names, tuple(new_icon(_pictures, *named) for named in zip(names, parts, strict=True))


def new_icon(pictures: Any, name: str, pixels: np.ndarray) -> int:
    """Add (h, w, 4) float32 pixels to a preview collection; return their icon."""
    picture = pictures.new(name)
    picture.image_size = pixels.shape[1::-1]
    picture.image_pixels_float.foreach_set(np.ascontiguousarray(pixels).ravel())
    return int(picture.icon_id)


def _drop(names: tuple[str, ...]) -> None:
    for name in names:
        if _pictures is not None and name in _pictures:
            del _pictures[name]


# -- Poll the watched jobs from Blender's timer and import their results --------------------------


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
    addon.remember(folder)
    job = WatchedJob(client, client.poll(), scene.session_uid, imports, target_uid=target_uid)
    show(scene, folder, job)
    start_timer()


def cancel(folder: str) -> None:
    """Request a job to stop; it is killed if it does not.

    A finished job whose result is being read stays finished, and its result is offered. Raises
    UsageError: no job is watched in this folder.
    """
    job = jobs.get(key_of(folder))
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


def forget_all_jobs() -> None:
    """Stop watching; workers go on, and are found again by ``attach_open_file``."""
    for job in jobs.values():
        job.release()
    jobs.clear()
    _status_reads.stop()
    _readings.stop()


def start_timer() -> None:
    """Poll the jobs as long as one is running."""
    for lane in (_status_reads, _readings, _live_readings):
        lane.start()  # the timer starts no thread
    background.watch(poll_jobs)


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
            forget(folder)
        elif job.status.stage == "train":
            changed = refresh(folder, now_s) or changed
            changed = refresh_points(folder, now_s) or changed
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
    scene = addon.scene_of_uid(job.scene_uid)
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
    """Read what a finished job has made, in a thread."""

    def read() -> ResultFiles | BakedFiles:
        folder = JobFolder(result.parent)
        try:
            bake = read_job(folder.job_path).bake
        except WrapError:
            bake = None  # of a job that was made elsewhere, only the result counts
        return read_result(result) if bake is None else read_baked(folder.baked / bake.name)

    return _readings.submit(read)


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
    for frame in addon.objects_of_kind(scene, "frame"):
        with contextlib.suppress(UsageError):
            if addon.result_folder(frame).resolve() == folder.result.resolve():
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

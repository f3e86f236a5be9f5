# SPDX-License-Identifier: GPL-3.0-or-later
"""Points of a running training for the 3D view, read by the job timer, drawn from memory.

As with the preview image (``live_preview.py``), a thread searches and reads the file, and nothing
is put into ``bpy.data``: nothing is saved, nothing is part of undo, and nothing is left behind.
"""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ...core.gaussians.preview_points import MAX_BYTES, POINTS_FILE, parse_points
from ...core.regular_files import read_bounded
from ..common import tags
from ..common.addon import properties_of
from ..common.background import Lane, Task
from . import watched_jobs
from .live_preview import EVERY_S, WHOLE_TRAININGS, Stamp, newest_picture

_logger = logging.getLogger(__name__)

_NEVER_S = float("-inf")


@dataclass(frozen=True)
class LivePoints:
    """Points of a running training."""

    stamp: Stamp
    positions: np.ndarray
    """(n, 3) float32, scene frame."""
    colors: np.ndarray
    """(n, 4) float32, 0 to 1."""


@dataclass
class _Shown:
    searched_s: float = _NEVER_S
    points: LivePoints | None = None
    reading: Task[LivePoints | None] | None = None


_readings = Lane()
_shown: dict[str, _Shown] = {}


def points_of(scene: bpy.types.Scene) -> LivePoints | None:
    """Return the points to draw in a scene; None if there are none or they are not wanted."""
    properties = properties_of(scene)
    status = watched_jobs.status_of(properties.job_folder)
    if not properties.show_points or status is None or not status.active or status.stage != "train":
        return None
    shown = _shown.get(watched_jobs.key_of(properties.job_folder))
    return shown.points if shown else None


def frame_of_job(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Return the frame of an earlier result of the scene's job; None before the first."""
    wanted = os.path.join(watched_jobs.key_of(properties_of(scene).job_folder), "result")
    for frame in tags.objects_of_kind(scene, "frame"):
        if os.path.normpath(bpy.path.abspath(str(frame.get(tags.RESULT, "")))) == wanted:
            return frame
    return None


def refresh(folder: str, now_s: float) -> bool:
    """Search for new points, at most every few seconds; return whether there are new ones."""
    shown = _shown.setdefault(folder, _Shown())
    if shown.reading is None:
        if now_s - shown.searched_s >= EVERY_S:
            shown.searched_s = now_s
            known = shown.points.stamp if shown.points else None
            shown.reading = _readings.submit(lambda: _read(Path(folder), known))
        return False
    if not shown.reading.finished():
        return False
    reading, shown.reading = shown.reading, None
    try:
        read = reading.result()
    except Exception:  # whatever the file contains: the job continues without its points
        _logger.info("no points of %s", folder, exc_info=True)
        return False
    if read is not None:
        shown.points = read
    return read is not None


def forget(folder: str) -> None:
    """Remove the points of a job that has ended."""
    _shown.pop(folder, None)


def start() -> None:
    """Start the thread that reads points, ahead of the first ones."""
    _readings.start()


def stop() -> None:
    """Remove everything."""
    _shown.clear()
    _readings.stop()


def _read(folder: Path, known: Stamp | None) -> LivePoints | None:
    """Return the newest points, None if there are no new ones; runs in a thread."""
    stamp = newest_picture(folder, POINTS_FILE, WHOLE_TRAININGS)
    if stamp is None or stamp == known or stamp[2] > MAX_BYTES:
        return None
    positions, colors = parse_points(read_bounded(Path(stamp[0]), MAX_BYTES))
    return LivePoints(stamp, positions, colors)

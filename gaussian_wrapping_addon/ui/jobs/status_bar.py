# SPDX-License-Identifier: GPL-3.0-or-later
"""Progress of the open file's jobs in the status bar of every window.

The bar's header calls :func:`draw`, which shows nothing unless a job of the open file runs: the
state of the jobs decides, so that nothing has to be taken back when one ends.
"""

from __future__ import annotations

import logging
from typing import Any, Final

import bpy

from ...core.jobs.store.job_folder import JobStatus
from ...ops.jobs import watched_jobs
from ..common.text import progress_text

_logger = logging.getLogger(__name__)

WIDTH: Final = 13.0
"""In Blender's units: room for the longest line."""

_failed = False


def start() -> None:
    """Add the progress to the status bar."""
    stop()
    bpy.types.STATUSBAR_HT_header.append(draw)


def stop() -> None:
    """Remove it."""
    global _failed
    _failed = False
    bpy.types.STATUSBAR_HT_header.remove(draw)


def running_jobs() -> list[JobStatus]:
    """Return the status of the open file's running jobs, the newest last."""
    return [j.status for j in watched_jobs.jobs.values() if j.scene_uid and j.status.active]


def draw(header: Any, _context: bpy.types.Context) -> None:
    """Draw the newest running job; Blender calls this. An error is logged once."""
    global _failed
    try:
        _draw(header.layout)
    except Exception:  # an exception here would recur at every redraw
        if not _failed:
            _logger.exception("progress cannot be drawn")
        _failed = True


def _draw(layout: Any) -> None:
    running = running_jobs()
    if not running:
        return
    status = running[-1]
    fraction = min(max(status.fraction, 0.0), 1.0)
    text = progress_text(status.stage, fraction, status.seconds_left)
    if len(running) > 1:
        text = f"{text} (+{len(running) - 1})"
    row = layout.row()
    row.ui_units_x = WIDTH
    row.progress(factor=fraction, text=text, type="BAR")

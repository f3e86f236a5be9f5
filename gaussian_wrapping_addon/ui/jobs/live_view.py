# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws a running training under its progress bar: figures and picture, from memory."""

from __future__ import annotations

from typing import Any

from ...core.jobs.store.job_folder import JobStatus
from ...ops.jobs import live_preview, watched_jobs
from ...ops.jobs.live_figures import live_rows
from ..common.panel_base import table

_PICTURE_SCALE = 9.0  # of an icon's size: about the width of the panel as Blender starts


def draw_live(layout: Any, properties: Any, status: JobStatus) -> bool:
    """Draw figures and image of the running training; return whether there were any."""
    rows = live_rows(status)
    if not rows:
        return False
    table(layout, rows)
    layout.prop(properties, "show_points")
    icons = live_preview.icons_of(watched_jobs.key_of(properties.job_folder))
    if icons:
        row = layout.row(align=True)
        for icon in icons:
            row.template_icon(icon_value=icon, scale=_PICTURE_SCALE / len(icons))
    return True

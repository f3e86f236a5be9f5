# SPDX-License-Identifier: GPL-3.0-or-later
"""How the worker's set-up is drawn: in the preferences, and one line in the panel."""

from __future__ import annotations

from typing import Any

import bpy

from ..ops import doctor, worker_setup
from .text import characters_of, wrapped_label


def draw_setup(layout: Any, context: Any) -> None:
    """Draw state, progress and buttons of the worker's environment."""
    worker_setup.look_around()
    characters = characters_of(context)
    environment = worker_setup.environment()
    if environment.is_ready():
        text = f"A worker is set up in {environment.root}"
        wrapped_label(layout, text, characters, icon="CHECKMARK")
    elif worker_setup.is_busy():
        pass
    elif environment.is_half():
        text = "The worker is only half set up and is not used. Set Up Worker goes on with it."
        wrapped_label(layout, text, characters, icon="ERROR")
    elif worker_setup.worker_ready():
        layout.label(text="Jobs use a Python that was set up by hand", icon="INFO")
    else:
        text = "No worker is set up yet. Jobs need one: a private Python with torch."
        wrapped_label(layout, text, characters, icon="ERROR")
    _draw_status(layout, characters)
    row = layout.row()
    row.operator("gwrap.set_up_worker", text="Set Up Worker…", icon="IMPORT")
    row.operator("gwrap.repair_worker", icon="TOOL_SETTINGS")
    row.operator("gwrap.remove_worker", icon="TRASH")
    if not bpy.app.online_access:
        text = (
            "Blender may not go online. Turn on Allow Online Access in Preferences, System, "
            "or choose a Wheel Folder, which needs none."
        )
        wrapped_label(layout, text, characters, icon="INTERNET_OFFLINE")


def _draw_status(layout: Any, characters: int) -> None:
    status = worker_setup.status()
    if status is None:
        return
    if status.active:
        layout.progress(
            factor=min(max(status.fraction, 0.0), 1.0),
            text=f"{(status.stage or 'starting').capitalize()} · {100 * status.fraction:.0f} %",
            type="BAR",
        )
        if status.message:
            wrapped_label(layout, status.message, characters)
        if status.stage != "remove":
            text = "Cancelling…" if worker_setup.is_cancelling() else "Cancel"
            layout.operator("gwrap.cancel_setup", text=text, icon="X")
    elif status.state == "DONE":
        done = "removed" if status.stage == "remove" else "ready"
        layout.label(text=f"The worker is {done}", icon="CHECKMARK")
    else:
        icon = "PAUSE" if status.state == "CANCELLED" else "ERROR"
        wrapped_label(layout, status.error, characters, icon=icon)
        if status.hint:
            wrapped_label(layout, status.hint, characters, icon="BLANK1")


def draw_doctor(layout: Any, context: Any) -> None:
    """Draw the doctor's buttons and findings."""
    row = layout.row()
    row.operator("gwrap.check_worker", icon="VIEWZOOM")
    row.operator("gwrap.copy_findings", icon="COPYDOWN")
    if doctor.is_busy():
        layout.label(text="Checking…", icon="TIME")
    characters = characters_of(context)
    column = layout.column(align=True)
    for finding in doctor.findings():
        icon = "CHECKMARK" if finding.good else "ERROR"
        wrapped_label(column, f"{finding.subject}: {finding.finding}", characters, icon=icon)
        if not finding.good and finding.hint:
            wrapped_label(column, finding.hint, characters, icon="BLANK1")


def draw_worker_missing(layout: Any, characters: int) -> None:
    """Say in a panel that jobs have nothing to run in, and lead to where that changes."""
    if worker_setup.worker_ready():
        return
    box = layout.box()
    text = "Setting up the worker…" if worker_setup.is_busy() else "No worker is set up yet."
    wrapped_label(box, text, characters - 4, icon="TIME" if worker_setup.is_busy() else "ERROR")
    box.operator("gwrap.open_preferences", text="Set Up Worker…", icon="PREFERENCES")

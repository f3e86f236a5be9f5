# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the worker's set-up: in the preferences, and one line in the panel."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.jobs.install import SetupTask
from ..core.worker.environment import EXTRAS, Extra
from ..ops import worker_setup
from ..ops.addon import tr
from ..ops.worker_setup import state
from .panel_base import characters_of, wrapped_label


def draw_setup(layout: Any, context: Any) -> None:
    """Draw state, progress and buttons of the worker's environment."""
    worker_setup.search_pythons()
    characters = characters_of(context)
    environment = worker_setup.environment()
    if environment.is_ready():
        text, icon = tr("A worker is set up in {folder}", folder=environment.root), "CHECKMARK"
    elif worker_setup.worker_ready():
        text, icon = "Jobs use a Python that was set up by hand", "INFO"
    else:
        text, icon = "No worker is set up yet. Jobs need one: a private Python with torch.", "ERROR"
    wrapped_label(layout, text, characters, icon=icon)
    if state.task is not None:
        _draw_status(layout, characters, state.task)
    row = layout.row()
    row.operator("gwrap.set_up_worker", text="Set Up Worker…", icon="IMPORT")
    row.operator("gwrap.remove_worker", icon="TRASH")
    if environment.is_ready():
        _draw_extras(layout, environment.extras())
    if not bpy.app.online_access:
        text = (
            "Blender may not go online. Turn on Allow Online Access in Preferences, System, "
            "or choose a Wheel Folder, which needs none."
        )
        wrapped_label(layout, text, characters, icon="INTERNET_OFFLINE")


def _draw_extras(layout: Any, installed: tuple[str, ...]) -> None:
    """Draw which optional packages are there, and a button for each of the others."""
    column = layout.column(align=True)
    for extra in EXTRAS:
        if extra.name in installed:
            text = tr("{extra}: installed", extra=tr(extra.title))
            column.label(text=text, icon="CHECKMARK", translate=False)
        else:
            draw_add_extra(column, extra)


def draw_add_extra(layout: Any, extra: Extra) -> None:
    """Draw the button that adds an optional package."""
    text = tr("Add {extra}…", extra=tr(extra.title))
    button: Any = layout.operator("gwrap.add_extra", text=text, icon="ADD")
    button.extra = extra.name


def _draw_status(layout: Any, characters: int, task: SetupTask) -> None:
    status = task.status
    if status.active:
        text = f"{tr(status.stage.capitalize())} · {100 * status.fraction:.0f} %"
        layout.progress(factor=status.fraction, text=text, type="BAR")
        wrapped_label(layout, status.message, characters)
        if not task.removes:
            text = "Cancelling…" if task.is_cancelling else "Cancel"
            layout.operator("gwrap.cancel_setup", text=text, icon="X")
    elif status.state == "DONE":
        text = "The worker is removed" if task.removes else "The worker is ready"
        layout.label(text=tr(text), icon="CHECKMARK", translate=False)
    else:
        icon = "PAUSE" if status.state == "CANCELLED" else "ERROR"
        wrapped_label(layout, f"{status.error} {status.hint}", characters, icon=icon)


def draw_doctor(layout: Any, context: Any) -> None:
    """Draw the doctor's buttons and findings."""
    row = layout.row()
    row.operator("gwrap.check_worker", icon="VIEWZOOM")
    row.operator("gwrap.copy_findings", icon="COPYDOWN")
    if worker_setup.is_busy():
        layout.label(text=tr("Checking…"), icon="TIME", translate=False)
    characters = characters_of(context)
    column = layout.column(align=True)
    for finding in worker_setup.findings():
        icon = "CHECKMARK" if finding.good else "ERROR"
        wrapped_label(column, f"{finding.subject}: {finding.finding}", characters, icon=icon)
        if not finding.good and finding.hint:
            wrapped_label(column, finding.hint, characters, icon="BLANK1")


def draw_worker_missing(layout: Any, characters: int) -> None:
    """Show in a panel that there is no worker, with a button to the preferences."""
    if worker_setup.worker_ready():
        return
    box = layout.box()
    text = "Setting up the worker…" if state.is_busy else "No worker is set up yet."
    wrapped_label(box, text, characters - 4, icon="TIME" if state.is_busy else "ERROR")
    box.operator("gwrap.open_preferences", text="Set Up Worker…", icon="PREFERENCES")

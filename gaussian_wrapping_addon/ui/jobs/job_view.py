# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the scene's job in the panel that started it: progress, outcome, next step."""

from __future__ import annotations

from typing import Any

import bpy

from ...core.jobs.store.job_folder import JobStatus
from ...ops.common.addon import properties_of
from ...ops.common.translate import tr
from ...ops.jobs import watched_jobs
from ...ops.jobs.panel_state import Stage, stage_of
from ..common.panel_base import Readiness, button
from ..common.text import characters_of, progress_text, wrapped_label
from .live_view import draw_live


def job_readiness(context: bpy.types.Context, command: str) -> Readiness | None:
    """Return the header text of the scene's job; None if it is another panel's, or done."""
    properties = properties_of(context.scene)
    if properties.job_command != command or not properties.job_folder:
        return None
    status = watched_jobs.status_of(properties.job_folder)
    if status is None:
        gone = watched_jobs.is_gone(properties.job_folder)
        return Readiness("Job is gone" if gone else "Not open", "QUESTION")
    if status.active:
        text = "Cancelling" if status.state == "CANCELLING" else f"{100 * status.fraction:.0f} %"
        return Readiness(text, "SORTTIME")
    if status.state == "CANCELLED":
        return Readiness("Cancelled", "PAUSE")
    return Readiness("Failed", "CANCEL") if status.state in ("FAILED", "LOST") else None


def draw_job(layout: Any, context: bpy.types.Context, command: str) -> bool:
    """Draw the scene's job in its panel; return whether it is running."""
    properties = properties_of(context.scene)
    if properties.job_command != command or not properties.job_folder:
        return False
    status = watched_jobs.status_of(properties.job_folder)
    characters = characters_of(context)
    if status is None and watched_jobs.is_gone(properties.job_folder):
        text = "The folder of this file's job is gone. Find it, or start anew with Wrap Scene."
        wrapped_label(layout, text, characters, icon="QUESTION")
        button(layout, context, "gwrap.find_job", icon="FILE_FOLDER")
        return False
    if status is None:
        text = "This file has a job that is not open here. Resume it, or find its folder."
        wrapped_label(layout, text, characters, icon="QUESTION")
        button(layout, context, "gwrap.resume_job", icon="PLAY")
        button(layout, context, "gwrap.find_job", icon="FILE_FOLDER")
        return False
    if status.active:
        _draw_running(layout, context, status)
        return True
    _draw_ended(layout, context, status)
    return False


def _draw_running(layout: Any, context: bpy.types.Context, status: JobStatus) -> None:
    layout.progress(
        factor=min(max(status.fraction, 0.0), 1.0),
        text=progress_text(status.stage, status.fraction, status.seconds_left),
        type="BAR",
    )
    cancelling = status.state == "CANCELLING"
    column = layout.column()
    column.enabled = not cancelling
    text = "Cancelling…" if cancelling else "Cancel"
    button(column, context, "gwrap.cancel_job", text=text, icon="X")
    live = draw_live(layout, properties_of(context.scene), status)
    if status.message and not live and not cancelling:
        message = status.message[:1].upper() + status.message[1:]
        wrapped_label(layout, message, characters_of(context))


def _draw_ended(layout: Any, context: bpy.types.Context, status: JobStatus) -> None:
    characters = characters_of(context)
    if status.state == "CANCELLED":
        share = f"{100 * status.fraction:.0f} %"
        text = f"{tr('Cancelled at {share}.', share=share)} {tr(status.hint)}"
        wrapped_label(layout, text, characters, icon="PAUSE")
    elif status.state != "DONE" or status.put_back:
        box = layout.box()
        error = box.column()
        error.alert = True
        words = status.error or "The job has failed."
        wrapped_label(error, words, characters - 4, icon="ERROR")
        if status.hint:
            wrapped_label(box, status.hint, characters - 4, icon="BLANK1")
    stage = stage_of(context)
    if stage is Stage.STOPPED:
        button(layout, context, "gwrap.resume_job", icon="PLAY")
    elif stage is Stage.WAITING:
        text = "Finished. Leave Edit Mode to see the result."
        wrapped_label(layout, text, characters, icon="INFO")
        button(layout, context, "object.mode_set", text="Leave Edit Mode").mode = "OBJECT"
    elif stage is Stage.IMPORTABLE:
        wrapped_label(layout, "Finished. The scene does not show the result yet.", characters)
        operator = button(
            layout, context, "gwrap.import_result", text="Import Finished Result", icon="IMPORT"
        )
        operator.directory = status.result

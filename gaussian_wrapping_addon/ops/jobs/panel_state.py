# SPDX-License-Identifier: GPL-3.0-or-later
"""Stage of a scene and the button of the next step; reads no file, for panels and polls."""

from __future__ import annotations

import enum
from typing import Final

import bpy

from ..common import tags
from ..common.addon import properties_of
from . import watched_jobs


class Stage(enum.Enum):
    """Stage of a scene's work, as the tab shows it."""

    NO_DATA = "no data"
    BAD_DATA = "the check found errors"
    READY = "photos are chosen, nothing is made of them yet"
    RUNNING = "a job runs"
    STOPPED = "a job was cancelled or has failed"
    NOT_OPEN = "the file names a job that is not watched"
    GONE = "the file names a job whose folder is not there any more"
    WAITING = "finished, but Blender is in a mode in which nothing can be imported"
    IMPORTABLE = "finished, but the scene does not show it"
    FINISHED = "the scene shows a result"


PRIMARY: Final = {
    Stage.NO_DATA: "gwrap.choose_input",
    Stage.BAD_DATA: "gwrap.choose_input",
    Stage.READY: "gwrap.wrap_scene",
    Stage.RUNNING: "gwrap.cancel_job",
    Stage.STOPPED: "gwrap.resume_job",
    Stage.NOT_OPEN: "gwrap.resume_job",
    Stage.GONE: "gwrap.find_job",
    Stage.WAITING: "object.mode_set",
    Stage.IMPORTABLE: "gwrap.import_result",
    Stage.FINISHED: "gwrap.mesh_region",
}
"""The one large button of each stage."""


def stage_of(context: bpy.types.Context) -> Stage:
    """Return the stage of the scene."""
    scene = context.scene
    properties = properties_of(scene)
    frame = tags.current_frame(scene, context.view_layer.objects.active)
    if properties.job_folder:
        status = watched_jobs.status_of(properties.job_folder)
        if status is None:
            return Stage.GONE if watched_jobs.is_gone(properties.job_folder) else Stage.NOT_OPEN
        if status.active:
            return Stage.RUNNING
        if status.state != "DONE":
            return Stage.STOPPED
        if watched_jobs.waits_for_object_mode(properties.job_folder):
            return Stage.WAITING
        if watched_jobs.result_to_import(scene):
            return Stage.IMPORTABLE
        if frame is not None:
            return Stage.FINISHED
    elif frame is not None and not properties.source:
        return Stage.FINISHED
    if not properties.source:
        return Stage.NO_DATA
    return Stage.BAD_DATA if has_errors(scene) else Stage.READY


def primary_of(context: bpy.types.Context) -> str:
    """Return the operator that is the next step."""
    return PRIMARY[stage_of(context)]


def is_checked(scene: bpy.types.Scene) -> bool:
    """Return whether the stored findings are those of the chosen input."""
    properties = properties_of(scene)
    return bool(properties.source) and properties.checked_source == properties.source


def has_errors(scene: bpy.types.Scene) -> bool:
    """Return whether the check found errors that prevent loading the input."""
    return is_checked(scene) and any(f.severity == "error" for f in properties_of(scene).findings)

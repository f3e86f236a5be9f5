# SPDX-License-Identifier: GPL-3.0-or-later
"""Poll conditions and the confirmation shared by operators on jobs."""

from pathlib import Path

import bpy

from ..common import known_jobs, tags
from ..common.addon import properties_of
from ..common.error_reporting import OperatorResult, ReportsErrors
from ..worker import worker_setup
from . import watched_jobs


def no_job_runs(cls: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """Return whether no job runs in the scene; else set the poll message."""
    if watched_jobs.is_running(properties_of(context.scene).job_folder):
        cls.poll_message_set("A job is running; cancel it or wait for it")
        return False
    return True


def has_worker(cls: type[bpy.types.Operator]) -> bool:
    """Return whether jobs have a Python to run in; else set the poll message."""
    problem = worker_setup.worker_problem()
    if problem:
        cls.poll_message_set(problem)
    return not problem


def selected_regions(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected region objects, the active one first; else the result's only region."""
    active = context.view_layer.objects.active
    things = [t for t in context.selected_objects if tags.kind_of(t) == "region"]
    frame = None if things else tags.current_frame(context.scene, active)
    if frame is not None:
        own = [t for t in frame.children if tags.kind_of(t) == "region"]
        things = own if len(own) == 1 else []
    return sorted(things, key=lambda t: (t != active, t.name))


def chosen_regions(context: bpy.types.Context, *, checked: bool) -> list[bpy.types.Object]:
    """Return the checked regions of the scene by name, or the selected ones."""
    if not checked:
        return selected_regions(context)
    things = tags.objects_of_kind(context.scene, "region")
    return sorted((t for t in things if properties_of(t).checked), key=lambda t: t.name)


class ConfirmsFolder(ReportsErrors):
    """Mixin: confirm a job folder known from the open file alone, which may come from elsewhere."""

    def folder(self, context: bpy.types.Context) -> Path | None:
        """Return the folder that the operator would use."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for confirmation if the folder is unknown on this machine."""
        folder = self.folder(context)
        if folder is None or known_jobs.is_trusted(folder):
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self,
            event,
            title="Use This Job Folder?",
            message=f"The file names a job folder not yet used on this computer: {folder}",
            confirm_text="Use Folder",
        )

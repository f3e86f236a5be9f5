# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the preferences page that set up, repair and remove the worker."""

import textwrap
from typing import Any, Final

import bpy
from bpy.props import EnumProperty, StringProperty

from ..core.errors import WrapError
from ..core.setup.commands import Step, all_steps
from ..core.worker_requirements import read_requirements, requirements_file
from . import worker_setup
from .reporting import ReportsErrors

_LINE_CHARACTERS: Final = 84
_DIALOG_PX: Final = 600
_items: dict[str, list[tuple[str, str, str]]] = {}
"""Blender keeps no reference to the texts of an enum."""


def wheel_folder(context: bpy.types.Context) -> str:
    """Return the wheel folder of the preferences; empty where there are none."""
    addon = context.preferences.addons.get(__package__.rpartition(".")[0])
    preferences = addon.preferences if addon is not None else None
    return str(preferences.wheel_folder) if preferences is not None else ""


def may_install(cls: type, context: bpy.types.Context) -> bool:
    """Tell whether packages can be had; the tooltip says why a button is grey."""
    if worker_setup.is_busy():
        cls.poll_message_set("A set-up is running; cancel it or wait for it")  # type: ignore[attr-defined]
        return False
    if not wheel_folder(context) and not bpy.app.online_access:
        cls.poll_message_set(  # type: ignore[attr-defined]
            "Blender may not go online: turn on Allow Online Access in Preferences, System, "
            "or choose a Wheel Folder"
        )
        return False
    return True


def _python_items(_self: Any, _context: Any) -> list[tuple[str, str, str]]:
    found = []
    for python in worker_setup.pythons():
        notes = [] if python.has_wheels else ["some packages may have no wheels for it"]
        notes += ["Blender's own; it stays as it is"] if python.is_own else []
        if not python.can_install:
            notes.append("has neither venv nor pip")
        elif not python.has_venv:
            notes.append("has no venv: packages go into a folder")
        words = f" ({', '.join(notes)})" if notes else ""
        found.append((python.path, f"{python.version_text}  {python.path}{words}", python.path))
    _items["python"] = found or [("", "None found", "No Python 3.11 or newer was found")]
    return _items["python"]


def _torch_items(_self: Any, _context: Any) -> list[tuple[str, str, str]]:
    found = [
        ("cpu", "Processor (Default)", "The small build; what jobs use today on every system"),
    ]
    if worker_setup.has_cuda():
        found.append(("cuda", "NVIDIA GPU (CUDA)", "Several GiB more; an NVIDIA driver was found"))
    found.append(
        ("index", "As in pip's Own Index",
         "For mirrors. On Linux pip's index has the CUDA build, elsewhere the processor's"),
    )  # fmt: skip
    _items["torch"] = found
    return found


def commands_of(context: bpy.types.Context, python: str, torch: str) -> list[Step]:
    """Return the commands that a set-up with these choices runs.

    Raises
    ------
    WrapError
        The Python or the choice cannot be used.
    """
    request = worker_setup.request_for(python, torch, wheel_folder(context))
    found = next((p for p in worker_setup.pythons() if p.path == python), None)
    if found is None:
        return []
    return all_steps(request, found, read_requirements(requirements_file()))


class GWRAP_OT_set_up_worker(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.set_up_worker"
    bl_label = "Set Up Worker"
    bl_description = (
        "Make a private environment with torch and the other packages that jobs need; "
        "shows the commands first and changes nothing in Blender"
    )

    python: EnumProperty(  # type: ignore[valid-type]
        name="Python", description="Python that the environment is made from", items=_python_items
    )
    torch: EnumProperty(  # type: ignore[valid-type]
        name="Torch", description="Which build of torch to install", items=_torch_items
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not may_install(cls, context):
            return False
        if worker_setup.is_searching():
            worker_setup.look_around()
            cls.poll_message_set("Looking for Pythons")
            return False
        if not worker_setup.pythons():
            cls.poll_message_set("No Python 3.11 or newer was found: install one from python.org")
            return False
        return True

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=_DIALOG_PX)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.prop(self, "python")
        layout.prop(self, "torch")
        layout.label(text="These commands will run, and nothing else:")
        column = layout.box().column(align=True)
        column.scale_y = 0.8
        try:
            steps = commands_of(context, self.python, self.torch)
        except WrapError as error:
            for line in textwrap.wrap(str(error), _LINE_CHARACTERS):
                column.label(text=line, icon="ERROR", translate=False)
            return
        for step in steps:
            for line in textwrap.wrap(
                step.line, _LINE_CHARACTERS, subsequent_indent="      ", break_on_hyphens=False
            ):
                column.label(text=line, translate=False)
        row = layout.row()
        copy = row.operator("gwrap.copy_setup_commands", icon="COPYDOWN")
        copy.python, copy.torch = self.python, self.torch
        layout.label(
            text="About 2 GiB on the disk; several minutes. Blender stays free meanwhile"
            if self.torch == "cpu"
            else "Up to 10 GiB on the disk; many minutes. Blender stays free meanwhile",
            icon="INFO",
        )

    def work(self, context: bpy.types.Context) -> set[str]:
        python = self.python or worker_setup.pythons()[0].path
        request = worker_setup.request_for(python, self.torch or "cpu", wheel_folder(context))
        worker_setup.start(request)
        return {"FINISHED"}


class GWRAP_OT_copy_setup_commands(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.copy_setup_commands"
    bl_label = "Copy Commands"
    bl_description = "Copy the commands, to run them by hand or to ask somebody about them"

    python: StringProperty(options={"SKIP_SAVE"})  # type: ignore[valid-type]
    torch: StringProperty(default="cpu", options={"SKIP_SAVE"})  # type: ignore[valid-type]

    def work(self, context: bpy.types.Context) -> set[str]:
        steps = commands_of(context, self.python, self.torch)
        context.window_manager.clipboard = "\n".join(step.line for step in steps)
        return {"FINISHED"}


class GWRAP_OT_repair_worker(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.repair_worker"
    bl_label = "Repair"
    bl_description = (
        "Look at every package of the worker and install again what is missing or broken"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not worker_setup.environment().is_ours():
            cls.poll_message_set("No worker has been set up here")
            return False
        return may_install(cls, context)

    def work(self, context: bpy.types.Context) -> set[str]:
        worker_setup.repair(wheel_folder(context))
        return {"FINISHED"}


class GWRAP_OT_remove_worker(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.remove_worker"
    bl_label = "Remove"
    bl_description = "Delete the worker's environment, which this add-on has made, and nothing else"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if worker_setup.is_busy():
            cls.poll_message_set("A set-up is running; cancel it or wait for it")
            return False
        if not worker_setup.environment().is_ours():
            cls.poll_message_set("No worker has been set up here")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(self, event)

    def work(self, _context: bpy.types.Context) -> set[str]:
        worker_setup.start_removing()
        return {"FINISHED"}


class GWRAP_OT_cancel_setup(bpy.types.Operator):
    bl_idname = "gwrap.cancel_setup"
    bl_label = "Cancel"
    bl_description = "Stop the set-up; pressing Set Up Worker again goes on with it"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if not worker_setup.is_busy():
            cls.poll_message_set("No set-up is running")
            return False
        if worker_setup.is_cancelling():
            cls.poll_message_set("The set-up is stopping")
            return False
        return True

    def execute(self, _context: bpy.types.Context) -> set[str]:
        worker_setup.cancel()
        return {"FINISHED"}


class GWRAP_OT_open_preferences(bpy.types.Operator):
    bl_idname = "gwrap.open_preferences"
    bl_label = "Open Preferences"
    bl_description = "Show this add-on's preferences, where the worker is set up"

    def execute(self, _context: bpy.types.Context) -> set[str]:
        package = __package__.rpartition(".")[0]
        try:
            return bpy.ops.preferences.addon_show(module=package)
        except RuntimeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}


CLASSES: Final = (
    GWRAP_OT_set_up_worker,
    GWRAP_OT_copy_setup_commands,
    GWRAP_OT_repair_worker,
    GWRAP_OT_remove_worker,
    GWRAP_OT_cancel_setup,
    GWRAP_OT_open_preferences,
)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the preferences page that set up and remove the worker."""

import textwrap
from collections.abc import Iterable
from typing import Any, Final

import bpy
from bpy.props import EnumProperty, StringProperty

from ...core.errors import WrapError
from ...core.processes.worker_extras import EXTRAS, Extra, extra_named
from ...core.setup.commands import CUDA, CUDA_BRINGS, all_commands, as_line
from ..common.addon import addon_package, addon_preferences
from ..common.error_reporting import OperatorResult, ReportsErrors
from ..common.translate import tr
from . import worker_setup
from .worker_setup import state

_LINE_CHARACTERS: Final = 84
_DIALOG_PX: Final = 600
_items: dict[str, list[tuple[str, str, str]]] = {}
"""Blender keeps no reference to the texts of an enum."""


def wheel_folder(context: bpy.types.Context) -> str:
    """Return the wheel folder of the preferences; empty where there are none."""
    preferences = addon_preferences(context)
    return str(preferences.wheel_folder) if preferences is not None else ""


def _python_items(_self: Any, _context: Any) -> list[tuple[str, str, str]]:
    found = []
    for python in state.pythons or ():
        notes = [] if python.has_wheels else ["some packages may have no wheels for it"]
        if not python.has_venv:
            lacks = "has no venv: packages go into a folder"
            notes.append(lacks if python.can_install else "has neither venv nor pip")
        words = f" ({', '.join(notes)})" if notes else ""
        found.append((python.path, f"{python.version_text}  {python.path}{words}", python.path))
    _items["python"] = found or [("", "None found", "No Python 3.11 or newer was found")]
    return _items["python"]


def _torch_items(_self: Any, _context: Any) -> list[tuple[str, str, str]]:
    cuda = ("cuda", "NVIDIA GPU (CUDA)", CUDA_BRINGS)
    _items["torch"] = [
        ("cpu", "Processor (Default)", "The small build, for every system; jobs use the processor"),
        *([cuda] if state.has_cuda else []),
        ("index", "From pip's Index",
         "For mirrors. On Linux pip's index has the CUDA build, elsewhere the processor's"),
    ]  # fmt: skip
    return _items["torch"]


def _extra_items() -> list[tuple[str, str, str]]:
    return [(extra.name, extra.title, _reads(extra)) for extra in EXTRAS]


def _reads(extra: Extra) -> str:
    """Return what an extra is for, as the table of translations has it."""
    return f"For {extra.purpose}"


def command_lines(
    context: bpy.types.Context, path: str, torch: str, extras: Iterable[str] = ()
) -> list[str]:
    """Return the commands that a set-up with these choices runs.

    Raises
    ------
    UsageError
        The Python or the choice cannot be used.
    """
    request = worker_setup.request_for(path, torch, wheel_folder(context), extras)
    found = [p for p in state.pythons or () if p.path == path]
    return [as_line(command) for p in found for command in all_commands(request, p)]


def _why_not_now(context: bpy.types.Context) -> str:
    """Return why nothing can be installed now; ``""`` if it can."""
    if state.is_busy:
        return "A set-up is running; cancel it or wait for it"
    if not wheel_folder(context) and not bpy.app.online_access:
        return (
            "Blender may not go online: turn on Allow Online Access in Preferences, System, "
            "or choose a Wheel Folder"
        )
    return ""


def _draw_commands(layout: Any, lines: list[str]) -> None:
    """Show commands before they run, with a button that copies them."""
    layout.label(text=tr("These commands will run, and nothing else:"), translate=False)
    column = layout.box().column(align=True)
    column.scale_y = 0.8
    for line in lines:
        for part in textwrap.wrap(
            line, _LINE_CHARACTERS, subsequent_indent="      ", break_on_hyphens=False
        ):
            column.label(text=part, translate=False)
    copy: Any = layout.row().operator("gwrap.copy_setup_commands", icon="COPYDOWN")
    copy.text = "\n".join(lines)


class GWRAP_OT_set_up_worker(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.set_up_worker"
    bl_label = "Set Up Worker"
    bl_description = (
        "Create a private environment with torch and the other packages that jobs need, replacing "
        "an earlier one; shows the commands first and changes nothing in Blender"
    )

    python: EnumProperty(  # type: ignore[valid-type]
        name="Python", description="Python that the environment is made from", items=_python_items
    )
    torch: EnumProperty(  # type: ignore[valid-type]
        name="Torch", description="Which build of torch to install", items=_torch_items
    )
    extras: EnumProperty(  # type: ignore[valid-type]
        name="Also Install", description="Optional packages of some MiB each",
        items=_extra_items(), options={"ENUM_FLAG"}, default=set(),
    )  # fmt: skip

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = _why_not_now(context)
        if not reason and state.pythons is None:
            worker_setup.search_pythons()
            reason = "Searching for Python installations"
        elif not reason and not state.pythons:
            reason = "No Python 3.11 or newer was found: install one from python.org"
        cls.poll_message_set(reason)
        return not reason

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        known = {extra.name for extra in EXTRAS}
        self.extras = known.intersection(worker_setup.environment().extras())
        return context.window_manager.invoke_props_dialog(self, width=_DIALOG_PX)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.prop(self, "python")
        layout.prop(self, "torch")
        layout.row().prop(self, "extras")
        try:
            lines = command_lines(context, self.python, self.torch, self.extras)
        except WrapError as error:
            lines = [str(error)]
        _draw_commands(layout, lines)
        if self.torch == CUDA:
            layout.label(text=tr(CUDA_BRINGS), icon="MEMORY", translate=False)
        text = (
            tr("About 2 GiB on the disk; several minutes. Blender stays usable meanwhile")
            if self.torch == "cpu"
            else tr("Up to 10 GiB on the disk; many minutes. Blender stays usable meanwhile")
        )
        layout.label(text=text, icon="INFO", translate=False)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        found = state.pythons or []
        python = self.python or found[0].path
        request = worker_setup.request_for(
            python, self.torch or "cpu", wheel_folder(context), self.extras
        )
        worker_setup.start(request)
        return {"FINISHED"}


class GWRAP_OT_add_extra(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.add_extra"
    bl_label = "Add to Worker"
    bl_description = (
        "Add an optional package to the worker that is set up, within seconds; shows the command "
        "first and changes nothing else"
    )

    extra: EnumProperty(name="Package", items=_extra_items())  # type: ignore[valid-type]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = _why_not_now(context)
        if not reason and not worker_setup.environment().is_ready():
            reason = "Set up the worker first"
        cls.poll_message_set(reason)
        return not reason

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        return context.window_manager.invoke_props_dialog(self, width=_DIALOG_PX)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.label(text=tr(_reads(extra_named(self.extra))), translate=False)
        try:
            lines = worker_setup.lines_that_add(self.extra, wheel_folder(context))
        except WrapError as error:
            lines = [str(error)]
        _draw_commands(layout, lines)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        request = worker_setup.request_for(
            "", "cpu", wheel_folder(context), (self.extra,), adds=True
        )
        worker_setup.start(request)
        return {"FINISHED"}


class GWRAP_OT_copy_setup_commands(bpy.types.Operator):
    bl_idname = "gwrap.copy_setup_commands"
    bl_label = "Copy Commands"
    bl_description = "Copy the commands, to run them by hand or to ask for help"

    text: StringProperty(options={"SKIP_SAVE"})  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        context.window_manager.clipboard = self.text
        return {"FINISHED"}


class GWRAP_OT_remove_worker(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.remove_worker"
    bl_label = "Remove"
    bl_description = "Delete the worker's environment that this add-on has made, and nothing else"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        reason = "" if worker_setup.environment().is_ours() else "No worker has been set up here"
        reason = "A set-up is running; cancel it or wait for it" if state.is_busy else reason
        cls.poll_message_set(reason)
        return not reason

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        return context.window_manager.invoke_confirm(self, event)

    def work(self, _context: bpy.types.Context) -> OperatorResult:
        worker_setup.start(worker_setup.request_for("", "cpu", ""), removes=True)
        return {"FINISHED"}


class GWRAP_OT_cancel_setup(bpy.types.Operator):
    bl_idname = "gwrap.cancel_setup"
    bl_label = "Cancel"
    bl_description = "Stop the set-up and delete its unfinished environment"

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        reason = "" if state.is_busy else "No set-up is running"
        if state.is_busy and state.task is not None and state.task.is_cancelling:
            reason = "The set-up is being cancelled"
        cls.poll_message_set(reason)
        return not reason

    def execute(self, _context: bpy.types.Context) -> OperatorResult:
        worker_setup.cancel()
        return {"FINISHED"}


class GWRAP_OT_open_preferences(bpy.types.Operator):
    bl_idname = "gwrap.open_preferences"
    bl_label = "Open Preferences"
    bl_description = "Show this add-on's preferences, where the worker is set up"

    def execute(self, _context: bpy.types.Context) -> OperatorResult:
        package = addon_package()
        try:
            return bpy.ops.preferences.addon_show(module=package)
        except RuntimeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}


CLASSES: Final = (
    GWRAP_OT_set_up_worker,
    GWRAP_OT_add_extra,
    GWRAP_OT_copy_setup_commands,
    GWRAP_OT_remove_worker,
    GWRAP_OT_cancel_setup,
    GWRAP_OT_open_preferences,
)

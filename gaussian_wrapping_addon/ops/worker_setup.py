# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python that jobs run in: preference, check, set-up."""

import contextlib
import logging
import os
import sys
import textwrap
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import bpy
from bpy.props import EnumProperty, StringProperty

from ..core.errors import UsageError, WrapError
from ..core.jobs.client import PYTHON_VARIABLE, worker_python
from ..core.jobs.commands.doctor import Diagnosis, find_and_diagnose
from ..core.jobs.install import (
    CUDA,
    CUDA_BRINGS,
    OLDEST,
    FoundPython,
    SetupRequest,
    SetupTask,
    all_commands,
    as_line,
    cuda_present,
    find_pythons,
)
from ..core.settings import declared
from ..core.worker import environment as worker_environment
from ..core.worker.environment import (
    EXTRAS,
    Extra,
    WorkerEnvironment,
    extra_named,
    read_extra_names,
    requirements_file,
)
from . import background
from .addon import OperatorResult, ReportsErrors, addon_package, addon_preferences, redraw, tr
from .background import Lane

# -- Settings of the worker in the add-on's preferences -------------------------------------------


@dataclass(frozen=True)
class WorkerChoice:
    """Settings of the worker in the add-on's preferences; never read from a .blend file."""

    python: str = ""
    threads: int = 0
    keep_running: bool = False
    device: str = "auto"


def worker_choice(context: bpy.types.Context) -> WorkerChoice:
    """Read the add-on's preferences; defaults if it is not enabled as an add-on."""
    preferences = addon_preferences(context)
    if preferences is None:
        return WorkerChoice()
    python = bpy.path.abspath(preferences.worker_python) if preferences.worker_python else ""
    device = declared("device").from_panel(preferences.device)
    return WorkerChoice(python, preferences.threads, preferences.keep_running, device)


# -- Check the worker's Python in the background --------------------------------------------------


_checks = Lane()
_findings: list[Diagnosis] = []


def findings() -> tuple[Diagnosis, ...]:
    """Return the findings of the last check."""
    return tuple(_findings)


def is_busy() -> bool:
    """Return whether a check is running."""
    return _checks.busy


def as_text() -> str:
    """Return the findings for a bug report, with the home folder masked."""
    lines = (
        f"good {f.subject}: {f.finding}" if f.good else f"BAD  {f.subject}: {f.finding} {f.hint}"
        for f in _findings
    )
    return "\n".join(lines).replace(str(Path.home()), "~")


def start(preference: str) -> None:
    """Start a check of the interpreter that jobs would use."""
    stop()
    _findings.clear()
    _checks.submit(lambda: find_and_diagnose(preference), _keep, failed=_keep_failure)


def _keep(found: list[Diagnosis]) -> None:
    _findings[:] = found
    redraw("PREFERENCES")


def _keep_failure(error: Exception) -> None:
    _keep([Diagnosis("Python", False, f"{type(error).__name__}: {error}", "")])


def stop() -> None:
    """Cancel a running check."""
    _checks.cancel()


# -- Operators that check the worker's Python and copy what was found -----------------------------


class GWRAP_OT_check_worker(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.check_worker"
    bl_label = "Check Worker"
    bl_description = "Check in the background that the worker's Python has all that jobs need"

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        return "The check is running; it takes seconds" if is_busy() else ""

    def work(self, context: bpy.types.Context) -> None:
        start(worker_choice(context).python)


class GWRAP_OT_copy_findings(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.copy_findings"
    bl_label = "Copy Findings"
    bl_description = "Copy the findings about the worker, to paste them into a bug report"

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        return "" if findings() else "Press Check Worker first"

    def work(self, context: bpy.types.Context) -> None:
        context.window_manager.clipboard = as_text()


# -- State of the worker's environment: readiness, search for Pythons, set-up and removal ---------
#
# Nothing here waits: Pythons are searched, set-ups and removals run in the background
# (``ops/background.py``). The state outlives the preferences' window.


_logger = logging.getLogger(__name__)

READY_FOR_S = 2.0
"""Lifetime of a cached result of :func:`worker_problem`."""


@dataclass
class State:
    """Findings and running work of this session; other modules only read it."""

    pythons: list[FoundPython] | None = None
    """None until the search has ended."""
    has_cuda: bool = False
    has_searched: bool = False
    """Whether a search for Pythons has begun."""
    task: SetupTask | None = None
    is_busy: bool = False
    """Whether the end of the task is still to be handled."""
    problem: str = ""
    ready_key: tuple[str, str] | None = None
    ready_s: float = -1e9


state = State()
_searches, _setups, _endings = Lane(), Lane(), Lane()


def environment() -> WorkerEnvironment:
    """Return the environment of this add-on in this Blender; it need not exist."""
    package = addon_package()
    with contextlib.suppress(ValueError, OSError):  # ValueError: not installed as an extension
        return WorkerEnvironment(Path(bpy.utils.extension_path_user(package, path="worker")))
    return WorkerEnvironment(worker_environment.default_root())


def worker_ready() -> bool:
    """Return whether jobs have a Python to run in; cheap enough for every redraw."""
    return not worker_problem()


def worker_problem() -> str:
    """Return why jobs have no Python to run in, and the next step; ``""`` if they have one."""
    preference = worker_choice(bpy.context).python
    key = (preference, os.environ.get(PYTHON_VARIABLE, ""))
    now_s = time.monotonic()
    if key != state.ready_key or now_s - state.ready_s > READY_FOR_S:
        try:
            worker_python(preference)
            state.problem = ""
        except WrapError as error:
            state.problem = str(error)
        state.ready_key, state.ready_s = key, now_s
    return state.problem


def forget_problem() -> None:
    """Discard the cached result of :func:`worker_problem`."""
    state.ready_s = -1e9


def search_pythons() -> None:
    """Search for Pythons once, in the background; drawing may call this."""
    if not state.has_searched:
        state.has_searched = True
        own = sys.executable
        _searches.submit(
            lambda: (cuda_present(), find_pythons(own)), _keep_search, failed=_search_failed
        )
    if not state.is_busy and state.task is not None and state.task.status.active:
        state.is_busy = True  # it went on while the add-on was disabled
        background.watch(tick)


def _search_failed(error: Exception) -> None:
    _logger.error("The search for Python installations failed.", exc_info=error)
    _keep_search((False, []))


def _keep_search(found: tuple[bool, list[FoundPython]]) -> None:
    state.has_cuda, state.pythons = found
    redraw("PREFERENCES", "VIEW_3D")


def request_for(
    python: str, torch: str, wheel_folder: str, extras: Iterable[str] = (), *, adds: bool = False
) -> SetupRequest:
    """Return the request of a set-up with these choices, or of adding extras to the present one.

    Raises UsageError: the add-on's list of packages is missing.
    """
    folder = bpy.path.abspath(wheel_folder) if wheel_folder else ""
    root, requirements = str(environment().root), str(requirements_file())
    names = read_extra_names(",".join(extras))
    return SetupRequest(root, python, requirements, torch, folder, names, adds)


def lines_that_add(extra: str, wheel_folder: str) -> list[str]:
    """Return the commands that add an extra to the present environment; starts no process.

    Raises UsageError: there is no environment to add to.
    """
    path = str(environment().marker().get("python", ""))
    unknown = FoundPython(path, (*OLDEST, 0))
    python = next((p for p in state.pythons or () if p.path == path), unknown)
    request = request_for(path, "cpu", wheel_folder, (extra,), adds=True)
    return [as_line(command) for command in all_commands(request, python)]


def start_setup(request: SetupRequest, *, removes: bool = False) -> None:
    """Start a set-up or a removal. Raises UsageError: one is running."""
    if state.task is not None and state.task.status.active:
        raise UsageError("A set-up is running.", "Cancel it or wait for it.")
    state.task, state.is_busy = SetupTask(request, removes=removes), True
    _setups.submit(state.task.run)
    _endings.start()  # now: cancelling starts no thread
    background.watch(tick)


def cancel() -> None:
    """Cancel a set-up; its process is ended in the background."""
    if state.task is not None and state.task.status.active:
        state.task.is_cancelling = True
        _endings.submit(state.task.cancel)


def tick() -> bool:
    """Redraw, and handle the end of a set-up; return whether one is still running."""
    if state.is_busy and state.task is not None and not state.task.status.active:
        state.is_busy = False
        forget_problem()
        if state.task.status.state == "DONE" and not state.task.removes:
            with contextlib.suppress(WrapError):
                start(worker_choice(bpy.context).python)
    redraw("PREFERENCES", "VIEW_3D")
    return state.is_busy


def stop_setup() -> None:
    """Cancel a set-up and a search."""
    cancel()
    _searches.cancel()
    state.has_searched = state.pythons is not None
    state.is_busy = False
    forget_problem()


# -- Operators of the preferences page that set up and remove the worker --------------------------


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
    context: bpy.types.Context, path: str, torch: str, extras: Iterable[str]
) -> list[str]:
    """Return the commands that a set-up with these choices runs.

    Raises UsageError: the Python or the choice cannot be used.
    """
    request = request_for(path, torch, wheel_folder(context), extras)
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
    def why_not(cls, context: bpy.types.Context) -> str:
        reason = _why_not_now(context)
        if not reason and state.pythons is None:
            search_pythons()
            return "Searching for Python installations"
        if not reason and not state.pythons:
            return "No Python 3.11 or newer was found: install one from python.org"
        return reason

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        known = {extra.name for extra in EXTRAS}
        self.extras = known.intersection(environment().extras())
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
        text = "Up to 10 GiB on the disk; many minutes. Blender stays usable meanwhile"
        if self.torch == "cpu":
            text = "About 2 GiB on the disk; several minutes. Blender stays usable meanwhile"
        layout.label(text=tr(text), icon="INFO", translate=False)

    def work(self, context: bpy.types.Context) -> None:
        python = self.python or (state.pythons or [])[0].path
        folder = wheel_folder(context)
        start_setup(request_for(python, self.torch or "cpu", folder, self.extras))


class GWRAP_OT_add_extra(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.add_extra"
    bl_label = "Add to Worker"
    bl_description = (
        "Add an optional package to the worker that is set up, within seconds; shows the command "
        "first and changes nothing else"
    )

    extra: EnumProperty(name="Package", items=_extra_items())  # type: ignore[valid-type]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        reason = _why_not_now(context)
        return "Set up the worker first" if not reason and not environment().is_ready() else reason

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        return context.window_manager.invoke_props_dialog(self, width=_DIALOG_PX)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.label(text=tr(_reads(extra_named(self.extra))), translate=False)
        try:
            lines = lines_that_add(self.extra, wheel_folder(context))
        except WrapError as error:
            lines = [str(error)]
        _draw_commands(layout, lines)

    def work(self, context: bpy.types.Context) -> None:
        start_setup(request_for("", "cpu", wheel_folder(context), (self.extra,), adds=True))


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
    def why_not(cls, _context: bpy.types.Context) -> str:
        if state.is_busy:
            return "A set-up is running; cancel it or wait for it"
        return "" if environment().is_ours() else "No worker has been set up here"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        return context.window_manager.invoke_confirm(self, event)

    def work(self, _context: bpy.types.Context) -> None:
        start_setup(request_for("", "cpu", ""), removes=True)


class GWRAP_OT_cancel_setup(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.cancel_setup"
    bl_label = "Cancel"
    bl_description = "Stop the set-up and delete its unfinished environment"

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        if state.is_busy and state.task is not None and state.task.is_cancelling:
            return "The set-up is being cancelled"
        return "" if state.is_busy else "No set-up is running"

    def work(self, _context: bpy.types.Context) -> None:
        cancel()


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
    GWRAP_OT_set_up_worker, GWRAP_OT_add_extra, GWRAP_OT_copy_setup_commands,
    GWRAP_OT_remove_worker, GWRAP_OT_cancel_setup, GWRAP_OT_open_preferences, GWRAP_OT_check_worker,
    GWRAP_OT_copy_findings,
)  # fmt: skip

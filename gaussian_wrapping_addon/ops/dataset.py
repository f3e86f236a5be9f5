# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos chosen and checked."""

import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import bpy
from bpy.props import BoolProperty, StringProperty

from ..core.errors import UsageError, WrapError
from ..core.jobs.client import worker_if_any, worker_python
from ..core.loading.source_kind import WITHOUT_PHOTOS
from ..core.photos.formats import PHOTO_SUFFIXES
from ..core.photos.video import VIDEO_SUFFIXES
from ..core.readers.program_files import CAMERA_FILE_SUFFIXES
from ..core.worker.helper_process import child_command
from . import addon, background, job_timer, panel_settings, training
from .addon import OperatorResult, ReportsErrors, properties_of, redraw, tr
from .background import Child, Lane
from .jobs import why_busy
from .panel_settings import source_of
from .worker_setup import WorkerChoice, worker_choice

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..core.loading.check import Finding


# -- Let the worker look at the photos in the background: blur, exposure, duplicates, coverage ----


MODULE = "jobs.commands.photo_check_command"
DEADLINE_S = 1800.0
MAX_ROWS = 20
MAX_TEXT = 600

_looks = Lane(of_file=True)


def is_busy() -> bool:
    """Return whether the worker is looking at photos."""
    return _looks.busy


def start(scene: bpy.types.Scene, choice: WorkerChoice) -> None:
    """Start to look at a scene's photos; findings are added to those of the check.

    Without a worker nothing is looked at: the panel says that there is none.
    """
    stop()
    try:
        python = worker_python(choice.python)
        request = {"source": str(source_of(scene)), "threads": choice.threads}
    except WrapError:
        return
    command = child_command(MODULE, json.dumps(request), python=python)
    uid, chosen, child = scene.session_uid, properties_of(scene).source, Child()

    def keep(rows: list[dict[str, str]]) -> None:
        scene = addon.scene_of_uid(uid)
        if scene is not None and properties_of(scene).source == chosen:
            for values in rows[:MAX_ROWS]:
                row = properties_of(scene).findings.add()
                for name, text in values.items():
                    setattr(row, name, text[:MAX_TEXT])
        redraw()

    _looks.submit(
        lambda: rows_of(*child.run(command, DEADLINE_S)),
        keep,
        failed=lambda error: keep([_row("warning", f"The photos were not looked at: {error}")]),
        end=child.end,
    )


def rows_of(messages: list[dict[str, Any]], last_words: str = "") -> list[dict[str, str]]:
    """Return the rows for the panel of what the worker wrote.

    Parameters
    ----------
    messages : list of dict
        ``{"finding": {"severity", "message", "hint"}}``, or ``{"error", "hint", "extras"}``.
    last_words : str
        The last line of the worker's standard error, shown if there is nothing else.
    """
    rows = []
    for values in messages:
        finding = values.get("finding")
        if isinstance(finding, dict):
            severity = str(finding.get("severity", "fact"))
            rows.append(_row(severity, str(finding.get("message")), str(finding.get("hint", ""))))
        if values.get("error"):
            extras = values.get("extras")
            names = [str(name) for name in extras] if isinstance(extras, list) else []
            text, hint = str(values["error"]), str(values.get("hint", ""))
            rows.append({**_row("error", text, hint), "extra": ",".join(names)})
    if not messages:
        rows.append(_row("warning", f"The photos were not looked at: {last_words or 'no answer'}."))
    return rows


def _row(severity: str, message: str, hint: str = "") -> dict[str, str]:
    return {"severity": severity, "message": message, "hint": hint}


def stop() -> None:
    """Cancel a look and end its process."""
    _looks.cancel()


# -- Check an input in the background and store the findings in its scene -------------------------


_logger = logging.getLogger(__name__)

_checks = Lane(of_file=True)


def is_checking() -> bool:
    """Return whether a check is running."""
    return _checks.busy


def check_now(scene: bpy.types.Scene, python: str) -> None:
    """Check a scene's input and store the findings; blocks Blender.

    ``python``: the worker's Python in the preferences, which opens videos.
    Raises UsageError: no input is chosen.
    """
    stop_check()
    _keep(scene, _check(scene, python)())


def _check(scene: bpy.types.Scene, python: str) -> "Callable[[], list[Finding]]":
    """Return what checks the present input, for a thread."""
    from ..core.loading.check import check_input

    panoramas = str(properties_of(scene).training.equirectangular).lower()
    source = source_of(scene)
    return lambda: check_input(source, worker=worker_if_any(python), panoramas=panoramas)


def start_check(
    scene: bpy.types.Scene, choice: WorkerChoice | None = None, *, python: str = ""
) -> None:
    """Begin to check a scene's input.

    Parameters
    ----------
    choice : WorkerChoice, optional
        If there are no errors, request an estimate of the training from this worker.
    python : str
        As for :func:`check_now`.

    Raises
    ------
    UsageError
        No input is chosen.
    """
    from ..core.loading.check import Finding

    check = _check(scene, python)
    stop_check()
    _looks.start()  # now: the timer, which starts the look, starts no thread
    background.get_ready()
    if choice is not None:
        training.get_ready()
    looks_with = choice or worker_choice(bpy.context)
    uid, chosen = scene.session_uid, properties_of(scene).source

    def keep(found: "list[Finding]") -> None:
        scene = addon.scene_of_uid(uid)
        if scene is not None and properties_of(scene).source == chosen:
            _keep(scene, found)
            if not panel_settings.has_errors(scene):
                if properties_of(scene).checked_kind not in WITHOUT_PHOTOS:
                    start(scene, looks_with)
                if choice is not None:
                    try:
                        training.start(scene, choice)
                    except WrapError as error:
                        training.answer_with(scene, error)
        redraw()

    def keep_failure(error: Exception) -> None:
        _logger.error("checking %s", chosen, exc_info=error)
        text = f"{type(error).__name__}: {error}"
        keep([Finding("error", text, "See the system console.")])

    _checks.submit(check, keep, failed=keep_failure)


def _keep(scene: bpy.types.Scene, found: "list[Finding]") -> None:
    properties = properties_of(scene)
    properties.findings.clear()
    properties.checked_source = properties.source
    properties.checked_text = ", ".join(f.short for f in found if f.short)
    properties.checked_kind = next((f.kind for f in found if f.kind), "")
    for finding in found:
        row = properties.findings.add()
        row.severity, row.message, row.hint = finding.severity, finding.message, finding.hint


def stop_check() -> None:
    """Cancel a running check."""
    _checks.cancel()
    stop()


# -- Operators that choose the photos and check them ----------------------------------------------


_INPUT_FILES: Final = (".ply", *CAMERA_FILE_SUFFIXES, *VIDEO_SUFFIXES)
"""Files that are inputs themselves; for any other file, its folder is the input."""


class GWRAP_OT_choose_input(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.choose_input"
    bl_label = "Choose Photos"
    bl_description = (
        "Choose the folder of the photos, of a COLMAP project or with a transforms.json, a video, "
        "the camera file of another program, or the PLY of a splat; it is checked at once"
    )
    bl_options = {"UNDO"}  # noqa: RUF012 - Blender's convention

    filepath: StringProperty(name="Input", subtype="FILE_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_image: BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_glob: StringProperty(  # type: ignore[valid-type]
        default=";".join(f"*{suffix}" for suffix in (*_INPUT_FILES, *PHOTO_SUFFIXES)),
        options={"HIDDEN"},
    )

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return why_busy(context)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        source = properties_of(context.scene).source
        if source:
            self.filepath = source.rstrip("/\\") + ("" if Path(source).suffix else "/")
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, _context: bpy.types.Context) -> None:
        column = self.layout.column(align=True)
        column.label(text=tr("Open the folder with the photos,"), translate=False)
        column.label(text=tr("or select a video,"), translate=False)
        column.label(text=tr("then press Choose Photos."), translate=False)

    def work(self, context: bpy.types.Context) -> None:
        if not self.filepath:
            raise UsageError("No folder was chosen.", "Open the folder of the photos.")
        path = Path(bpy.path.abspath(self.filepath))
        if path.suffix.lower() not in _INPUT_FILES and not path.is_dir():
            path = path.parent  # a photo was clicked, or a name that does not exist
        if not path.exists():
            raise UsageError(f"{path} does not exist.", "Choose another folder.")
        properties = properties_of(context.scene)
        if properties.source and Path(bpy.path.abspath(properties.source)) != path:
            if properties.output == properties.job_folder:
                properties.output = ""  # it was made for the photos before
            job_timer.detach(context.scene)
        properties.source = str(path)
        training.forget()
        choice = worker_choice(context)
        start_check(context.scene, choice, python=choice.python)


class GWRAP_OT_check_photos(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.check_photos"
    bl_label = "Check Photos"
    bl_description = "Check the photos and camera poses and list problems"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if not properties_of(context.scene).source:
            return "Choose the folder of the photos first"
        return "The check is running; it takes seconds" if is_checking() else ""

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        """Check in a thread: Blender must not wait for a slow disk."""
        try:
            start_check(context.scene, python=worker_choice(context).python)
        except WrapError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def work(self, context: bpy.types.Context) -> None:
        properties = properties_of(context.scene)
        check_now(context.scene, worker_choice(context).python)
        severities = [row.severity for row in properties.findings]
        errors, warnings = severities.count("error"), severities.count("warning")
        self.report(
            {"WARNING"} if errors or warnings else {"INFO"},
            f"Photos checked: {errors} errors, {warnings} warnings",
        )


CLASSES: Final = (GWRAP_OT_choose_input, GWRAP_OT_check_photos)

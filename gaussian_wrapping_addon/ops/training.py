# SPDX-License-Identifier: GPL-3.0-or-later
"""Training estimate, Train More."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Final

import bpy

from ..core.errors import WorkerError, WrapError
from ..core.jobs.client import worker_python
from ..core.jobs.store.job_file import make_job
from ..core.worker.helper_process import child_command
from . import addon, background, jobs, worker_setup
from .addon import ReportsErrors, properties_of, redraw
from .background import Child, Lane
from .jobs import ConfirmsFolder, why_busy
from .panel_settings import choices_key, job_settings, source_of
from .worker_setup import WorkerChoice

# -- Estimate time and memory of a training by the worker, in the background ----------------------


MODULE = "jobs.commands.estimate_command"
DEADLINE_S = 300.0
MAX_LINES = 20
MAX_TEXT = 300
MAX_KNOWN = 20
"""Estimates kept, so that switching back to a preset shows its estimate again."""


@dataclass(frozen=True)
class Estimate:
    """An estimate, ready to draw."""

    lines: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """Warnings, or the reason of a failure."""


_requests = Lane(of_file=True)
_known: dict[tuple[object, ...], Estimate] = {}


def is_busy() -> bool:
    """Return whether an estimate is running."""
    return _requests.busy


def estimate_for(scene: bpy.types.Scene) -> Estimate | None:
    """Return the estimate for the current settings of a scene's panels, or None."""
    return _known.get(choices_key(scene))


def answer_with(scene: bpy.types.Scene, error: WrapError) -> None:
    """Show the reason of a failure in place of an estimate."""
    _keep(choices_key(scene), estimate_of_failure(error))


def _keep(key: tuple[object, ...], estimate: Estimate) -> None:
    _known.pop(key, None)
    _known[key] = estimate
    while len(_known) > MAX_KNOWN:
        del _known[next(iter(_known))]


def forget() -> None:
    """Forget all estimates: photos may have been replaced under the same names."""
    stop()
    _known.clear()


def start(scene: bpy.types.Scene, choice: WorkerChoice) -> None:
    """Start an estimate for a scene's photos and settings.

    Raises WrapError: the source, a choice or the interpreter cannot be used.
    """
    job = make_job("wrap", source_of(scene), job_settings(scene, choice.threads, choice.device))
    command = child_command(
        MODULE, json.dumps(job.to_json(), allow_nan=False), python=worker_python(choice.python)
    )
    stop()
    key, child = choices_key(scene), Child()

    def keep(estimate: Estimate) -> None:
        _keep(key, estimate)
        redraw()

    _requests.submit(
        lambda: estimate_of(*child.run(command, DEADLINE_S)),
        keep,
        failed=lambda error: keep(estimate_of_failure(error)),
        end=child.end,
    )


def estimate_of(messages: list[dict[str, Any]], last_words: str = "") -> Estimate:
    """Convert the child's output into lines for the panel.

    Parameters
    ----------
    messages : list of dict
        ``{"line": text}`` for each line and ``{"warning": text}`` for each warning, or
        ``{"error": text, "hint": text}``.
    last_words : str
        The last line of the child's standard error, reported if there is no other output.

    Raises
    ------
    WorkerError
        There is no output.
    """
    for values in messages:
        if values.get("error"):
            return Estimate((), (str(values["error"]), str(values.get("hint", ""))))
    told = [values for values in messages if values.get("line") or values.get("warning")][
        :MAX_LINES
    ]
    if not told:
        raise WorkerError(
            f"The estimate failed: {last_words or 'the worker wrote nothing'}.",
            "Check the worker in the add-on's preferences.",
        )
    return Estimate(_texts(told, "line"), _texts(told, "warning"))


def _texts(messages: list[dict[str, Any]], kind: str) -> tuple[str, ...]:
    """Return the texts of one kind, as sentences."""
    texts = (str(values[kind])[:MAX_TEXT] for values in messages if values.get(kind))
    return tuple(text[:1].upper() + text[1:] for text in texts)


def estimate_of_failure(error: Exception) -> Estimate:
    """Return what the panel shows if the estimate has failed."""
    if isinstance(error, WrapError):
        return Estimate((), (error.message, error.hint))
    return Estimate((), (f"{type(error).__name__}: {error}",))


def get_ready() -> None:
    """Start the threads of the next estimate ahead of a timer that starts it."""
    _requests.start()
    background.get_ready()


def stop() -> None:
    """Cancel the estimate and end its process."""
    _requests.cancel()


# -- Operators of the sub-panel "Training": estimate, train more, back to the preset's choices ----


class GWRAP_OT_estimate(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.estimate"
    bl_label = "Estimate"
    bl_description = "Estimate the time, memory and disk space that this training needs"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if not properties_of(context.scene).source:
            return "Choose the folder of the photos first"
        return "The estimate is running; it takes seconds" if is_busy() else ""

    def work(self, context: bpy.types.Context) -> None:
        start(context.scene, worker_setup.worker_choice(context))


class GWRAP_OT_train_more(ConfirmsFolder, bpy.types.Operator):
    bl_idname = "gwrap.train_more"
    bl_label = "Train More"
    bl_description = (
        "Continue the finished training for more iterations, then mesh and texture again"
    )

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if addon.current_frame(context) is None:
            return "Needs a finished training: press Wrap Scene first"
        return why_busy(context)

    def work(self, context: bpy.types.Context) -> None:
        frame = addon.needed_frame(context)
        jobs.start_more(context.scene, frame, worker_setup.worker_choice(context))
        count = properties_of(context.scene).training.more_iterations
        self.report({"INFO"}, f"Training {count:,} iterations more")


class GWRAP_OT_reset_training(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.reset_training"
    bl_label = "Back to Preset"
    bl_description = "Reset every setting of this panel to that of the preset or to Auto"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return why_busy(context)

    def work(self, context: bpy.types.Context) -> None:
        training = properties_of(context.scene).training
        for name in training.bl_rna.properties.keys():  # noqa: SIM118 - no mapping
            if name != "rna_type":
                training.property_unset(name)


CLASSES: Final = (GWRAP_OT_estimate, GWRAP_OT_train_more, GWRAP_OT_reset_training)

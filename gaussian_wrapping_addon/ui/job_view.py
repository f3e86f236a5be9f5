# SPDX-License-Identifier: GPL-3.0-or-later
"""A job: progress, outcome, live figures and picture."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any, Final

import bpy

from ..core.evaluation.report.figures import duration, measured, number, part
from ..core.jobs.store.job_folder import JobStatus
from ..ops import job_timer
from ..ops.addon import properties_of, tr
from ..ops.job_timer import LivePoints, Stamp
from ..ops.panel_settings import Stage, stage_of
from .panel_base import (
    Readiness,
    ViewDrawing,
    button,
    characters_of,
    progress_text,
    table,
    wrapped_label,
)

# -- Draws a running training under its progress bar: figures and picture, from memory ------------


_PICTURE_SCALE = 9.0  # of an icon's size: about the width of the panel as Blender starts


def draw_live(layout: Any, properties: Any, status: JobStatus) -> bool:
    """Draw figures and image of the running training; return whether there were any."""
    rows = live_rows(status)
    if not rows:
        return False
    table(layout, rows)
    layout.prop(properties, "show_points")
    icons = job_timer.icons_of(job_timer.key_of(properties.job_folder))
    if icons:
        row = layout.row(align=True)
        for icon in icons:
            row.template_icon(icon_value=icon, scale=_PICTURE_SCALE / len(icons))
    return True


RATE = "iterations_per_s"

Row = tuple[str, str]


def live_rows(status: JobStatus) -> tuple[Row, ...]:
    """Return the rows that the panel shows of a running training; none in other stages.

    ``status``: with ``figures``: ``iteration``, ``iterations`` (of the whole plan), ``gaussians``,
    ``held_out_psnr`` (dB), ``psnr`` (dB, of the photos being trained), ``iterations_per_s``. What
    is missing has no row.
    """
    figures = part({"live": status.figures}, "live")
    if not status.active or measured(figures.get("iteration")) is None:
        return ()
    rows = [("Iteration", _of(figures.get("iteration"), figures.get("iterations")))]
    _add(rows, "Gaussians", figures.get("gaussians"), digits=0)
    if measured(figures.get("held_out_psnr")) is not None:
        _add(rows, "PSNR, Held Out", figures.get("held_out_psnr"), "dB", digits=1)
    else:
        _add(rows, "PSNR, Trained", figures.get("psnr"), "dB", digits=1)
    _add(rows, "Iterations per Second", figures.get(RATE), digits=1)
    done, total, rate = map(measured, map(figures.get, ("iteration", "iterations", RATE)))
    if done is not None and total is not None and rate:
        rows.append(("Training Left", duration((total - done) / rate)))
    return tuple(rows)


def _add(rows: list[Row], name: str, value: Any, unit: str = "", *, digits: int) -> None:
    if measured(value) is not None:
        rows.append((name, number(value, unit, digits=digits)))


def _of(done: Any, total: Any) -> str:
    text = number(done, digits=0)
    if not measured(total):
        return text
    return tr("{done} of {total}", done=text, total=number(total, digits=0))


# -- Draws the scene's job in the panel that started it: progress, outcome, next step -------------


def job_readiness(context: bpy.types.Context, command: str) -> Readiness | None:
    """Return the header text of the scene's job; None if it is another panel's, or done."""
    properties = properties_of(context.scene)
    if properties.job_command != command or not properties.job_folder:
        return None
    status = job_timer.status_of(properties.job_folder)
    if status is None:
        gone = job_timer.is_gone(properties.job_folder)
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
    status = job_timer.status_of(properties.job_folder)
    characters = characters_of(context)
    if status is None and job_timer.is_gone(properties.job_folder):
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


# -- Progress of the open file's jobs in the status bar of every window ---------------------------
#
# The bar's header calls :func:`draw`, which shows nothing unless a job of the open file runs: the
# state of the jobs decides, so that nothing has to be taken back when one ends.


_logger = logging.getLogger(__name__)

WIDTH: Final = 13.0
"""In Blender's units: room for the longest line."""

_failed = False


def start() -> None:
    """Add the progress to the status bar."""
    stop()
    bpy.types.STATUSBAR_HT_header.append(draw)


def stop() -> None:
    """Remove it."""
    global _failed
    _failed = False
    bpy.types.STATUSBAR_HT_header.remove(draw)


def running_jobs() -> list[JobStatus]:
    """Return the status of the open file's running jobs, the newest last."""
    return [j.status for j in job_timer.jobs.values() if j.scene_uid and j.status.active]


def draw(header: Any, _context: bpy.types.Context) -> None:
    """Draw the newest running job; Blender calls this. An error is logged once."""
    global _failed
    try:
        _draw_status(header.layout)
    except Exception:  # an exception here would recur at every redraw
        if not _failed:
            _logger.exception("progress cannot be drawn")
        _failed = True


def _draw_status(layout: Any) -> None:
    running = running_jobs()
    if not running:
        return
    status = running[-1]
    fraction = min(max(status.fraction, 0.0), 1.0)
    text = progress_text(status.stage, fraction, status.seconds_left)
    if len(running) > 1:
        text = f"{text} (+{len(running) - 1})"
    row = layout.row()
    row.ui_units_x = WIDTH
    row.progress(factor=fraction, text=text, type="BAR")


# -- Points of a running training in the 3D view, where its result will be ------------------------
#
# A draw handler, not an object: it touches nothing of the file, and without a GPU (in background
# mode) Blender never calls it.


SIZE_PX: Final = 2.5


@dataclass
class _Drawing:
    shader: Any = None
    stamp: Stamp | None = None
    batch: Any = None


_drawing = _Drawing()


def _draw_points(context: bpy.types.Context) -> None:
    points = job_timer.points_of(context.scene)
    if points is None:
        _drawing.stamp, _drawing.batch = None, None  # frees the GPU's memory after the training
        return
    if not len(points.positions):
        return
    import gpu  # not in background mode

    if points.stamp != _drawing.stamp:
        _make_batch(points)
    frame = job_timer.frame_of_job(context.scene)
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.point_size_set(SIZE_PX * context.preferences.system.ui_scale)
    try:
        with gpu.matrix.push_pop():
            if frame is not None:
                gpu.matrix.multiply_matrix(frame.matrix_world)
            _drawing.batch.draw(_drawing.shader)
    finally:
        gpu.state.point_size_set(1.0)
        gpu.state.depth_test_set("NONE")


def _make_batch(points: LivePoints) -> None:
    from gpu_extras.batch import batch_for_shader

    if _drawing.shader is None:
        import gpu

        try:
            _drawing.shader = gpu.shader.from_builtin("POINT_FLAT_COLOR")
        except ValueError:  # before Blender 4.5, which has a shader of its own for points
            _drawing.shader = gpu.shader.from_builtin("FLAT_COLOR")
    values = {"pos": points.positions, "color": points.colors}
    _drawing.batch = batch_for_shader(_drawing.shader, "POINTS", values)
    _drawing.stamp = points.stamp


def _forget() -> None:
    _drawing.shader, _drawing.stamp, _drawing.batch = None, None, None


VIEW: Final = ViewDrawing("points", lambda context: _draw_points(context), _forget)

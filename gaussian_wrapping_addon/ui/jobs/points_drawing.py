# SPDX-License-Identifier: GPL-3.0-or-later
"""Points of a running training in the 3D view, where its result will be.

A draw handler, not an object: it touches nothing of the file, and without a GPU (in background
mode) Blender never calls it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import bpy

from ...ops.jobs import live_points
from ...ops.jobs.live_points import LivePoints
from ...ops.jobs.live_preview import Stamp
from ..common.view_drawing import ViewDrawing

SHADERS: Final = ("POINT_FLAT_COLOR", "FLAT_COLOR")
"""Blender 4.5 and later have a shader of their own for points."""
SIZE_PX: Final = 2.5


@dataclass
class _Drawing:
    shader: Any = None
    stamp: Stamp | None = None
    batch: Any = None


_drawing = _Drawing()


def _draw(context: bpy.types.Context) -> None:
    points = live_points.points_of(context.scene)
    if points is None:
        _drawing.stamp, _drawing.batch = None, None  # frees the GPU's memory after the training
        return
    if not len(points.positions):
        return
    import gpu  # not in background mode

    if points.stamp != _drawing.stamp:
        _make_batch(points)
    frame = live_points.frame_of_job(context.scene)
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
        _drawing.shader = _point_shader()
    values = {"pos": points.positions, "color": points.colors}
    _drawing.batch = batch_for_shader(_drawing.shader, "POINTS", values)
    _drawing.stamp = points.stamp


def _point_shader() -> Any:
    import gpu

    for name in SHADERS[:-1]:
        try:
            return gpu.shader.from_builtin(name)
        except ValueError:  # an older Blender
            continue
    return gpu.shader.from_builtin(SHADERS[-1])


def _forget() -> None:
    _drawing.shader, _drawing.stamp, _drawing.batch = None, None, None


VIEW: Final = ViewDrawing("points", lambda context: _draw(context), _forget)

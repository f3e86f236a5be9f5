# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions in the 3D view: thick edges over what Blender draws, the active one in another colour."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import bpy
import numpy as np

from ...core.errors import WrapError
from ...core.regions.box import hull_edges
from ...ops.regions import region_watch
from ...ops.regions.region_objects import local_hull
from ..common.view_drawing import ViewDrawing

SHADER: Final = "POLYLINE_UNIFORM_COLOR"
WIDTH_PX: Final = 3.0
ACTIVE_WIDTH_PX: Final = 4.0
PLAIN: Final = (0.15, 0.75, 0.95)
SELECTED: Final = (1.0, 0.55, 0.1)
ACTIVE: Final = (1.0, 0.8, 0.2)
IN_FRONT_ALPHA: Final = 0.95
BEHIND_ALPHA: Final = 0.3
MOST_CACHED: Final = 200


@dataclass
class _Drawing:
    shader: Any = None
    batches: dict[tuple[object, ...], Any] = field(default_factory=dict)
    """By what decides the shape; None where there is nothing to draw."""


_drawing = _Drawing()


def visible_regions(
    scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, space: Any = None
) -> list[bpy.types.Object]:
    """Return the regions that a view shows, the active one last, over the others."""
    found = []
    for name in region_watch.region_names(scene):
        thing = view_layer.objects.get(name)
        if thing is not None and thing.visible_get(view_layer=view_layer, viewport=space):
            found.append(thing)
    return sorted(found, key=lambda thing: (thing == view_layer.objects.active, thing.select_get()))


def colour_of(thing: bpy.types.Object, active: bpy.types.Object | None) -> tuple[float, ...]:
    """Return the colour of a region's edges."""
    if not thing.select_get():
        return PLAIN
    return ACTIVE if thing == active else SELECTED


def edges_of(thing: bpy.types.Object) -> np.ndarray | None:
    """Return the (n, 2, 3) float32 edges of a region's hull in its own coordinates, or None."""
    try:
        vertices, triangles = local_hull(thing)
    except WrapError:
        return None  # flat, or not a region's kind of object: the panel says so when it is used
    edges = hull_edges(vertices, np.array(triangles))
    return np.asarray(vertices[edges], np.float32)


def _draw(context: bpy.types.Context) -> None:
    space: Any = context.space_data
    things = visible_regions(context.scene, context.view_layer, space)
    if not things:
        return
    import gpu  # not in background mode

    if _drawing.shader is None:
        _drawing.shader = gpu.shader.from_builtin(SHADER)
    shader = _drawing.shader
    scale = context.preferences.system.ui_scale
    active = context.view_layer.objects.active
    shader.bind()
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    gpu.state.blend_set("ALPHA")
    try:
        for thing in things:
            batch = _batch(thing)
            if batch is None:
                continue
            colour = colour_of(thing, active)
            width = ACTIVE_WIDTH_PX if thing == active and thing.select_get() else WIDTH_PX
            shader.uniform_float("lineWidth", width * scale)
            with gpu.matrix.push_pop():
                gpu.matrix.multiply_matrix(thing.matrix_world)
                for test, alpha in (("NONE", BEHIND_ALPHA), ("LESS_EQUAL", IN_FRONT_ALPHA)):
                    gpu.state.depth_test_set(test)
                    shader.uniform_float("color", (*colour, alpha))
                    batch.draw(shader)
    finally:
        gpu.state.depth_test_set("NONE")
        gpu.state.blend_set("NONE")


def _batch(thing: bpy.types.Object) -> Any:
    key = region_watch.shape_key(thing)
    if key not in _drawing.batches:
        if len(_drawing.batches) >= MOST_CACHED:
            _drawing.batches.clear()
        _drawing.batches[key] = _made(edges_of(thing))
    return _drawing.batches[key]


def _made(edges: np.ndarray | None) -> Any:
    from gpu_extras.batch import batch_for_shader

    if edges is None:
        return None
    return batch_for_shader(_drawing.shader, "LINES", {"pos": edges.reshape(-1, 3)})


def _forget() -> None:
    _drawing.shader = None
    _drawing.batches.clear()


VIEW: Final = ViewDrawing("regions", lambda context: _draw(context), _forget)

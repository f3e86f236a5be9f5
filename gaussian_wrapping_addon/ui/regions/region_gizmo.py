# SPDX-License-Identifier: GPL-3.0-or-later
"""A cage around the active region box: drag a side, an edge, a corner, or the middle."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final, cast

import bpy
import numpy as np
from mathutils import Matrix

from ...ops.common.redrawing import redraw
from ...ops.regions.region_box import (
    as_columns,
    cage_frame,
    cage_matrix,
    from_columns,
    is_editable_box,
    is_moved_only,
    same_place,
    set_cage_matrix,
    steadied,
)

_POLL_S: Final = 0.05


@dataclass
class _Drag:
    """State of a drag, for one undo step at its end."""

    name: str = ""
    before: Matrix | None = None
    cage: np.ndarray | None = None
    """As it was before the drag."""
    first: np.ndarray | None = None
    """As first set by Blender."""
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Of the cage's frame, which stays while a cage is dragged."""
    regions: set[int] = field(default_factory=set)
    """Views in which the mouse button is down."""


_drag = _Drag()


def _box(context: bpy.types.Context) -> bpy.types.Object | None:
    thing = context.view_layer.objects.active
    return thing if is_editable_box(thing) else None


def _shifted(cage: np.ndarray, by: np.ndarray) -> np.ndarray:
    result = cage.copy()
    result[:3, 3] += by
    return result


def get_cage() -> list[float]:
    """Return the cage of the active box; Blender asks whenever it draws."""
    box = _box(bpy.context)
    return as_columns(np.eye(4) if box is None else _shifted(cage_matrix(box), -_drag.origin))


def set_cage(values: Any) -> None:
    """Apply a cage that is being dragged."""
    box = _box(bpy.context)
    if box is None:
        return
    cage = _shifted(from_columns(values), _drag.origin)
    if _drag.before is None or _drag.cage is None or _drag.first is None:
        _drag.name, _drag.before = box.name, box.matrix_basis.copy()
        _drag.cage, _drag.first = cage_matrix(box), cage
    moved = is_moved_only(cage, _drag.cage)
    set_cage_matrix(box, cage if moved else steadied(cage, _drag.first, _drag.cage))


def end_drag() -> None:
    """Make one undo step of a drag that has ended, if something has moved."""
    name, before = _drag.name, _drag.before
    _drag.name, _drag.before, _drag.cage, _drag.first = "", None, None, None
    box = bpy.context.view_layer.objects.get(name) if name else None
    if box is None or before is None or same_place(before, box.matrix_basis):
        return
    bpy.ops.ed.undo_push(message="Edit Region Box")


def _end_later() -> float | None:
    """Timer: no undo step can be made while Blender draws."""
    if _drag.regions:
        # Nothing draws after the button is let go: only draw_prepare sees that the drag is over.
        redraw()
        return _POLL_S
    end_drag()
    return None


def stop() -> None:
    """Cancel a drag."""
    _drag.name, _drag.before, _drag.cage, _drag.first = "", None, None, None
    _drag.regions.clear()
    if bpy.app.timers.is_registered(_end_later):
        bpy.app.timers.unregister(_end_later)


class GWRAP_GGT_region_box(bpy.types.GizmoGroup):
    bl_idname = "GWRAP_GGT_region_box"
    bl_label = "Region Box"
    bl_space_type = "VIEW_3D"
    bl_region_type = "WINDOW"
    bl_options = {"3D", "PERSISTENT"}  # noqa: RUF012 - Blender's convention

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        box = context.view_layer.objects.active
        return (
            context.mode == "OBJECT"
            and box is not None
            and is_editable_box(box)
            and box.select_get()
            and box.visible_get(viewport=cast(bpy.types.SpaceView3D, context.space_data))
        )

    def setup(self, _context: bpy.types.Context) -> None:
        cage: Any = self.gizmos.new("GIZMO_GT_cage_3d")
        cage.transform = {"SCALE", "TRANSLATE"}
        cage.draw_style = "BOX"
        cage.dimensions = (2.0, 2.0, 2.0)
        cage.color, cage.alpha = (1.0, 0.8, 0.2), 0.6
        cage.color_highlight, cage.alpha_highlight = (1.0, 1.0, 1.0), 1.0
        cage.target_set_handler("matrix", get=get_cage, set=set_cage)

    def refresh(self, context: bpy.types.Context) -> None:
        self.draw_prepare(context)

    def draw_prepare(self, context: bpy.types.Context) -> None:
        box = _box(context)
        if box is not None:
            if _drag.before is None:
                _drag.origin = cage_matrix(box)[:3, 3]
            shown = Matrix(_shifted(cage_matrix(box), -_drag.origin).tolist())
            for cage in self.gizmos:
                cage.matrix_basis = Matrix(cage_frame(box, _drag.origin).tolist())
                # Blender asks for the cage only once: what it draws would stay where a drag ended.
                cage.matrix_offset = shown
        here = context.region.as_pointer()
        if any(gizmo.is_modal for gizmo in self.gizmos):
            _drag.regions.add(here)
        else:
            _drag.regions.discard(here)
        waits = bpy.app.timers.is_registered(_end_later)
        if (_drag.regions or _drag.before is not None) and not waits:
            bpy.app.timers.register(_end_later, first_interval=_POLL_S)


CLASSES: Final = (GWRAP_GGT_region_box,)

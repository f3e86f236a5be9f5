# SPDX-License-Identifier: GPL-3.0-or-later
"""Panel Region, region boxes in the 3D view."""

from dataclasses import dataclass, field
from typing import Any, Final, cast

import bpy
import numpy as np
from bpy.props import BoolProperty
from mathutils import Matrix

from ..core.errors import WrapError
from ..core.regions.box import hull_edges
from ..core.settings import declared
from ..ops import addon, meshing, region_operators
from ..ops.addon import properties_of, redraw, tr
from ..ops.region_objects import (
    cage_frame,
    cage_matrix,
    is_editable_box,
    local_hull,
    set_cage_matrix,
    steadied,
)
from ..ops.region_operators import edge_length_in_blender
from .dataset_panel import draw_masks
from .panel_base import (
    Readiness,
    TabPanel,
    ViewDrawing,
    characters_of,
    count_of_regions,
    plain,
    property_of,
    wrapped_label,
)

# -- Properties of a region: ``Object.gwrap``, stored once changed --------------------------------


class GWRAP_PG_region(bpy.types.PropertyGroup):
    checked: BoolProperty(  # type: ignore[valid-type]
        name="Mesh Together",
        description="Mesh and estimate this region together with the other checked ones",
    )
    own_edge_length: BoolProperty(  # type: ignore[valid-type]
        name="Own Edge Length",
        description="Mesh this region with its own edge length, not that of the Mesh panel",
    )
    edge_length: property_of(  # type: ignore[valid-type]
        declared("meshing.edge_length"),
        description="Length of this region's triangle edges, as seen in Blender",
    )


PROPERTIES: Final = (GWRAP_PG_region,)


# -- The panel "Region": list of regions, settings of the active one, estimates -------------------


MOST_ROWS: Final = 40
_RESOLUTIONS: Final = {"AUTOMATIC": "automatic", "POINTS": "by number of points"}


class GWRAP_PT_region(TabPanel, bpy.types.Panel):
    bl_label = "Region"

    def readiness(self, context: bpy.types.Context) -> Readiness:
        count = sum(1 for _ in addon.objects_of_kind(context.scene, "region"))
        if not count:
            return Readiness("No regions yet")
        return Readiness(count_of_regions(count), "CHECKMARK")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.operator_menu_enum(
            "gwrap.add_region_box", "around", text="Add Region Box", icon="CUBE"
        )
        active = context.view_layer.objects.active
        regions = sorted(addon.objects_of_kind(context.scene, "region"), key=lambda t: t.name)
        if regions:
            box = layout.box().column(align=True)
            for region in regions[:MOST_ROWS]:
                _draw_row(box, region)
            if len(regions) > MOST_ROWS:
                more = tr("and {count} more", count=len(regions) - MOST_ROWS)
                box.label(text=more, translate=False)
        else:
            layout.label(text=tr("No regions yet"), icon="INFO", translate=False)
        if active is not None and addon.kind_of(active) == "region":
            _draw_active(layout, context, active)
        checked = [region for region in regions if properties_of(region).checked]
        if checked:
            row = layout.row(align=True)
            buttons: tuple[tuple[str, str, Any], ...] = (
                ("gwrap.estimate_regions", "Estimate {count} Checked", "TIME"),
                ("gwrap.mesh_region", "Mesh {count} Checked", "MESH_DATA"),
            )
            for operator, text, icon in buttons:
                text = tr(text, count=len(checked))
                button: Any = row.operator(operator, text=text, icon=icon)
                button.checked = True
            text = tr("Train for {count} Checked", count=len(checked))
            layout.operator("gwrap.train_for_regions", text=text, icon="MOD_MESHDEFORM")
        draw_masks(layout, characters_of(context))
        if active is not None and active.type == "MESH" and not addon.kind_of(active):
            layout.operator("gwrap.use_as_region", icon="MESH_ICOSPHERE")
        row = layout.row(align=True)
        row.operator("gwrap.import_region", text="Import", icon="IMPORT")
        row.operator("gwrap.export_region", text="Export", icon="EXPORT")


def _draw_row(layout: Any, region: bpy.types.Object) -> None:
    row = layout.row(align=True)
    row.prop(properties_of(region), "checked", text="")
    operator = row.operator(
        "gwrap.select_region",
        text=region.name,
        icon="MESH_CUBE" if region.type == "EMPTY" else "MESH_ICOSPHERE",
        depress=region.select_get(),
        translate=False,
    )
    operator.name = region.name
    row.prop(region, "hide_viewport", text="", emboss=False)
    row.operator("gwrap.delete_region", text="", icon="X", emboss=False).name = region.name


def _draw_active(layout: Any, context: bpy.types.Context, region: bpy.types.Object) -> None:
    box = layout.box()
    column = plain(box.column())
    column.prop(region, "name")
    scene = context.scene
    own = properties_of(region)
    row = column.row(align=True, heading="Edge Length")
    row.enabled = properties_of(scene).method != "PIVOTS"
    row.prop(own, "own_edge_length", text="")
    value = row.row(align=True)
    value.active = own.own_edge_length
    if own.own_edge_length:
        value.prop(own, "edge_length", text="")
    else:
        value.label(text=_scene_resolution(scene, region), translate=False)
    _draw_estimate(box, context, region)


def _scene_resolution(scene: bpy.types.Scene, region: bpy.types.Object) -> str:
    if properties_of(scene).method == "PIVOTS":
        return tr("none with pivots")
    length = edge_length_in_blender(scene, region)
    if length:
        return tr("{length} (Mesh panel)", length=f"{length:.4g}")
    return tr(_RESOLUTIONS[properties_of(scene).resolution])


def _draw_estimate(layout: Any, context: bpy.types.Context, region: bpy.types.Object) -> None:
    characters = characters_of(context) - 4
    if meshing.is_waiting(region):
        layout.label(text=tr("Estimating…"), icon="SORTTIME", translate=False)
        return
    estimate, holds = meshing.estimate_for(context.scene, region)
    if estimate is not None:
        column = layout.column(align=True)
        column.active = holds
        if not holds:
            wrapped_label(column, "Before the last change:", characters, icon="INFO")
        for line in estimate.lines:
            wrapped_label(column, line, characters, icon="NONE")
        for line in filter(None, estimate.warnings):
            wrapped_label(column, line, characters, icon="ERROR")
    layout.operator(
        "gwrap.estimate_regions", text="Estimate Again" if estimate else "Estimate", icon="TIME"
    )


# -- Regions in the 3D view: thick edges over what Blender draws, the active one in another colour


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
    for name in region_operators.region_names(scene):
        thing = view_layer.objects.get(name)
        if thing is not None and thing.visible_get(view_layer=view_layer, viewport=space):
            found.append(thing)
    return sorted(found, key=lambda thing: (thing == view_layer.objects.active, thing.select_get()))


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
            colour, width = PLAIN, WIDTH_PX
            if thing.select_get():
                is_active = thing == active
                colour, width = (ACTIVE, ACTIVE_WIDTH_PX) if is_active else (SELECTED, WIDTH_PX)
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
    key = region_operators.shape_key(thing)
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


# -- A cage around the active region box: drag a side, an edge, a corner, or the middle -----------


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
    """Return the cage of the active box, by columns; Blender asks whenever it draws."""
    box = _box(bpy.context)
    cage = np.eye(4) if box is None else _shifted(cage_matrix(box), -_drag.origin)
    return [float(value) for value in cage.T.ravel()]


def set_cage(values: Any) -> None:
    """Apply a cage that is being dragged, given by columns."""
    box = _box(bpy.context)
    if box is None:
        return
    cage = _shifted(np.array(values, np.float64).reshape(4, 4).T, _drag.origin)
    if _drag.before is None or _drag.cage is None or _drag.first is None:
        _drag.name, _drag.before = box.name, box.matrix_basis.copy()
        _drag.cage, _drag.first = cage_matrix(box), cage
    keeps_size = np.allclose(cage.diagonal(), _drag.cage.diagonal(), rtol=1e-6)
    set_cage_matrix(box, cage if keeps_size else steadied(cage, _drag.first, _drag.cage))


def end_drag() -> None:
    """Make one undo step of a drag that has ended, if something has moved."""
    name, before = _drag.name, _drag.before
    _drag.name, _drag.before, _drag.cage, _drag.first = "", None, None, None
    box = bpy.context.view_layer.objects.get(name) if name else None
    if box is None or before is None:
        return
    if not np.allclose(np.array(before), np.array(box.matrix_basis), rtol=1e-6, atol=1e-9):
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


CLASSES: Final = (GWRAP_PT_region, GWRAP_GGT_region_box)

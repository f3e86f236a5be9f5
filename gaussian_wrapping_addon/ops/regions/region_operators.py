# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that add, select, export and import region boxes."""

import itertools
from pathlib import Path
from typing import Final, cast

import bpy
import numpy as np
from bpy.props import EnumProperty, StringProperty

from ...core.errors import UsageError
from ...core.names import file_stem
from ...core.regions.box import CUBE_CORNERS
from ...core.regions.region_file import read_region_file
from ...core.regions.rsbox import SUFFIXES
from ..common import tags
from ..common.error_reporting import NeedsObjectMode, OperatorResult, ReportsErrors
from .region_objects import (
    box_around,
    create_region,
    export_region,
    hull_in_blender,
    is_convex,
    scene_from_blender,
    transformed,
)

# Half the side of a box at the cursor in scene units; the cameras of a scene lie within 5.
_CURSOR_BOX_HALF = 0.5

_AROUND: Final = (
    ("CURSOR", "At 3D Cursor", "A cube at the 3D cursor"),
    ("SELECTED", "Around Selected", "The box around the selected objects"),
    ("RESULT", "Around Result", "A copy of the region of the first mesh"),
)

_FORMATS: Final = (
    ("JSON", "JSON", "Any convex body"),
    ("RSBOX", "RealityScan Box", "Reconstruction region of RealityScan; boxes only"),
)
_PATTERN: Final = "*.json;*.rsbox;*.rcbox"


def _select_only(context: bpy.types.Context, thing: bpy.types.Object) -> None:
    context.view_layer.update()  # a new object cannot be selected before
    for other in context.view_layer.objects:
        other.select_set(other == thing)
    context.view_layer.objects.active = thing


def _active(context: bpy.types.Context) -> bpy.types.Object:
    """Return the active object, where ``poll`` has found one."""
    return cast(bpy.types.Object, context.view_layer.objects.active)


def _target(context: bpy.types.Context) -> tuple[bpy.types.Object | None, bpy.types.Collection]:
    """Return the frame and the collection for a new region."""
    frame = tags.current_frame(context.scene, context.view_layer.objects.active)
    if frame is None:
        return None, context.scene.collection
    # Linked and overridden collections accept no new objects; objects excluded from the view layer
    # cannot be selected.
    shown = _shown_collections(context.view_layer.layer_collection)
    places = [
        c
        for c in frame.users_collection
        if c in shown and c.library is None and c.override_library is None
    ]
    return frame, places[0] if places else context.scene.collection


def _shown_collections(layer: bpy.types.LayerCollection) -> list[bpy.types.Collection]:
    below = [c for child in layer.children if not child.exclude for c in _shown_collections(child)]
    return [layer.collection, *below]


def _free_name(frame: bpy.types.Object | None) -> str:
    """Return a name for a new box that has no mesh yet: meshing would replace that mesh."""
    children = frame.children if frame is not None else ()
    made = {str(t.get(tags.REGION, "")) for t in children}
    numbers = itertools.count(2)
    name = "Region"
    while name in made or name in bpy.data.objects:
        name = f"Region_{next(numbers)}"
    return name


class GWRAP_OT_add_region_box(NeedsObjectMode, bpy.types.Operator):
    bl_idname = "gwrap.add_region_box"
    bl_label = "Add Region Box"
    bl_description = "Add a box to move, rotate and scale; the space inside it is meshed"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    around: EnumProperty(name="Around", items=_AROUND, default="CURSOR")  # type: ignore[valid-type]

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame, collection = _target(context)
        if self.around == "SELECTED":
            things = [t for t in context.selected_objects if tags.kind_of(t) != "region"]
            vertices = box_around(things, frame)
        elif self.around == "RESULT":
            vertices = self._result_box(context, frame)
        else:
            inverse = scene_from_blender(frame)
            cursor = np.array(context.scene.cursor.location, np.float64)
            vertices = transformed(inverse, cursor[None]) + _CURSOR_BOX_HALF * CUBE_CORNERS
        thing = create_region(_free_name(frame), vertices, frame, collection)
        thing.show_name = True
        _select_only(context, thing)
        return {"FINISHED"}

    def _result_box(self, context: bpy.types.Context, frame: bpy.types.Object | None) -> np.ndarray:
        if frame is None:
            raise UsageError("The scene has no result.", "Wrap the scene or import a result.")
        regions = [
            t
            for t in tags.objects_of_kind(context.scene, "region")
            if tags.frame_of(t) == frame and t.get(tags.REGION)
        ]
        regions.sort(key=lambda t: t[tags.REGION] != "auto")
        if not regions:
            return box_around([t for t in frame.children if tags.kind_of(t) == "mesh"], frame)
        return transformed(scene_from_blender(frame), hull_in_blender(regions[0])[0])


class GWRAP_OT_select_region(NeedsObjectMode, bpy.types.Operator):
    bl_idname = "gwrap.select_region"
    bl_label = "Select Region"
    bl_description = "Select this region; Shift adds it to the selection"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    name: StringProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]
    extend: bpy.props.BoolProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        self.extend = event.shift
        return self.execute(context)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        thing = context.view_layer.objects.get(self.name)
        if thing is None:
            raise UsageError(f"Region {self.name} is not in this view layer.", "Enable it.")
        if self.extend:
            thing.select_set(True)
            context.view_layer.objects.active = thing
        else:
            _select_only(context, thing)
        return {"FINISHED"}


class GWRAP_OT_export_region(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.export_region"
    bl_label = "Export Region"
    bl_description = "Write the active region in world coordinates, as JSON or for RealityScan"

    filepath: StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_glob: StringProperty(default=_PATTERN, options={"HIDDEN"})  # type: ignore[valid-type]
    file_format: EnumProperty(name="Format", items=_FORMATS, default="JSON")  # type: ignore[valid-type]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        active = context.view_layer.objects.active
        if active is None or active.type not in ("EMPTY", "MESH"):
            cls.poll_message_set("Select a region box or a mesh")
            return False
        return True

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        name = file_stem(_active(context).name, 0)
        self.filepath = str(Path(self.filepath).parent / f"{name}.json")
        self.check(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, _context: bpy.types.Context) -> bool:
        """Let the file's suffix follow the chosen format; Blender calls this."""
        path = Path(self.filepath)
        suffix = f".{self.file_format.lower()}"
        if not path.name or path.suffix.lower() == suffix:
            return False
        known = path.suffix.lower() in (".json", *SUFFIXES)
        self.filepath = str(path.with_suffix(suffix) if known else path) + ("" if known else suffix)
        return True

    def work(self, context: bpy.types.Context) -> OperatorResult:
        path = Path(bpy.path.abspath(self.filepath))
        export_region(_active(context), path)
        self.report({"INFO"}, f"Wrote {path}")
        return {"FINISHED"}


class GWRAP_OT_import_region(NeedsObjectMode, bpy.types.Operator):
    bl_idname = "gwrap.import_region"
    bl_label = "Import Region"
    bl_description = "Read a region in world coordinates: JSON, or .rsbox of RealityScan"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    filepath: StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: StringProperty(default=_PATTERN, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> OperatorResult:
        path = Path(bpy.path.abspath(self.filepath))
        vertices = read_region_file(path).vertices
        frame, collection = _target(context)
        if frame is not None:
            vertices = tags.world_from_scene(frame).inverse().points(vertices)
        thing = create_region(path.stem, vertices, frame, collection)
        thing.show_name = True
        _select_only(context, thing)
        return {"FINISHED"}


class GWRAP_OT_use_as_region(NeedsObjectMode, bpy.types.Operator):
    bl_idname = "gwrap.use_as_region"
    bl_label = "Use Mesh as Region"
    bl_description = "Use the convex hull of the active mesh as a region"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        active = context.view_layer.objects.active
        if active is None or active.type != "MESH" or tags.kind_of(active):
            cls.poll_message_set("Select a mesh that is neither a region nor a result")
            return False
        return super().poll(context)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        active = _active(context)
        frame, _ = _target(context)
        if not active.is_editable:
            raise UsageError(
                f"{active.name} is linked from a library.",
                "Make it local (Object > Relations > Make Local).",
            )
        hull_in_blender(active)  # raises if it encloses no volume
        if not is_convex(active):
            text = f"{active.name} is not convex: its convex hull is the region"
            self.report({"WARNING"}, text)
        if frame is not None and tags.frame_of(active) is None:
            matrix = active.matrix_world.copy()
            active.parent = frame
            active.matrix_parent_inverse.identity()
            active.matrix_world = matrix
        active[tags.KIND] = "region"
        active.display_type = "WIRE"
        active.show_in_front = True
        active.hide_render = True
        return {"FINISHED"}


CLASSES: Final = (
    GWRAP_OT_add_region_box,
    GWRAP_OT_select_region,
    GWRAP_OT_export_region,
    GWRAP_OT_import_region,
    GWRAP_OT_use_as_region,
)

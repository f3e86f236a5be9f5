# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions: created, edited, imported, exported, watched."""

import itertools
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, cast

import bpy
import numpy as np
from bpy.app.handlers import persistent
from bpy.props import EnumProperty, StringProperty

from ..core.errors import UsageError
from ..core.names import file_stem
from ..core.regions.box import CUBE_CORNERS
from ..core.regions.files import SUFFIXES, read_region_file
from . import addon
from .addon import NeedsObjectMode, OperatorResult, ReportsErrors, properties_of
from .region_objects import (
    box_around,
    create_region,
    export_region,
    hull_in_blender,
    is_convex,
    scene_from_blender,
    transformed,
)

# -- Resolution of a region's mesh: its own edge length, or that of the scene's panels ------------


COARSEST_SHARE = 0.5
"""Of a region's diagonal: longer edges are refused as typing errors."""
FINEST_SHARE = 1e-6
"""Of the diagonal: the worker refuses shorter edges as well."""


def has_own(scene: bpy.types.Scene, region: bpy.types.Object) -> bool:
    """Return whether a region's own edge length applies; meshes by pivots have none."""
    return bool(properties_of(region).own_edge_length) and properties_of(scene).method != "PIVOTS"


def edge_length_in_blender(scene: bpy.types.Scene, region: bpy.types.Object) -> float:
    """Return the edge length that applies, in Blender units; 0 if none does."""
    if has_own(scene, region):
        return float(properties_of(region).edge_length)
    applies = properties_of(scene).resolution == "EDGE_LENGTH"
    return float(properties_of(scene).edge_length) if applies else 0.0


def checked_edge_length(scene: bpy.types.Scene, region: bpy.types.Object) -> float:
    """Return :func:`edge_length_in_blender`, checked against the region's size.

    Raises UsageError: the region encloses no volume, or the length is no positive number, too long
    or too short.
    """
    edge_length = edge_length_in_blender(scene, region)
    diagonal = float(np.linalg.norm(np.ptp(hull_in_blender(region)[0], 0)))
    if not has_own(scene, region) and properties_of(scene).resolution != "EDGE_LENGTH":
        return 0.0
    if not math.isfinite(edge_length) or edge_length <= 0.0:
        raise UsageError(
            f"Edge length {edge_length:g} of region {region.name} is not valid.",
            "Give a positive length.",
        )
    if edge_length > COARSEST_SHARE * diagonal:
        raise UsageError(
            f"Edge length {edge_length:g} is too coarse for region {region.name}, "
            f"which measures {diagonal:.3g} from corner to corner.",
            "Choose a smaller edge length.",
        )
    if edge_length < FINEST_SHARE * diagonal:
        raise UsageError(
            f"The diagonal of region {region.name} has {diagonal / edge_length:.2g} edges of "
            f"{edge_length:g}: too many.",
            "Choose a larger edge length, or a smaller region.",
        )
    return edge_length


def world_per_blender(frame: bpy.types.Object) -> float:
    """Return how many world units of the input a length of 1 in Blender is."""
    scale = abs(np.linalg.det(scene_from_blender(frame)[:3, :3])) ** (1.0 / 3.0)
    return float(scale * addon.world_from_scene(frame).scale)


def own_lengths(
    scene: bpy.types.Scene, regions: list[bpy.types.Object], frame: bpy.types.Object
) -> list[float | None]:
    """Return each region's own edge length in world units, None if it has none.

    Raises UsageError: a region or its edge length cannot be used.
    """
    lengths = {region: checked_edge_length(scene, region) for region in regions}
    scale = world_per_blender(frame)
    return [length * scale if has_own(scene, r) else None for r, length in lengths.items()]


# -- Cache of a scene's regions and their shapes, updated by handlers -----------------------------
#
# Drawing queries it many times a second. It stores names and numbers, never objects.


@dataclass
class _Known:
    names: dict[int, tuple[int, tuple[str, ...]]] = field(default_factory=dict)
    """By the scene's session id: number of its objects and names of its regions."""
    versions: dict[int, int] = field(default_factory=dict)
    """By the object's session id: number of changes of its geometry."""


_known = _Known()


@persistent
def after_update(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Handler: something in a scene has changed."""
    if depsgraph is None:
        _known.names.clear()
        return
    for update in depsgraph.updates:
        thing = update.id.original
        if not isinstance(thing, bpy.types.Object):
            if isinstance(thing, bpy.types.Scene | bpy.types.Collection):
                _known.names.clear()
            continue
        if addon.kind_of(thing) == "region":
            _known.names.clear()
        if update.is_updated_geometry:
            uid = thing.session_uid
            _known.versions[uid] = _known.versions.get(uid, 0) + 1


@persistent
def forget(*_arguments: object) -> None:
    """Clear the cache. Handler: another file, or an undo; session ids may mean other objects."""
    _known.names.clear()
    _known.versions.clear()


def region_names(scene: bpy.types.Scene) -> tuple[str, ...]:
    """Return the names of a scene's regions, sorted."""
    count = len(scene.objects)
    stored = _known.names.get(scene.session_uid)
    if stored is not None and stored[0] == count and all(n in scene.objects for n in stored[1]):
        return stored[1]
    names = tuple(sorted(thing.name for thing in addon.objects_of_kind(scene, "region")))
    _known.names[scene.session_uid] = (count, names)
    return names


def shape_key(thing: bpy.types.Object) -> tuple[object, ...]:
    """Return a key of a region's shape in its own coordinates."""
    if thing.type == "EMPTY":
        return ("EMPTY", thing.empty_display_type, thing.empty_display_size)
    return (thing.type, thing.session_uid, _known.versions.get(thing.session_uid, 0))


# -- Operators that add, select, export and import region boxes -----------------------------------


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
    frame = addon.current_frame(context)
    if frame is None:
        return None, context.scene.collection
    # Linked and overridden collections accept no new objects; objects excluded from the view layer
    # cannot be selected.
    shown = _shown_collections(context.view_layer.layer_collection)
    own = (c for c in frame.users_collection if c.library is None and c.override_library is None)
    return frame, next((c for c in own if c in shown), context.scene.collection)


def _shown_collections(layer: bpy.types.LayerCollection) -> list[bpy.types.Collection]:
    below = [c for child in layer.children if not child.exclude for c in _shown_collections(child)]
    return [layer.collection, *below]


def _free_name(frame: bpy.types.Object | None) -> str:
    """Return a name for a new box that has no mesh yet: meshing would replace that mesh."""
    children = frame.children if frame is not None else ()
    made = {str(t.get(addon.REGION, "")) for t in children}
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

    def work(self, context: bpy.types.Context) -> None:
        frame, collection = _target(context)
        if self.around == "SELECTED":
            things = [t for t in context.selected_objects if addon.kind_of(t) != "region"]
            vertices = box_around(things, frame)
        elif self.around == "RESULT":
            vertices = self._result_box(context)
        else:
            inverse = scene_from_blender(frame)
            cursor = np.array(context.scene.cursor.location, np.float64)
            vertices = transformed(inverse, cursor[None]) + _CURSOR_BOX_HALF * CUBE_CORNERS
        thing = create_region(_free_name(frame), vertices, frame, collection)
        thing.show_name = True
        _select_only(context, thing)

    def _result_box(self, context: bpy.types.Context) -> np.ndarray:
        frame = addon.needed_frame(context)
        own = (t for t in addon.objects_of_kind(context.scene, "region") if t.get(addon.REGION))
        regions = [t for t in own if addon.frame_of(t) == frame]
        regions.sort(key=lambda t: t[addon.REGION] != "auto")
        if not regions:
            return box_around([t for t in frame.children if addon.kind_of(t) == "mesh"], frame)
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

    def work(self, context: bpy.types.Context) -> None:
        thing = context.view_layer.objects.get(self.name)
        if thing is None:
            raise UsageError(f"Region {self.name} is not in this view layer.", "Enable it.")
        if self.extend:
            thing.select_set(True)
            context.view_layer.objects.active = thing
        else:
            _select_only(context, thing)


class GWRAP_OT_export_region(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.export_region"
    bl_label = "Export Region"
    bl_description = "Write the active region in world coordinates, as JSON or for RealityScan"

    filepath: StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_glob: StringProperty(default=_PATTERN, options={"HIDDEN"})  # type: ignore[valid-type]
    file_format: EnumProperty(name="Format", items=_FORMATS, default="JSON")  # type: ignore[valid-type]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        active = context.view_layer.objects.active
        is_shape = active is not None and active.type in ("EMPTY", "MESH")
        return "" if is_shape else "Select a region box or a mesh"

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

    def work(self, context: bpy.types.Context) -> None:
        path = Path(bpy.path.abspath(self.filepath))
        export_region(_active(context), path)
        self.report({"INFO"}, f"Wrote {path}")


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

    def work(self, context: bpy.types.Context) -> None:
        path = Path(bpy.path.abspath(self.filepath))
        vertices = read_region_file(path).vertices
        frame, collection = _target(context)
        if frame is not None:
            vertices = addon.world_from_scene(frame).inverse().points(vertices)
        thing = create_region(path.stem, vertices, frame, collection)
        thing.show_name = True
        _select_only(context, thing)


class GWRAP_OT_use_as_region(NeedsObjectMode, bpy.types.Operator):
    bl_idname = "gwrap.use_as_region"
    bl_label = "Use Mesh as Region"
    bl_description = "Use the convex hull of the active mesh as a region"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        active = context.view_layer.objects.active
        if active is None or active.type != "MESH" or addon.kind_of(active):
            return "Select a mesh that is neither a region nor a result"
        return super().why_not(context)

    def work(self, context: bpy.types.Context) -> None:
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
        if frame is not None and addon.frame_of(active) is None:
            matrix = active.matrix_world.copy()
            active.parent = frame
            active.matrix_parent_inverse.identity()
            active.matrix_world = matrix
        active[addon.KIND] = "region"
        active.display_type = "WIRE"
        active.show_in_front = active.hide_render = True


CLASSES: Final = (
    GWRAP_OT_add_region_box, GWRAP_OT_select_region, GWRAP_OT_export_region, GWRAP_OT_import_region,
    GWRAP_OT_use_as_region,
)  # fmt: skip

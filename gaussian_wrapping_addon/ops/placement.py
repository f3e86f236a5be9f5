# SPDX-License-Identifier: GPL-3.0-or-later
"""Scale, ground, up and origin of a result."""

import contextlib
import json
import logging
from pathlib import Path
from typing import Final

import bmesh
import bpy
import numpy as np
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, EnumProperty, FloatProperty
from mathutils import Matrix

from ..core.errors import ParseError, UsageError, WrapError
from ..core.files import read_json, real_path
from ..core.scene.camera import Similarity
from ..core.scene.frames import camera_up, find_ground_plane
from ..core.scene.placement import (
    FILE_NAME,
    Plane,
    check_scale,
    ground_step,
    origin_step,
    plane_through,
    scale_step,
    similarity_of_matrix,
    write_placement,
)
from ..core.units.georeference import blender_start
from . import addon
from .addon import NeedsResult, OperatorResult, needed_frame
from .cameras import cameras_under, scale_display
from .mesh_data import mesh_of, values_of
from .region_objects import hull_in_blender, matrix_of, scene_from_blender, transformed

# -- Automatic up direction and ground plane of a result in Blender -------------------------------


_FLIP_YZ = np.array([1.0, -1.0, -1.0])


def camera_poses(frame: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses of a result's photo cameras in Blender's world.

    Returns ``rotations``, (n, 3, 3) float64: ``cam_from_world``: x right, y down, z forward;
    ``centers``, (n, 3) float64.
    """
    rotations, centers = [], []
    for camera in cameras_under(frame):
        matrix = matrix_of(camera)
        axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)  # (3, 3), one a column
        rotations.append((axes * _FLIP_YZ).T)
        centers.append(matrix[:3, 3])
    return np.array(rotations).reshape(-1, 3, 3), np.array(centers).reshape(-1, 3)


def automatic_plane(frame: bpy.types.Object) -> tuple[Plane, str]:
    """Find the ground of a result; return the plane and the rule used.

    Up comes from the cameras. The ground is the main level plane of the meshes; if none is clear,
    it passes through their lowest point; without meshes, through the regions' lowest corner. Raises
    UsageError: the cameras do not determine up, or nothing determines the ground.
    """
    up, rule = camera_up(*camera_poses(frame))
    meshes = [c for c in frame.children if addon.kind_of(c) == "mesh" and c.type == "MESH"]
    surface = [_triangles(mesh) for mesh in meshes]
    corners = np.concatenate([np.zeros((0, 3, 3)), *surface])  # (f, 3, 3)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1)
    normals = cross / np.maximum(length, 1e-300)[:, None]
    plane = find_ground_plane(corners.mean(1), normals, 0.5 * length, up)
    if plane is not None:
        return plane, f"Up by {rule}, ground by the main plane"
    # A mesh that the region cuts off below ends at the region's lowest face.
    points, what = corners.reshape(-1, 3), "lowest point of the meshes"
    if len(points) == 0:
        regions = [hull_in_blender(c)[0] for c in frame.children if addon.kind_of(c) == "region"]
        points, what = np.concatenate([np.zeros((0, 3)), *regions]), "lowest corner of the regions"
    if len(points) == 0:
        raise UsageError(
            "The result has neither mesh nor region to find the ground by.",
            "Import the result again.",
        )
    middle = points.mean(0)
    lowest = float(((points - middle) @ up).min())
    return Plane(middle + lowest * up, up), f"Up by {rule}, ground by the {what}"


def _triangles(thing: bpy.types.Object) -> np.ndarray:
    """Return the (f, 3, 3) corners of an object's triangles in Blender's world."""
    mesh = mesh_of(thing)
    mesh.calc_loop_triangles()
    corners = values_of(mesh.loop_triangles, "vertices", 3, np.int32)
    vertices = values_of(mesh.vertices, "co", 3, np.float32)
    placed = transformed(matrix_of(thing), vertices.reshape(-1, 3).astype(np.float64))
    return placed[corners].reshape(-1, 3, 3)


# -- Points picked on a result: selected vertices in Edit Mode, or selected empties ---------------


# Size of a new point's cross, in scene units: a hundredth of the cameras' reach.
_POINT_SIZE = 0.05


def point_empties(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected empties that are points: no region, no parent of a result."""
    empties = (thing for thing in context.selected_objects if thing.type == "EMPTY")
    return [thing for thing in empties if addon.kind_of(thing) in ("", "point")]


def picked_points(context: bpy.types.Context, frame: bpy.types.Object) -> np.ndarray:
    """Return the points picked on the result of ``frame``.

    In Edit Mode the selected vertices of its meshes, else the selected empties; one without
    a parent becomes a child of the frame in place, so that it moves along.

    Returns ``points``, (n, 3) float64: Blender's world.
    Raises UsageError: a mesh in Edit Mode, or an empty, belongs to something else.
    """
    if context.mode == "EDIT_MESH":
        found = [_selected_vertices(thing, frame) for thing in context.objects_in_mode]
        return np.concatenate([np.zeros((0, 3)), *found])
    empties = point_empties(context)
    for thing in empties:
        if thing.parent is None:
            _adopt(thing, frame)
        elif addon.frame_of(thing) != frame:
            raise UsageError(
                f"{thing.name} belongs to {thing.parent.name}, not to {frame.name}.",
                "Clear its parent (Alt P).",
            )
    matrices = [matrix_of(thing) for thing in empties]
    return np.array([matrix[:3, 3] for matrix in matrices]).reshape(-1, 3)


def _selected_vertices(thing: bpy.types.Object, frame: bpy.types.Object) -> np.ndarray:
    vertices = [v.co[:] for v in bmesh.from_edit_mesh(mesh_of(thing)).verts if v.select]
    if vertices and addon.frame_of(thing) != frame:
        raise UsageError(
            f"{thing.name} is not part of the result under {frame.name}.",
            "Pick on a mesh of the result, or put points with Add Point.",
        )
    return transformed(matrix_of(thing), np.array(vertices, np.float64).reshape(-1, 3))


def _adopt(thing: bpy.types.Object, frame: bpy.types.Object) -> None:
    local = transformed(scene_from_blender(frame), matrix_of(thing)[None, :3, 3])[0]
    thing.parent = frame
    thing.matrix_parent_inverse.identity()
    thing.location = local.tolist()
    thing[addon.KIND] = "point"
    bpy.context.view_layer.update()


def add_point(context: bpy.types.Context, frame: bpy.types.Object) -> bpy.types.Object:
    """Add a point under the frame at the 3D cursor; it and other points stay selected."""
    cursor = np.array(context.scene.cursor.location, np.float64)
    keep = point_empties(context)
    for thing in context.selected_objects:
        thing.select_set(thing in keep)
    point = bpy.data.objects.new("Point", None)
    point.empty_display_type = "PLAIN_AXES"
    point.empty_display_size = _POINT_SIZE
    point.show_in_front = point.show_name = True
    point.hide_render = True
    point.parent = frame
    point.location = transformed(scene_from_blender(frame), cursor[None])[0].tolist()
    point[addon.KIND] = "point"
    collection = frame.users_collection[0] if frame.users_collection else context.collection
    collection.objects.link(point)
    context.view_layer.update()  # a new object cannot be selected before
    point.select_set(True)
    context.view_layer.objects.active = point
    return point


def release(context: bpy.types.Context) -> None:
    """Leave Edit Mode and deselect the points, so that the next tool starts from none.

    In Edit Mode undo would take back edits of the mesh alone, not the transform of the parent.
    """
    if context.mode == "EDIT_MESH":
        bpy.ops.object.mode_set(mode="OBJECT")
        return
    for thing in point_empties(context):
        thing.select_set(False)


# -- The transform of a result's parent empty: read, set, saved in double beside the result -------


_logger = logging.getLogger(__name__)

MATRIX_TOLERANCE = 1e-5
"""Share by which an object's matrix (single precision, by way of angles) may differ from the
placement that was set."""

# What this session has written, by path, and the empty that it is of: undo takes it back there as
# well. Of two empties of one result the one that wrote last decides.
_written: dict[Path, tuple[str, str]] = {}


def placement_of(frame: bpy.types.Object) -> Similarity:
    """Return ``blender_from_scene``: in double if it was set so, else Blender's matrix.

    Raises UsageError: the empty is scaled differently along its axes, mirrored or has no size.
    """
    matrix = matrix_of(frame)
    stored = _stored(frame)
    if stored is not None and _agrees(matrix, stored):
        return stored
    return similarity_of_matrix(matrix, frame.name)


def scale_of(frame: bpy.types.Object) -> float:
    """Return the scale of a frame of any transform; 1 if it is degenerate."""
    volume = abs(float(np.linalg.det(matrix_of(frame)[:3, :3])))
    return float(np.cbrt(volume)) if np.isfinite(volume) and volume > 0.0 else 1.0


def place(frame: bpy.types.Object, placement: Similarity) -> str:
    """Set the transform of a frame to ``placement``, and save it beside the result.

    Nothing but the empty is moved; clipping and frustum size of the photo cameras follow its
    scale, since Blender does not let them.

    Returns ``note``: why the placement could not be saved beside the result; ``""`` if it was.
    Raises UsageError: the scale is out of range, or something else holds the empty in place.
    """
    check_scale(placement)
    before = frame.matrix_basis.copy()
    _set_matrix(frame, placement)
    if not _agrees(matrix_of(frame), placement):
        frame.matrix_basis = before
        bpy.context.view_layer.update()
        raise UsageError(
            f"{frame.name} is held in place by a constraint, a driver or its parent.",
            "Remove it, or use it on a parent of a result that is free.",
        )
    for camera in cameras_under(frame):
        scale_display(camera, placement.scale)
    frame[addon.PLACEMENT] = json.dumps(placement.to_json())
    return _keep(frame, placement)


def first_placement(frame: bpy.types.Object) -> Similarity:
    """Return where the frame's result lies before it is placed: in metres where it has them."""
    with contextlib.suppress(OSError, UsageError, ParseError, AttributeError):
        folder = real_path(addon.result_folder(frame))
        if addon.is_trusted(folder.parent):
            record = read_json(folder / "scene.json").get("georeference")
            return blender_start(record, addon.world_from_scene(frame)) or Similarity()
    return Similarity()


def restore(frame: bpy.types.Object, placement: Similarity) -> None:
    """Apply the placement saved beside its result to a new frame."""
    _set_matrix(frame, placement)
    frame[addon.PLACEMENT] = json.dumps(placement.to_json())


def _set_matrix(frame: bpy.types.Object, placement: Similarity) -> None:
    bpy.context.view_layer.update()  # where it has a parent, Blender needs that one's matrix
    frame.matrix_world = Matrix(placement.matrix().tolist())
    bpy.context.view_layer.update()


def _stored(frame: bpy.types.Object) -> Similarity | None:
    with contextlib.suppress(KeyError, TypeError, ValueError, RecursionError):
        stored = Similarity.from_json(json.loads(frame[addon.PLACEMENT]))
        if np.isfinite(stored.matrix()).all():
            return stored
    return None


def _agrees(matrix: np.ndarray, placement: Similarity) -> bool:
    wanted = placement.matrix()
    linear = np.abs(matrix[:3, :3] - wanted[:3, :3]).max()
    moved = np.abs(matrix[:3, 3] - wanted[:3, 3]).max()
    reach = placement.scale + float(np.abs(wanted[:3, 3]).max())
    return bool(linear <= MATRIX_TOLERANCE * placement.scale and moved <= MATRIX_TOLERANCE * reach)


def _keep(frame: bpy.types.Object, placement: Similarity) -> str:
    """Write the placement beside the result; the folder is one that a .blend names."""
    lost = "The placement is saved in this .blend file only"
    try:
        folder = real_path(addon.result_folder(frame))
        world_from_scene = addon.world_from_scene(frame)
    except UsageError as error:
        return f"{lost}: {error}"
    if not addon.is_trusted(folder.parent):
        return f"{lost}: import the result from {folder} to keep it there too."
    if not (folder / "scene.json").is_file():
        return f"{lost}: {folder} does not exist."
    path = folder / FILE_NAME
    try:
        write_placement(path, placement, world_from_scene)
    except UsageError as error:
        return f"{lost}: {error}"
    _written[path] = frame.name, frame[addon.PLACEMENT]
    return ""


@persistent
def after_load(_arguments: object = None, _unused: object = None) -> None:
    """``load_post``: undo steps of the file before are gone."""
    _written.clear()


@persistent
def after_undo(_scene: object = None, _unused: object = None) -> None:
    """``undo_post``, ``redo_post``: what this session wrote beside a result follows."""
    for frame in bpy.data.objects:
        if addon.kind_of(frame) != "frame" or frame.library is not None or not _written:
            continue
        try:
            path = real_path(addon.result_folder(frame)) / FILE_NAME
            world_from_scene = addon.world_from_scene(frame)
        except UsageError:
            continue
        name, text = _written.get(path, ("", ""))
        if frame.name != name or text == frame.get(addon.PLACEMENT, ""):
            continue
        # Before its first placement, a scene lies as it was trained.
        try:
            write_placement(path, _stored(frame) or Similarity(), world_from_scene)
            _written[path] = name, frame.get(addon.PLACEMENT, "")
        except UsageError:
            _logger.exception("the placement beside the result is not the one in Blender")


# -- Scene tools: true scale, ground, up and origin of a result, by its parent empty alone --------


_TARGETS: Final = (
    ("POINTS", "At Picked Points", "The middle of the selected vertices or points"),
    ("CURSOR", "At 3D Cursor", "Where the 3D cursor is"),
)


class _Tool(NeedsResult):
    """Mixin: a tool for Object Mode, and for vertices of a mesh in Edit Mode."""

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if context.mode not in ("OBJECT", "EDIT_MESH"):
            return "Leave the current mode first"
        return super().why_not(context)

    def apply(
        self, context: bpy.types.Context, frame: bpy.types.Object, step: Similarity, done: str
    ) -> None:
        """Apply a step to the placement of the frame."""
        placement = step.after(placement_of(frame))
        release(context)
        note = place(frame, placement)
        self.report({"WARNING"} if note else {"INFO"}, f"{done}. {note}".strip())


class GWRAP_OT_add_point(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.add_point"
    bl_label = "Add Point"
    bl_description = (
        "Put a point at the 3D cursor (Shift and right click on the mesh), for scale, ground or "
        "origin"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if context.mode != "OBJECT":
            return "In Edit Mode, select vertices instead"
        return super().why_not(context)

    def work(self, context: bpy.types.Context) -> None:
        add_point(context, needed_frame(context))


class GWRAP_OT_set_scale(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.set_scale"
    bl_label = "Set Scale"
    bl_description = (
        "Scale the result so that two selected vertices or points have the distance you type"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    distance: FloatProperty(  # type: ignore[valid-type]
        name="True Distance",
        description="Distance of the two points; units may be typed, such as 35 cm",
        default=1.0, min=0.0, soft_min=1e-3, precision=4, subtype="DISTANCE", unit="LENGTH",
        options={"SKIP_SAVE"},
    )  # fmt: skip

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        try:
            points = picked_points(context, needed_frame(context))
            scale_step(points, 1.0)
        except WrapError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if not self.properties.is_property_set("distance"):
            self.distance = float(np.linalg.norm(points[1] - points[0]))
        return context.window_manager.invoke_props_dialog(self)

    def work(self, context: bpy.types.Context) -> None:
        frame = needed_frame(context)
        step = scale_step(picked_points(context, frame), self.distance)
        self.apply(context, frame, step, f"Scaled by {step.scale:.6g}")


class GWRAP_OT_set_ground(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.set_ground"
    bl_label = "Set Ground"
    bl_description = (
        "Lay the plane through three or more selected vertices or points on the floor (Z = 0); "
        "the cameras' side becomes up"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    flip: BoolProperty(  # type: ignore[valid-type]
        name="Flip", description="The other side of the plane is up", options={"SKIP_SAVE"}
    )

    def work(self, context: bpy.types.Context) -> None:
        frame = needed_frame(context)
        plane = plane_through(picked_points(context, frame), camera_poses(frame)[1])
        if self.flip:
            plane = Plane(plane.point, -plane.normal)
        self.apply(context, frame, ground_step(plane), "The points lie on the ground")


class GWRAP_OT_auto_ground(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.auto_ground"
    bl_label = "Auto Ground"
    bl_description = (
        "Find up from how the cameras were held, and the ground from the main level plane of the "
        "meshes; where none is clear, from their lowest point"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def work(self, context: bpy.types.Context) -> None:
        frame = needed_frame(context)
        release(context)  # edits of a mesh reach its data when Edit Mode ends
        plane, how = automatic_plane(frame)
        self.apply(context, frame, ground_step(plane), how)


class GWRAP_OT_set_origin(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.set_origin"
    bl_label = "Set Origin"
    bl_description = "Move the result so that this point becomes the world origin"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    target: EnumProperty(name="Target", items=_TARGETS, default="POINTS")  # type: ignore[valid-type]

    def work(self, context: bpy.types.Context) -> None:
        frame = needed_frame(context)
        if self.target == "CURSOR":
            point = np.array(context.scene.cursor.location, np.float64)
        else:
            points = picked_points(context, frame)
            if len(points) == 0:
                raise UsageError("No point is picked.", "Select a vertex or a point.")
            point = points.mean(0)
        self.apply(context, frame, origin_step(point), "The point is the origin")


class GWRAP_OT_keep_placement(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.keep_placement"
    bl_label = "Keep Placement"
    bl_description = (
        "Save the location, rotation and scale of the result's parent beside the result, so that "
        "later imports place it the same way"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def work(self, context: bpy.types.Context) -> None:
        self.apply(context, needed_frame(context), Similarity(), "The placement is saved")


class GWRAP_OT_reset_placement(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.reset_placement"
    bl_label = "Reset Placement"
    bl_description = (
        "Undo scale, ground and origin: place the result as trained, or in the metres that GPS, "
        "markers or control points gave it"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def work(self, context: bpy.types.Context) -> None:
        frame = needed_frame(context)
        release(context)
        note = place(frame, first_placement(frame))
        if note:
            self.report({"WARNING"}, note)


CLASSES: Final = (
    GWRAP_OT_add_point, GWRAP_OT_set_scale, GWRAP_OT_set_ground, GWRAP_OT_auto_ground,
    GWRAP_OT_set_origin, GWRAP_OT_keep_placement, GWRAP_OT_reset_placement,
)  # fmt: skip

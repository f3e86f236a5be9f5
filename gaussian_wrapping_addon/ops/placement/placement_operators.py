# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene tools: true scale, ground, up and origin of a result, by its parent empty alone."""

from typing import Final

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatProperty

from ...core.dataset.frames.placement import (
    Plane,
    ground_step,
    origin_step,
    plane_through,
    scale_step,
)
from ...core.dataset.similarity import Similarity
from ...core.errors import UsageError, WrapError
from ..common import tags
from ..common.error_reporting import NeedsResult, OperatorResult, ReportsErrors
from .automatic_ground import automatic_plane, camera_poses
from .picked_points import add_point, picked_points, release
from .placement import first_placement, place, placement_of

_TARGETS: Final = (
    ("POINTS", "At Picked Points", "The middle of the selected vertices or points"),
    ("CURSOR", "At 3D Cursor", "Where the 3D cursor is"),
)


class _Tool(NeedsResult, ReportsErrors):
    """Mixin: a tool for Object Mode, and for vertices of a mesh in Edit Mode."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Return whether the tool can run; Blender calls this."""
        if context.mode not in ("OBJECT", "EDIT_MESH"):
            cls.poll_message_set("Leave the current mode first")
            return False
        return super().poll(context)

    def frame(self, context: bpy.types.Context) -> bpy.types.Object:
        """Return the parent empty that the tool transforms."""
        frame = tags.current_frame(context.scene, context.view_layer.objects.active)
        if frame is None:
            raise UsageError("The scene has no result.", "Wrap the scene or import a result.")
        return frame

    def apply(
        self, context: bpy.types.Context, frame: bpy.types.Object, step: Similarity, done: str
    ) -> OperatorResult:
        """Apply a step to the placement of the frame."""
        placement = step.after(placement_of(frame))
        release(context)
        note = place(frame, placement)
        self.report({"WARNING"} if note else {"INFO"}, f"{done}. {note}".strip())
        return {"FINISHED"}


class GWRAP_OT_add_point(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.add_point"
    bl_label = "Add Point"
    bl_description = (
        "Put a point at the 3D cursor (Shift and right click on the mesh), for scale, ground or "
        "origin"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT":
            cls.poll_message_set("In Edit Mode, select vertices instead")
            return False
        return super().poll(context)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        add_point(context, self.frame(context))
        return {"FINISHED"}


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
        default=1.0,
        min=0.0,
        soft_min=1e-3,
        precision=4,
        subtype="DISTANCE",
        unit="LENGTH",
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        try:
            points = picked_points(context, self.frame(context))
            scale_step(points, 1.0)
        except WrapError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if not self.properties.is_property_set("distance"):
            self.distance = float(np.linalg.norm(points[1] - points[0]))
        return context.window_manager.invoke_props_dialog(self)

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame = self.frame(context)
        step = scale_step(picked_points(context, frame), self.distance)
        return self.apply(context, frame, step, f"Scaled by {step.scale:.6g}")


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

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame = self.frame(context)
        plane = plane_through(picked_points(context, frame), camera_poses(frame)[1])
        if self.flip:
            plane = Plane(plane.point, -plane.normal)
        return self.apply(context, frame, ground_step(plane), "The points lie on the ground")


class GWRAP_OT_auto_ground(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.auto_ground"
    bl_label = "Auto Ground"
    bl_description = (
        "Find up from how the cameras were held, and the ground from the main level plane of the "
        "meshes; where none is clear, from their lowest point"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame = self.frame(context)
        release(context)  # edits of a mesh reach its data when Edit Mode ends
        plane, how = automatic_plane(frame)
        return self.apply(context, frame, ground_step(plane), how)


class GWRAP_OT_set_origin(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.set_origin"
    bl_label = "Set Origin"
    bl_description = "Move the result so that this point becomes the world origin"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    target: EnumProperty(name="Target", items=_TARGETS, default="POINTS")  # type: ignore[valid-type]

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame = self.frame(context)
        if self.target == "CURSOR":
            point = np.array(context.scene.cursor.location, np.float64)
        else:
            points = picked_points(context, frame)
            if len(points) == 0:
                raise UsageError("No point is picked.", "Select a vertex or a point.")
            point = points.mean(0)
        return self.apply(context, frame, origin_step(point), "The point is the origin")


class GWRAP_OT_keep_placement(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.keep_placement"
    bl_label = "Keep Placement"
    bl_description = (
        "Save the location, rotation and scale of the result's parent beside the result, so that "
        "later imports place it the same way"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def work(self, context: bpy.types.Context) -> OperatorResult:
        return self.apply(context, self.frame(context), Similarity(), "The placement is saved")


class GWRAP_OT_reset_placement(_Tool, bpy.types.Operator):
    bl_idname = "gwrap.reset_placement"
    bl_label = "Reset Placement"
    bl_description = (
        "Undo scale, ground and origin: place the result as trained, or in the metres that GPS, "
        "markers or control points gave it"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def work(self, context: bpy.types.Context) -> OperatorResult:
        frame = self.frame(context)
        release(context)
        note = place(frame, first_placement(frame))
        if note:
            self.report({"WARNING"}, note)
        return {"FINISHED"}


CLASSES: Final = (
    GWRAP_OT_add_point,
    GWRAP_OT_set_scale,
    GWRAP_OT_set_ground,
    GWRAP_OT_auto_ground,
    GWRAP_OT_set_origin,
    GWRAP_OT_keep_placement,
    GWRAP_OT_reset_placement,
)

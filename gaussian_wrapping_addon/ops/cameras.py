# SPDX-License-Identifier: GPL-3.0-or-later
"""Photo cameras as Blender cameras."""

import contextlib
from pathlib import Path
from typing import Any, Final, cast

import bpy
import numpy as np
from bpy.props import IntProperty
from mathutils import Matrix

from ..core.errors import DatasetError, UsageError
from ..core.files import real_path, resolve_inside
from ..core.scene.camera import Camera
from . import addon
from .addon import NeedsResult

# -- Pinhole cameras as Blender cameras with the same projection ----------------------------------


SENSOR_MM = 36.0
CLIP_START, CLIP_END = 0.01, 1000.0
"""In scene units: the cameras of a scene stand within 5 of its middle."""
STAGES = "stages"
"""Folder of a job that holds what it made, undistorted photos among it."""
PHOTO_ALPHA = 0.7
"""Opacity of the photo behind the mesh, so that the viewport's grid stays visible."""

# Ours looks along +z with y down, Blender's along -z with y up.
_CAM_FROM_BLENDER_CAM = np.diag([1.0, -1.0, -1.0, 1.0])


def set_projection(data: bpy.types.Camera, camera: Camera) -> None:
    """Set lens, sensor and shift so that a render of the photo's size projects as the photo."""
    aspect = camera.fx / camera.fy  # height of a pixel over its width
    horizontal = camera.width >= aspect * camera.height
    data.type = "PERSP"
    data.lens_unit = "MILLIMETERS"
    data.sensor_fit = "HORIZONTAL" if horizontal else "VERTICAL"
    data.sensor_width = SENSOR_MM
    data.sensor_height = SENSOR_MM
    extent_px = camera.width if horizontal else aspect * camera.height
    data.lens = camera.fx / extent_px * SENSOR_MM
    data.shift_x = (0.5 * camera.width - camera.cx) / extent_px
    data.shift_y = aspect * (camera.cy - 0.5 * camera.height) / extent_px


def create_camera(
    camera: Camera, photo: str, display_size: float, collection: bpy.types.Collection
) -> bpy.types.Object:
    """Make a camera object; size and pixel aspect of its photo are custom properties.

    The render size belongs to the scene in Blender, so that :func:`look_through` sets it.
    """
    data = bpy.data.cameras.new(camera.name)
    set_projection(data, camera)
    data.clip_start, data.clip_end = CLIP_START, CLIP_END
    data.display_size = display_size
    thing = bpy.data.objects.new(camera.name, data)
    scene_from_cam = np.eye(4)
    scene_from_cam[:3, :3] = camera.rotation.T
    scene_from_cam[:3, 3] = camera.center
    thing.matrix_basis = Matrix((scene_from_cam @ _CAM_FROM_BLENDER_CAM).tolist())
    aspect = camera.fx / camera.fy
    thing[addon.KIND] = "camera"
    thing[addon.PHOTO] = photo
    thing[addon.RESOLUTION] = [int(camera.width), int(camera.height)]
    # Blender's pixel aspects are at least 1.
    thing[addon.PIXEL_ASPECT] = [1.0, aspect] if aspect >= 1.0 else [1.0 / aspect, 1.0]
    collection.objects.link(thing)
    return thing


def look_through(scene: bpy.types.Scene, thing: bpy.types.Object) -> None:
    """Make a photo's camera the scene's camera, and the render as large as the photo."""
    width, height = thing[addon.RESOLUTION]
    render = scene.render
    render.resolution_x, render.resolution_y = int(width), int(height)
    render.resolution_percentage = 100
    render.pixel_aspect_x, render.pixel_aspect_y = thing[addon.PIXEL_ASPECT]
    scene.camera = thing


def scale_display(thing: bpy.types.Object, scale: float) -> None:
    """Bring clipping and frustum of a camera in proportion to a scene of this scale.

    Blender frees a camera's matrix of its scale: neither of the two follows the parent's.
    """
    known = thing.get(addon.DISPLAY_SCALE, 1.0)
    ratio = scale / (known if isinstance(known, float) and known > 0.0 else 1.0)
    data = cast(bpy.types.Camera, thing.data)
    data.clip_start *= ratio
    data.clip_end *= ratio
    data.display_size *= ratio
    thing[addon.DISPLAY_SCALE] = scale


def cameras_under(frame: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the photo cameras of a result in the order of their photos' paths."""
    cameras = [c for c in frame.children if addon.kind_of(c) == "camera"]
    found = [c for c in cameras if c.get(addon.RESOLUTION) is not None]
    return sorted(found, key=lambda c: str(c.get(addon.PHOTO, "")))


def bring_forward(frame: bpy.types.Object, thing: bpy.types.Object) -> None:
    """Make one photo camera visible while the collection of all of them is hidden.

    Blender draws the photo behind the view of a visible camera only: the camera joins the
    collection of the result, and the one that was there before leaves it.
    """
    if not frame.users_collection:
        return
    collection = frame.users_collection[0]
    for other in cameras_under(frame):
        if other != thing and len(other.users_collection) > 1 and other in collection.objects[:]:
            collection.objects.unlink(other)
    if thing not in collection.objects[:]:
        collection.objects.link(thing)


def photo_of(thing: bpy.types.Object) -> Path:
    """Return the path of a camera's photo; in a job folder that was moved, where it is now."""
    path = Path(str(thing.get(addon.PHOTO, "")))
    frame = addon.frame_of(thing)
    if frame is None or addon.is_remote(path) or path.is_file() or STAGES not in path.parts:
        return path
    # Photos that had to be straightened lie in a stage of the job.
    last = len(path.parts) - 1 - path.parts[::-1].index(STAGES)
    with contextlib.suppress(UsageError):
        job = real_path(addon.result_folder(frame)).parent
        return resolve_inside(job, "/".join(path.parts[last:])) or path
    return path


def show_photo(thing: bpy.types.Object) -> None:
    """Show a camera's photo behind what it sees; the file is read when it is drawn, not packed.

    Raises DatasetError: the photo is not there.
    """
    path = photo_of(thing)
    hint = "Restore it, or look through the camera without it."
    if addon.is_remote(path) or not path.is_file():
        raise DatasetError(f"The photo {path} does not exist.", hint)
    try:
        image = bpy.data.images.load(str(path), check_existing=True)
    except RuntimeError as error:
        raise DatasetError(f"The photo {path} cannot be read: {error}.", hint) from None
    data = cast(bpy.types.Camera, thing.data)
    if not data.background_images:
        data.background_images.new().alpha = PHOTO_ALPHA
    background = data.background_images[0]
    background.frame_method = "STRETCH"  # the frame has the photo's shape
    background.image = image
    data.show_background_images = True


# -- Look through the photo cameras, one after another, with their photos behind the mesh ---------


class GWRAP_OT_view_photo(NeedsResult, bpy.types.Operator):
    bl_idname = "gwrap.view_photo"
    bl_label = "Look Through Camera"
    bl_description = (
        "Look through a photo's camera with the photo behind the mesh; the render gets the "
        "photo's size and pixel aspect"
    )
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - Blender's convention

    step: IntProperty(  # type: ignore[valid-type]
        name="Step",
        description="0: the selected photo camera; otherwise photos to step from the current one",
        options={"SKIP_SAVE"},
    )

    def work(self, context: bpy.types.Context) -> None:
        frame, thing = self._camera(context)
        bring_forward(frame, thing)
        look_through(context.scene, thing)
        for area in context.screen.areas if context.screen else ():
            if area.type == "VIEW_3D":
                view: Any = area.spaces.active
                view.region_3d.view_perspective = "CAMERA"
        try:
            show_photo(thing)
        except DatasetError as error:
            self.report({"WARNING"}, str(error))

    def _camera(self, context: bpy.types.Context) -> tuple[bpy.types.Object, bpy.types.Object]:
        active = context.view_layer.objects.active
        frame = addon.current_frame(context)
        cameras = cameras_under(frame) if frame is not None else []
        if frame is None or not cameras:
            raise UsageError("The result has no photo cameras.", "Import the result again.")
        present = context.scene.camera
        if self.step == 0:
            return frame, next((c for c in (active, present) if c in cameras), cameras[0])
        if present not in cameras:
            return frame, cameras[0 if self.step > 0 else -1]
        return frame, cameras[(cameras.index(present) + self.step) % len(cameras)]


CLASSES: Final = (GWRAP_OT_view_photo,)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Pinhole cameras as Blender cameras with the same projection."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ..core.dataset.camera import Camera
from . import tags

SENSOR_MM = 36.0

# Ours looks along +z with y down, Blender's along -z with y up (conventions.md C.6).
_CAM_FROM_BLENDER_CAM = np.diag([1.0, -1.0, -1.0, 1.0])


def camera_matrix(camera: Camera) -> np.ndarray:
    """Return the (4, 4) float64 matrix of the Blender camera in the scene frame."""
    scene_from_cam = np.eye(4)
    scene_from_cam[:3, :3] = camera.rotation.T
    scene_from_cam[:3, 3] = camera.center
    return scene_from_cam @ _CAM_FROM_BLENDER_CAM


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
    data.clip_start, data.clip_end = 0.01, 1000.0
    data.display_size = display_size
    thing = bpy.data.objects.new(camera.name, data)
    thing.matrix_basis = Matrix(camera_matrix(camera).tolist())
    aspect = camera.fx / camera.fy
    thing[tags.KIND] = "camera"
    thing[tags.PHOTO] = photo
    thing[tags.RESOLUTION] = [int(camera.width), int(camera.height)]
    # Blender's pixel aspects are at least 1.
    thing[tags.PIXEL_ASPECT] = [1.0, aspect] if aspect >= 1.0 else [1.0 / aspect, 1.0]
    collection.objects.link(thing)
    return thing


def look_through(scene: bpy.types.Scene, thing: bpy.types.Object) -> None:
    """Make a photo's camera the scene's camera, and the render as large as the photo."""
    width, height = thing[tags.RESOLUTION]
    render = scene.render
    render.resolution_x, render.resolution_y = int(width), int(height)
    render.resolution_percentage = 100
    render.pixel_aspect_x, render.pixel_aspect_y = thing[tags.PIXEL_ASPECT]
    scene.camera = thing

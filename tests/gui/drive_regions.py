# SPDX-License-Identifier: GPL-3.0-or-later
"""Regions in a real Blender with a window: thick edges, and a cage that is dragged.

``blender --enable-event-simulate ... -P drive_regions.py``; ``GW_GUI_FOLDER`` holds ``result/``
and takes screenshots and ``outcome.json``. Real mouse and keys are
ignored while events are simulated, so that this is a run of its own.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d as on_screen
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).parent))
import driving
from driving import FOLDER, check, objects, press, screenshot, view


def drag(begin: Vector, end: Vector, *, cancel: bool = False) -> Iterator[float]:
    """Drag with the left button from one place of the 3D view to another, in pixels."""
    window, _, region = view()
    corner = Vector((region.x, region.y))

    def event(kind: str, value: str, place: Vector) -> None:
        x, y = corner + place
        window.event_simulate(type=kind, value=value, x=round(x), y=round(y))

    for step in range(3):  # the handle under the mouse is found while the mouse moves
        event("MOUSEMOVE", "NOTHING", begin + Vector((step - 2, 0)))
        yield 0.3
    event("LEFTMOUSE", "PRESS", begin)
    yield 0.3
    for step in range(1, 9):
        event("MOUSEMOVE", "NOTHING", begin.lerp(end, step / 8))
        yield 0.15
    if cancel:
        event("ESC", "PRESS", end)
        yield 0.1
        event("ESC", "RELEASE", end)
        yield 0.1
    event("LEFTMOUSE", "RELEASE", end)
    yield 0.8


def side_on_screen(box: bpy.types.Object, axis: int) -> Vector:
    """Return where the middle of a box's positive side is in the 3D view, pixels."""
    _, area, region = view()
    side = Vector((0, 0, 0))
    side[axis] = box.empty_display_size
    return on_screen(region, area.spaces.active.region_3d, box.matrix_world @ side)


def extents(box: bpy.types.Object) -> list[float]:
    return [round(abs(value) * box.empty_display_size, 4) for value in box.scale]


def steps() -> Iterator[float]:
    window, area, region = view()
    yield from driving.open_tab()
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.gwrap.import_result(directory=str(FOLDER / "result"))
    frame = objects("frame")[0]
    frame.rotation_euler, frame.scale = (0.0, 0.0, 0.3), (0.8, 0.8, 0.8)
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=1, radius=0.5, location=(-2.2, 0.6, 0))
    press(bpy.ops.gwrap.use_as_region)
    bpy.context.scene.cursor.location = (2.0, -0.5, 0.0)
    press(bpy.ops.gwrap.add_region_box, around="CURSOR")
    box = bpy.context.view_layer.objects.active
    box.name, box.rotation_euler.z = "Front Door", 0.4
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.view3d.view_all()
    area.spaces.active.region_3d.view_distance *= 1.3
    yield 1.0
    press(bpy.ops.ed.undo_push, message="Before the drag")
    yield 0.5
    screenshot("8-regions")
    before, rotation = extents(box), box.rotation_euler.copy()
    middle = on_screen(region, area.spaces.active.region_3d, box.matrix_world.translation)
    side = side_on_screen(box, 0)
    yield from drag(side, side + 0.8 * (side - middle))
    gizmo = driving.module("ui.region_panel")
    yield from driving.until(lambda: gizmo._drag.before is None, "the drag has ended")
    box = bpy.data.objects["Front Door"]
    screenshot("9-dragged")
    check(extents(box)[0] > 1.2 * before[0], "a dragged side makes the region larger")
    check(extents(box)[1:] == before[1:], "the other sides stay")
    check(box.rotation_euler == rotation, "the rotation stays")
    size = extents(box)
    press(bpy.ops.ed.undo)
    yield 0.5
    box = bpy.data.objects["Front Door"]
    check(extents(box) == before, "one undo takes the drag back")
    press(bpy.ops.ed.redo)
    yield 0.5
    box = bpy.data.objects["Front Door"]
    check(extents(box) == size, "one redo brings it again")


driving.run(steps())

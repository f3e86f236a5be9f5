# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs inside a real Blender with a window: bakes photos onto meshes through the panel.

``blender ... -P drive_bake.py``; ``GW_GUI_FOLDER`` holds ``ball/``, a finished job of a coloured
ball; ``GW_GUI_WORKER`` is the Python of the real worker.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driving
from driving import FOLDER, check, objects, press, screenshot, state_of_job, until

WAIT_S = 240.0


def steps() -> Iterator[float]:
    """The visit; each value is the time to let Blender live."""
    os.environ["GAUSSIAN_WRAPPING_PYTHON"] = os.environ["GW_GUI_WORKER"]
    driving.show_only("bake")
    yield from driving.open_tab()
    press(bpy.ops.gwrap.import_result, directory=str(FOLDER / "ball" / "result"))
    yield 0.5
    bpy.context.scene.gwrap.texture_size = "1024"
    for thing in objects("region") + objects("mesh"):
        thing.hide_set(True)
    add("Suzanne")
    bpy.context.object.location = (0.0, 0.0, 0.0)
    yield 0.8
    screenshot("1-bake")
    check(not bpy.data.objects["Suzanne"].data.uv_layers, "the foreign mesh has no UVs")

    press(bpy.ops.gwrap.bake_photos)
    yield from until(lambda: state_of_job() == "RUNNING", "the bake runs")
    yield from until(lambda: driving.fraction_of_job() > 0.1, "the bar moves", WAIT_S)
    yield 0.5
    screenshot("2-baking")
    yield from until(lambda: bool(photos_on("Suzanne")), "the texture is there", WAIT_S)
    check(state_of_job() == "DONE", "the job is done")
    check(uv_names("Suzanne") == ["Photos"], "the foreign mesh has UVs")
    yield 0.5
    press(bpy.ops.ed.undo)
    yield 0.5
    check(not photos_on("Suzanne") and not uv_names("Suzanne"), "one undo takes the bake back")
    press(bpy.ops.ed.redo)
    yield 0.5
    check(bool(photos_on("Suzanne")), "one redo brings it again")
    driving.frame_view()
    yield 1.0
    screenshot("3-baked")

    bpy.data.objects["Suzanne"].hide_set(True)
    add("Ball")
    bpy.context.scene.gwrap.bake.retopology = "DECIMATE"
    bpy.context.scene.gwrap.bake.faces = 300
    yield 0.5
    press(bpy.ops.gwrap.bake_photos)
    yield from until(lambda: bool(objects("baked")), "a lighter mesh is there", WAIT_S)
    (light,) = objects("baked")
    check(abs(len(light.data.polygons) - 300) <= 6, "it has the faces asked for")
    nodes: Any = light.material_slots[0].material.node_tree.nodes
    check("Normal Map" in nodes, "it has a normal map")
    check(bpy.data.objects["Ball"].hide_get(), "the dense mesh is hidden")
    check(bpy.context.view_layer.objects.active == light, "the lighter one is active instead")
    yield 1.0
    screenshot("4-lighter")

    light.hide_set(True)
    bpy.data.objects["Ball"].hide_set(False)
    select("Ball")
    bpy.context.scene.gwrap.bake.retopology = "QUADS"
    bpy.context.scene.gwrap.bake.quads = 400
    yield 0.5
    press(bpy.ops.gwrap.bake_photos)
    yield from until(lambda: len(objects("baked")) == 2, "a mesh of quads is there", WAIT_S)
    (quads,) = (thing for thing in objects("baked") if thing.name.endswith("quads"))
    sides = [len(polygon.vertices) for polygon in quads.data.polygons]
    check(set(sides) == {4} and 280 < len(sides) < 440, "it has about the quads asked for")
    nodes = quads.material_slots[0].material.node_tree.nodes
    check("Normal Map" in nodes, "the quads have a normal map")
    driving.frame_view()
    yield 1.0
    screenshot("5-quads")


def select(name: str) -> None:
    """Select one object alone, as a click does."""
    press(bpy.ops.object.select_all, action="DESELECT")
    thing: Any = bpy.data.objects[name]
    thing.select_set(True)
    bpy.context.view_layer.objects.active = thing


def add(name: str) -> None:
    """Add a mesh as people do: one of Blender's own, without UVs, as large as the ball."""
    if name == "Suzanne":
        press(bpy.ops.mesh.primitive_monkey_add, size=2.0)
    else:
        press(bpy.ops.mesh.primitive_ico_sphere_add, subdivisions=4, radius=1.0)
    thing: Any = bpy.context.view_layer.objects.active
    thing.name = name
    thing.location = (0.0, 0.0, 0.0)
    for layer in list(thing.data.uv_layers):
        thing.data.uv_layers.remove(layer)
    press(bpy.ops.ed.undo_push, message="Add")


def photos_on(name: str) -> list[str]:
    """Return the textures that an object shows; found anew, as undo replaces objects."""
    slots = bpy.data.objects[name].material_slots
    return [
        node.image.name
        for slot in slots
        if slot.material is not None
        for node in slot.material.node_tree.nodes
        if node.bl_idname == "ShaderNodeTexImage"
    ]


def uv_names(name: str) -> list[str]:
    """Return the names of an object's UV maps."""
    mesh: Any = bpy.data.objects[name].data
    return [layer.name for layer in mesh.uv_layers]


driving.run(steps())

# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs inside a real Blender with a window: uses the panel as a person does, step by step.

``blender ... -P drive_blender.py``; ``GW_GUI_FOLDER`` holds ``photos/``; the worker is the fake one
of ``tests/blender/fake_worker.py``, whose behaviour ``GW_FAKE`` chooses.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driving
from driving import (
    FOLDER,
    check,
    execute,
    fraction_of_job,
    kinds,
    press,
    screenshot,
    state_of_job,
    until,
)


def steps() -> Iterator[float]:
    """The visit; each value is the time to let Blender live."""
    yield from driving.open_tab()
    bpy.context.scene.gwrap.source = str(FOLDER / "photos")
    yield 0.5
    screenshot("1-start")

    os.environ["GW_FAKE"] = "slow"
    press(bpy.ops.gwrap.wrap_scene)
    yield from until(lambda: state_of_job() == "RUNNING", "the job runs")
    yield from until(lambda: fraction_of_job() > 0.2, "the timer sees progress")
    points = driving.module("ui.job_view")
    yield from until(lambda: points._drawing.batch is not None, "the training's points are drawn")
    check(not points.VIEW.failed, "without an error")
    bar = driving.module("ui.job_view")
    check(len(bar.running_jobs()) == 1 and not bar._failed, "the status bar shows the job")
    driving.execute(bpy.ops.view3d.view_axis, type="FRONT")
    yield 1.0
    screenshot("2-running")
    bpy.context.scene.gwrap.show_points = False
    driving.module("ops.addon").redraw()  # a click does that; an assignment does not
    yield from until(lambda: points._drawing.batch is None, "the points are switched off")
    bpy.context.scene.gwrap.show_points = True
    press(bpy.ops.gwrap.cancel_job)
    yield from until(lambda: state_of_job() == "CANCELLED", "the job is cancelled")
    yield 0.5
    check(points._drawing.batch is None, "the points have gone with the job")
    check(bar.running_jobs() == [], "the status bar is empty")
    screenshot("3-cancelled")

    os.environ["GW_FAKE"] = "refuse"
    press(bpy.ops.gwrap.resume_job)
    yield from until(lambda: state_of_job() == "FAILED", "the job fails")
    yield 0.5
    screenshot("4-failed")

    os.environ["GW_FAKE"] = "quick"
    press(bpy.ops.gwrap.resume_job)
    yield from until(lambda: state_of_job() == "DONE", "the job is done")
    yield from until(lambda: "mesh" in kinds(), "the result is imported")
    yield 0.5
    press(bpy.ops.ed.undo)
    yield 0.5
    check("mesh" not in kinds(), "one undo takes the import back")
    check(bpy.context.scene.gwrap.job_folder != "", "undo keeps the job")
    press(bpy.ops.ed.redo)
    yield 0.5
    check(kinds() == ["camera"] * 4 + ["frame", "mesh", "region"], "one redo brings it again")

    bpy.context.scene.cursor.location = (0.9, -0.6, 0.2)
    press(bpy.ops.gwrap.add_region_box, around="CURSOR")
    box = bpy.context.view_layer.objects.active
    check(box is not None and box["gwrap_kind"] == "region", "a region box is added")
    box.name, box.rotation_euler.z = "Front Door", 0.4
    bpy.context.scene.gwrap.resolution = "EDGE_LENGTH"
    yield 0.3
    press(bpy.ops.gwrap.mesh_region)
    yield from until(lambda: kinds().count("mesh") == 2, "the region is meshed and imported")
    check(kinds().count("region") == 2, "its box is not doubled")
    driving.frame_view()
    yield 0.8
    screenshot("5-result")
    for collection in bpy.data.collections:
        collection.hide_viewport = False
    yield 0.3
    camera = next(o for o in bpy.data.objects if o.get("gwrap_kind") == "camera")
    bpy.context.view_layer.objects.active = camera
    press(bpy.ops.gwrap.view_photo)
    yield 0.8
    check(bpy.context.scene.camera == camera, "the view looks through the photo's camera")
    screenshot("6-camera")
    yield from placing()
    if os.environ.get("GW_GUI_PREFERENCES"):
        press(bpy.ops.gwrap.check_worker)
        press(bpy.ops.screen.userpref_show, section="ADDONS")
        bpy.context.window_manager.addon_search = "gaussian"
        yield 8.0
        screenshot("7-preferences")


def frame() -> bpy.types.Object:
    """Find the parent empty anew: undo replaces objects."""
    return next(o for o in bpy.data.objects if o.get("gwrap_kind") == "frame")


def placing() -> Iterator[float]:
    """Scale and ground; undo from Edit Mode takes the parent's transform back."""
    mesh = next(o for o in bpy.data.objects if o.get("gwrap_kind") == "mesh")
    bpy.context.view_layer.objects.active = mesh
    press(bpy.ops.object.mode_set, mode="EDIT")
    press(bpy.ops.mesh.select_all, action="SELECT")
    yield 0.3
    execute(bpy.ops.gwrap.set_ground)
    check(bpy.context.mode == "OBJECT", "a tool leaves Edit Mode")
    press(bpy.ops.gwrap.reset_placement)
    for x in (0.0, 0.5):
        bpy.context.scene.cursor.location = (x, 0.0, 0.0)
        press(bpy.ops.gwrap.add_point)
    execute(bpy.ops.gwrap.set_scale, distance=1.5)
    yield 0.3
    check(abs(frame().scale.x - 3.0) < 1e-5, "two points get their distance")
    press(bpy.ops.ed.undo)
    yield 0.3
    check(abs(frame().scale.x - 1.0) < 1e-5, "undo takes the scale back")
    press(bpy.ops.ed.redo)
    yield 0.3
    check(abs(frame().scale.x - 3.0) < 1e-5, "redo brings it again")

    bpy.context.view_layer.objects.active = next(
        o for o in bpy.data.objects if o.get("gwrap_kind") == "mesh"
    )
    press(bpy.ops.object.mode_set, mode="EDIT")
    press(bpy.ops.mesh.select_all, action="SELECT")
    yield 0.3
    before = frame().matrix_world.copy()
    execute(bpy.ops.gwrap.set_origin, target="POINTS")
    bpy.context.scene.cursor.location = (1.0, 2.0, 3.0)
    execute(bpy.ops.gwrap.set_origin, target="CURSOR")
    yield 0.3
    check(frame().matrix_world != before, "the origin is set from Edit Mode")
    for _ in range(2):
        press(bpy.ops.ed.undo)
        yield 0.3
    check(frame().matrix_world == before, "undo takes it back though it began in Edit Mode")
    if bpy.context.mode != "OBJECT":
        press(bpy.ops.object.mode_set, mode="OBJECT")
    yield 0.3
    screenshot("6-placed")


driving.run(steps())

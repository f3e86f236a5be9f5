# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs inside a real Blender with a window: uses the panel as a person does, step by step.

``blender ... -P drive_blender.py``; ``GW_GUI_FOLDER`` holds ``photos/`` and takes screenshots and
``outcome.json``. An error in a timer does not change Blender's exit code, so that the outcome file
tells how it went.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy

FOLDER = Path(os.environ["GW_GUI_FOLDER"])
NAME = "bl_ext.user_default.gaussian_wrapping_addon"
DEADLINE_S = 60.0

outcome: dict[str, object] = {"error": "not finished", "checks": []}


def check(good: bool, what: str) -> None:
    """Note a check; the first that fails ends the run."""
    outcome["checks"].append({"good": bool(good), "what": what})  # type: ignore[union-attr]
    assert good, what


def view() -> tuple[bpy.types.Window, bpy.types.Area, bpy.types.Region]:
    """Return window, 3D view and its main region."""
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    return window, area, next(r for r in area.regions if r.type == "WINDOW")


def press(operator: Callable[..., set[str]], **properties: object) -> None:
    """Run an operator the way a button of the panel does."""
    window, area, region = view()
    with bpy.context.temp_override(window=window, area=area, region=region):
        operator("INVOKE_DEFAULT", True, **properties)


def screenshot(name: str) -> None:
    """Photograph the screen; Blender's own screenshot is black under a virtual display."""
    path = FOLDER / f"{name}.png"
    tool = shutil.which("import")
    if tool:
        subprocess.run([tool, "-window", "root", str(path)], check=True, timeout=30)
    else:
        window, area, region = view()
        with bpy.context.temp_override(window=window, area=area, region=region):
            bpy.ops.screen.screenshot(filepath=str(path))


def until(condition: Callable[[], bool], what: str) -> Iterator[float]:
    """Wait while Blender's own loop runs."""
    end_s = time.monotonic() + DEADLINE_S
    while not condition():
        check(time.monotonic() < end_s, f"in time: {what}")
        yield 0.1
    check(True, what)


def state_of_job() -> str:
    timer = sys.modules[NAME + ".ops.job_timer"]
    status = timer.status_of(bpy.context.scene.gwrap.job_folder)
    return status.state if status else "none"


def fraction_of_job() -> float:
    timer = sys.modules[NAME + ".ops.job_timer"]
    return timer.status_of(bpy.context.scene.gwrap.job_folder).fraction


def kinds() -> list[str]:
    return sorted(str(o.get("gwrap_kind", "")) for o in bpy.data.objects)


def steps() -> Iterator[float]:
    """The visit; each value is the time to let Blender live."""
    window, area, _ = view()
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    area.spaces.active.show_region_ui = True
    yield 0.5
    panel = next(r for r in area.regions if r.type == "UI")
    panel.active_panel_category = "Gaussian Wrapping"
    yield 0.5
    check(panel.active_panel_category == "Gaussian Wrapping", "the tab is there")
    bpy.context.scene.gwrap.source = str(FOLDER / "photos")
    yield 0.5
    screenshot("1-start")

    os.environ["GW_FAKE"] = "slow"
    press(bpy.ops.gwrap.wrap_scene)
    yield from until(lambda: state_of_job() == "RUNNING", "the job runs")
    yield from until(lambda: fraction_of_job() > 0.2, "the timer sees progress")
    yield 0.6
    screenshot("2-running")
    press(bpy.ops.gwrap.cancel_job)
    yield from until(lambda: state_of_job() == "CANCELLED", "the job is cancelled")
    yield 0.5
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
    area.spaces.active.shading.color_type = "TEXTURE"
    window, area, region = view()
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.view3d.view_all()
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
    outcome["error"] = ""


def frame() -> bpy.types.Object:
    """Find the parent empty anew: undo replaces objects."""
    return next(o for o in bpy.data.objects if o.get("gwrap_kind") == "frame")


def execute(operator: Callable[..., set[str]], **properties: object) -> None:
    """Run an operator as its dialog does when it is confirmed."""
    window, area, region = view()
    with bpy.context.temp_override(window=window, area=area, region=region):
        operator("EXEC_DEFAULT", True, **properties)


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


def finish() -> None:
    outcome["blender"] = bpy.app.version_string
    (FOLDER / "outcome.json").write_text(json.dumps(outcome, indent=1))
    bpy.ops.wm.quit_blender()


_run = steps()


def advance() -> float | None:
    """Timer: the next step, or the end."""
    try:
        return next(_run)
    except StopIteration:
        finish()
    except Exception:  # whatever it was, the outcome must tell it and Blender must end
        outcome["error"] = traceback.format_exc()
        try:
            screenshot("0-error")
        finally:
            finish()
    return None


bpy.context.preferences.view.show_splash = False
bpy.app.timers.register(advance, first_interval=1.5)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Takes the pictures of the panel in the documentation, of a real result.

``blender --addons bl_ext.user_default.gaussian_wrapping_addon -P picture_of_panel.py`` with
``GW_PICTURE_RESULT`` (a result folder), ``GW_PICTURE_SOURCE`` (what to show as the photo folder)
and ``GW_PICTURE`` (the file to write). ``GW_PICTURE_OPEN`` names the panels to open, such as
``train,train_advanced`` (all others are closed); ``GW_PICTURE_ESTIMATE=1`` waits for the estimate;
``GW_PICTURE_RUNNING=1`` shows a running job (of the worker that is set) instead of the result.
"""

from __future__ import annotations

import os
import subprocess
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path

import bpy
from mathutils import Vector


def open_only(names: str) -> None:
    """Register the panels again, those named open and all others closed."""
    registration = sys.modules["bl_ext.user_default.gaussian_wrapping_addon.registration"]
    panels = [c for c in registration.CLASSES if issubclass(c, bpy.types.Panel)]
    for panel in reversed(panels):
        bpy.utils.unregister_class(panel)
    for panel in panels:
        name = panel.__name__.removeprefix("GWRAP_PT_")
        panel.bl_options = set() if name in names.split(",") else {"DEFAULT_CLOSED"}
        bpy.utils.register_class(panel)


def steps() -> Iterator[float]:
    """Import, arrange, photograph."""
    if os.environ.get("GW_PICTURE_OPEN"):
        open_only(os.environ["GW_PICTURE_OPEN"])
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    region = next(r for r in area.regions if r.type == "WINDOW")
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    space = area.spaces.active
    space.show_region_ui = True
    yield 0.5
    panel = next(r for r in area.regions if r.type == "UI")
    panel.active_panel_category = "Gaussian Wrapping"
    scene = bpy.context.scene
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.gwrap.choose_input(filepath=os.environ["GW_PICTURE_SOURCE"])
    yield 14.0 if os.environ.get("GW_PICTURE_ESTIMATE") else 2.0
    scene.gwrap.resolution = "EDGE_LENGTH"
    if os.environ.get("GW_PICTURE_RUNNING"):
        with bpy.context.temp_override(window=window, area=area, region=region):
            bpy.ops.gwrap.wrap_scene()
        yield 6.0
        subprocess.run(["import", "-window", "root", os.environ["GW_PICTURE"]], check=True)
        bpy.ops.gwrap.cancel_job()
        yield 2.0
        return
    with bpy.context.temp_override(window=window, area=area, region=region):
        result = Path(os.environ["GW_PICTURE_RESULT"])
        bpy.ops.gwrap.import_result(directory=str(result))
        if (result.parent / "job.json").exists():
            bpy.ops.gwrap.find_job(directory=str(result.parent))
        space.shading.color_type = "TEXTURE"
        yield 0.5
    meshes = [o for o in bpy.data.objects if o.get("gwrap_kind") == "mesh"]
    view_layer = bpy.context.view_layer
    for thing in view_layer.objects:
        thing.select_set(thing in meshes)
    view_layer.objects.active = meshes[0]
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.view3d.view_selected()
        # The side panel covers the right of the view.
        view = space.region_3d
        view.view_distance *= 1.7
        view.view_location += 0.22 * view.view_distance * (view.view_rotation @ Vector((1, 0, 0)))
        boxes = [o for o in bpy.data.objects if o.get("gwrap_kind") == "region"]
        bpy.ops.gwrap.select_region(name=boxes[0].name)
    yield 1.5
    subprocess.run(["import", "-window", "root", os.environ["GW_PICTURE"]], check=True)


_run = steps()


def advance() -> float | None:
    """Timer: the next step, or the end."""
    try:
        return next(_run)
    except StopIteration:
        pass
    except Exception:  # Blender must end, and tell why
        Path(os.environ["GW_PICTURE"]).with_suffix(".txt").write_text(traceback.format_exc())
    bpy.ops.wm.quit_blender()
    return None


bpy.context.preferences.view.show_splash = False
bpy.app.timers.register(advance, first_interval=1.5)

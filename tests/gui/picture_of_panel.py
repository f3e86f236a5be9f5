# SPDX-License-Identifier: GPL-3.0-or-later
"""Takes the pictures of the panel in the documentation, of a real result.

``blender --addons bl_ext.user_default.gaussian_wrapping_addon -P picture_of_panel.py`` with
``GW_PICTURE_RESULT`` (a result folder), ``GW_PICTURE_SOURCE`` (what to show as the photo folder)
and ``GW_GUI_FOLDER`` (takes ``panel.png`` and ``outcome.json``). ``GW_PICTURE_OPEN`` names the
panels to open, such as ``train,train_advanced`` (all others are closed); ``GW_PICTURE_ESTIMATE=1``
waits for the estimate; ``GW_PICTURE_RUNNING=1`` shows a running job (of the worker that is set)
instead of the result.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).parent))
from driving import execute, frame_view, objects, open_tab, run, screenshot, show_only, view


def steps() -> Iterator[float]:
    """Import, arrange, photograph."""
    if os.environ.get("GW_PICTURE_OPEN"):
        show_only(os.environ["GW_PICTURE_OPEN"])
    yield from open_tab()
    execute(bpy.ops.gwrap.choose_input, filepath=os.environ["GW_PICTURE_SOURCE"])
    yield 14.0 if os.environ.get("GW_PICTURE_ESTIMATE") else 2.0
    bpy.context.scene.gwrap.resolution = "EDGE_LENGTH"
    if os.environ.get("GW_PICTURE_RUNNING"):
        execute(bpy.ops.gwrap.wrap_scene)
        yield 6.0
        screenshot("panel")
        execute(bpy.ops.gwrap.cancel_job)
        yield 2.0
        return
    result = Path(os.environ["GW_PICTURE_RESULT"])
    execute(bpy.ops.gwrap.import_result, directory=str(result))
    if (result.parent / "job.json").exists():
        execute(bpy.ops.gwrap.find_job, directory=str(result.parent))
    yield 0.5
    frame_view(objects("mesh"))
    # The side panel covers the right of the view.
    shown = view()[1].spaces.active.region_3d
    shown.view_distance *= 1.7
    shown.view_location += 0.22 * shown.view_distance * (shown.view_rotation @ Vector((1, 0, 0)))
    execute(bpy.ops.gwrap.select_region, name=objects("region")[0].name)
    yield 1.5
    screenshot("panel")


run(steps())

# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs inside a real Blender with a window: shows the panel with captures as people have them.

``python -m tests.gui.capture_pictures`` starts it and makes the pictures of the guide of its
screenshots. ``GW_GUI_FOLDER`` holds the inputs, ``GW_PICTURE`` names the visit: what opens a panel
lasts as long as Blender.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driving
from driving import FOLDER, execute, press, screenshot, show_only, until

PLACES: dict[str, list[int]] = {}
"""x, y from above, width, height of the side panel, by screenshot."""


def shot(name: str) -> Iterator[float]:
    """Photograph the screen and note where the side panel is."""
    yield 1.0
    window, area, _ = driving.view()
    side = next(r for r in area.regions if r.type == "UI")
    side.active_panel_category = "Gaussian Wrapping"
    side.tag_redraw()
    yield 1.0
    screenshot(name)
    PLACES[name] = [side.x, window.height - side.y - side.height, side.width, side.height]
    (FOLDER / f"places-{os.environ['GW_PICTURE']}.json").write_text(json.dumps(PLACES))


def choose(source: str) -> Iterator[float]:
    """Choose an input beside the saved file, and wait for its check and the look at its photos."""
    scene = bpy.context.scene
    scene.gwrap.source = f"//{source}"
    press(bpy.ops.gwrap.check_photos)
    data = driving.module("ops.dataset")
    busy = lambda: data.is_checking() or data.is_busy()  # noqa: E731
    yield 1.0
    yield from until(lambda: not busy() and len(scene.gwrap.findings) > 0, f"{source} is checked")


def begin(panels: str, source: str) -> Iterator[float]:
    """Open the tab with these panels open, for an input."""
    bpy.context.preferences.view.language = "en_US"  # the profile keeps that of another visit
    show_only(panels)
    yield from driving.open_tab()
    space = driving.view()[1].spaces.active
    space.overlay.show_overlays = space.show_gizmo = False
    bpy.ops.wm.save_as_mainfile(filepath=str(FOLDER / "scene.blend"))
    yield from choose(source)


def dataset() -> Iterator[float]:
    """Check inputs of several kinds."""
    for number, source in enumerate(("clip.mp4", "heic", "phone", "posed")):
        bpy.context.scene.gwrap.video_frames = 80 if source == "clip.mp4" else 0
        yield from choose(source) if number else begin("dataset", source)
        yield from shot(f"dataset-{source}")


def training() -> Iterator[float]:
    """Set what belongs to a capture, and save presets."""
    yield from begin("train,train_advanced", "bananas")
    values = bpy.context.scene.gwrap.training
    values.turntable = "ON"
    values.mask_grow_px = 4
    values.markers = "4x4_50:0.05"
    for name in ("On the turntable", "Drone flights"):
        execute(bpy.ops.gwrap.save_preset, name=name)
    yield from shot("advanced")
    press(bpy.ops.wm.call_menu, name="GWRAP_MT_presets")
    yield 0.3
    screenshot("menu")


def languages() -> Iterator[float]:
    """Show the panels in two languages."""
    yield from begin("dataset,train,region", "bananas")
    yield from shot("en_US")
    view = bpy.context.preferences.view
    for language in ("de_DE", "ja_JP"):
        view.language = language
        view.use_translate_interface = True
        yield from shot(language)


def masks() -> Iterator[float]:
    """Review the masks of a job, and keep the largest part of its mesh."""
    yield from begin("region,mesh,mesh_advanced", "pot_wrap/photos")
    bpy.context.scene.gwrap.most_parts = 1
    execute(bpy.ops.gwrap.import_result, directory=str(FOLDER / "pot_wrap" / "result"))
    execute(bpy.ops.gwrap.find_job, directory=str(FOLDER / "pot_wrap"))
    yield 1.0
    region = driving.objects("region")[0]
    execute(bpy.ops.gwrap.select_region, name=region.name)
    execute(bpy.ops.gwrap.review_masks)
    execute(bpy.ops.gwrap.step_mask, by=12)
    execute(bpy.ops.gwrap.decide_mask, accepted=False)
    execute(bpy.ops.gwrap.step_mask, by=12)
    yield from shot("review")


def computers() -> Iterator[float]:
    """Show a job on a Dask cluster."""
    yield from begin("computers", "bananas")
    properties = bpy.context.scene.gwrap
    choices = properties.computers
    execute(bpy.ops.gwrap.find_job, directory=str(FOLDER / "castle_wrap"))
    choices.kind, choices.dask_address = "DASK", "tls://workshop:8786"
    yield 4.0  # the parts are read in the background
    yield from shot("dask")


VISITS = {
    "dataset": dataset, "training": training, "masks": masks, "languages": languages,
    "computers": computers,
}  # fmt: skip
driving.run(VISITS[os.environ["GW_PICTURE"]]())

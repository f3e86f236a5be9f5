# SPDX-License-Identifier: GPL-3.0-or-later
"""Hands and eyes for scripts inside a real Blender with a window: press, wait, look, note.

A script imports this from its own folder and calls :func:`run` with a generator; each value that
the generator gives is the time, in seconds, to let Blender live. ``GW_GUI_FOLDER`` takes the
screenshots and ``outcome.json``. An error in a timer does not change Blender's exit code, so that
the outcome file tells how it went.
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
from typing import Any

import bpy

FOLDER = Path(os.environ["GW_GUI_FOLDER"])
NAME = "bl_ext.user_default.gaussian_wrapping_addon"
DEADLINE_S = 60.0

outcome: dict[str, Any] = {"error": "not finished", "checks": []}


def check(good: bool, what: str) -> None:
    """Note a check; the first that fails ends the run."""
    outcome["checks"].append({"good": bool(good), "what": what})
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


def execute(operator: Callable[..., set[str]], **properties: object) -> None:
    """Run an operator as its dialog does when it is confirmed."""
    window, area, region = view()
    with bpy.context.temp_override(window=window, area=area, region=region):
        operator("EXEC_DEFAULT", True, **properties)


def screenshot(name: str) -> None:
    """Photograph the screen; Blender's own screenshot is black under a virtual display."""
    path = FOLDER / f"{name}.png"
    tool = shutil.which("import")
    if tool:
        subprocess.run([tool, "-window", "root", str(path)], check=True, timeout=30)
    else:
        execute(bpy.ops.screen.screenshot, filepath=str(path))


def until(
    condition: Callable[[], bool], what: str, deadline_s: float = DEADLINE_S
) -> Iterator[float]:
    """Wait while Blender's own loop runs."""
    end_s = time.monotonic() + deadline_s
    while not condition():
        check(time.monotonic() < end_s, f"in time: {what}")
        yield 0.1
    check(True, what)


def module(name: str) -> Any:
    """Return a module of the installed add-on."""
    return sys.modules[f"{NAME}.{name}"]


def job_status() -> Any:
    """Return the status of the scene's job as the panel shows it; None without one."""
    return module("ops.job_timer").status_of(bpy.context.scene.gwrap.job_folder)


def state_of_job() -> str:
    """Return the state of the scene's job, ``none`` without one."""
    status = job_status()
    return status.state if status else "none"


def fraction_of_job() -> float:
    """Return how far the scene's job is."""
    return job_status().fraction


def kinds() -> list[str]:
    """Return what the add-on's objects in the file are, sorted."""
    return sorted(str(o.get("gwrap_kind", "")) for o in bpy.data.objects)


def objects(kind: str) -> list[bpy.types.Object]:
    """Return the add-on's objects of a kind; found anew, as undo replaces objects."""
    return [o for o in bpy.data.objects if o.get("gwrap_kind") == kind]


def show_only(names: str) -> None:
    """Register the panels again, those named open and all others closed, before they are shown."""
    panels = [c for c in module("registration").CLASSES if issubclass(c, bpy.types.Panel)]
    for panel in reversed(panels):
        bpy.utils.unregister_class(panel)
    for panel in panels:
        name = panel.__name__.removeprefix("GWRAP_PT_")
        panel.bl_options = set() if name in names.split(",") else {"DEFAULT_CLOSED"}
        bpy.utils.register_class(panel)


def open_tab() -> Iterator[float]:
    """Empty the file and show the add-on's tab."""
    _, area, _ = view()
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    area.spaces.active.show_region_ui = True
    yield 0.5
    panel = next(r for r in area.regions if r.type == "UI")
    panel.active_panel_category = "Gaussian Wrapping"
    yield 0.5
    check(panel.active_panel_category == "Gaussian Wrapping", "the tab is there")


def frame_view(shown: list[bpy.types.Object] | None = None) -> None:
    """Show these objects, or all, with their textures."""
    _, area, _ = view()
    area.spaces.active.shading.color_type = "TEXTURE"
    if shown is None:
        execute(bpy.ops.view3d.view_all)
        return
    layer = bpy.context.view_layer
    for thing in layer.objects:
        thing.select_set(thing in shown)
    layer.objects.active = shown[0]
    execute(bpy.ops.view3d.view_selected)


def _finish() -> None:
    outcome["blender"] = bpy.app.version_string
    (FOLDER / "outcome.json").write_text(json.dumps(outcome, indent=1))
    bpy.ops.wm.quit_blender()


def run(steps: Iterator[float]) -> None:
    """Go through the steps from a timer, write the outcome, quit Blender."""

    def advance() -> float | None:
        try:
            return next(steps)
        except StopIteration:
            outcome["error"] = ""
            _finish()
        except Exception:  # whatever it was, the outcome must tell it and Blender must end
            outcome["error"] = traceback.format_exc()
            try:
                screenshot("0-error")
            finally:
                _finish()
        return None

    bpy.context.preferences.view.show_splash = False
    bpy.app.timers.register(advance, first_interval=1.5)

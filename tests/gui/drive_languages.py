# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel in German and Japanese, and a running job in the status bars of two windows.

``blender ... -P drive_languages.py``; ``GW_GUI_FOLDER`` holds ``photos/``; the worker is the fake
one.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driving
from driving import FOLDER, check, fraction_of_job, press, screenshot, state_of_job, until

CONTEXT = "GaussianWrapping"
PAPER = {"de_DE": "Paper", "ja_JP": "論文"}
CHOOSE_PHOTOS = {"de_DE": "Fotos wählen", "ja_JP": "写真を選択"}


def steps() -> Iterator[float]:
    """The visit; each value is the time to let Blender live."""
    yield from driving.open_tab()
    view = bpy.context.preferences.view
    look_up = bpy.app.translations.pgettext
    points = driving.module("ui.job_view")
    for language in PAPER:
        view.language = language
        view.use_translate_interface = view.use_translate_tooltips = True
        yield 1.0
        screenshot(f"1-{language}")
        check(look_up("Paper", CONTEXT) == PAPER[language], f"a label in {language}")
        words = look_up("Choose Photos", CONTEXT)
        check(words == CHOOSE_PHOTOS[language], f"a button in {language}")
        bpy.context.scene.gwrap.source = str(FOLDER / "photos")
        bpy.context.scene.gwrap.resolution = "EDGE_LENGTH"
        os.environ["GW_FAKE"] = "slow"
        press(bpy.ops.gwrap.wrap_scene)
        yield from until(lambda: state_of_job() == "RUNNING", "the job runs")
        yield from until(lambda: fraction_of_job() > 0.2, "the timer sees progress")
        yield from until(lambda: points._drawing.batch is not None, "its points are drawn")
        yield 0.5
        screenshot(f"2-{language}")
        press(bpy.ops.wm.window_new)
        yield 1.0
        check(len(bpy.context.window_manager.windows) == 2, "a second window")
        bar = driving.module("ui.job_view")
        check(not bar._failed and not points.VIEW.failed, "both are drawn without an error")
        press(bpy.ops.gwrap.cancel_job)
        yield from until(lambda: state_of_job() == "CANCELLED", "the job is cancelled")
        yield 0.5
        check(bar.running_jobs() == [], "the status bars are empty")
        second = bpy.context.window_manager.windows[1]
        with bpy.context.temp_override(window=second):
            bpy.ops.wm.window_close()
        yield 0.5
        bpy.context.scene.gwrap.job_folder = bpy.context.scene.gwrap.output = ""
    view.language = "en_US"
    yield 0.5
    check(look_up("Choose Photos", CONTEXT) == "Choose Photos", "and in English again")


driving.run(steps())

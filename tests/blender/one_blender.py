# SPDX-License-Identifier: GPL-3.0-or-later
"""One life of Blender in a job's test: ``python one_blender.py DEED BLEND PHOTOS [keep]``.

``start`` presses Wrap Scene, saves the file and stays; ``quit`` does so and quits; ``reopen`` opens
the file, finishes its job or resumes it, and says as its last line of JSON what it found.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import bpy

import gaussian_wrapping_addon
from gaussian_wrapping_addon.ops import addon, job_timer, jobs, worker_setup
from gaussian_wrapping_addon.ui import training_panel
from tests.blender.fake_layout import draw
from tests.blender.job_play import meshes, play_to, play_until, start_wrap, status_of


def say(**values: object) -> None:
    """Write one line for the test."""
    sys.stdout.write(json.dumps(values) + "\n")
    sys.stdout.flush()


def start(blend: Path, photos: Path, keep: bool) -> Path:
    """Start a job and save the file."""
    choice = worker_setup.worker_choice(bpy.context)
    jobs.worker_choice = lambda _context: dataclasses.replace(choice, keep_running=keep)
    properties = bpy.context.scene.gwrap
    properties.preset = "DRAFT"
    # The fake worker heeds none of this; the real one is done the sooner.
    properties.training.iterations, properties.training.max_gaussians = 300, 3000
    properties.training.max_image_px, properties.texture_size = 128, "1024"
    folder = start_wrap(photos)
    play_until(lambda: status_of(folder).fraction > 0.0, "never at work")
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    say(pid=status_of(folder).pid, folder=str(folder), stage=status_of(folder).stage)
    return folder


def reopen(blend: Path) -> None:
    """Open the file and bring its job to an end."""
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    jobs.attach_later()
    folder = Path(bpy.context.scene.gwrap.job_folder)
    found = status_of(folder).state
    offered = draw(training_panel.GWRAP_PT_train).operators
    if "gwrap.resume_job" in offered:
        os.environ["GW_FAKE"] = "quick"
        bpy.ops.gwrap.resume_job()
    (folder / "finish").touch()
    play_to(folder, "DONE", "FAILED", "LOST")
    final = status_of(folder)
    if not meshes() and job_timer.result_to_import(bpy.context.scene):
        bpy.ops.gwrap.import_result(directory=job_timer.result_to_import(bpy.context.scene))
    say(found=found, offered=offered, state=final.state, error=final.error, meshes=meshes())


def main() -> int:
    deed, blend, photos = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    # An installed extension keeps this list in a folder of its own; the wheel has none.
    addon._list_path = lambda: blend.with_name("known_jobs.json")
    gaussian_wrapping_addon.register()
    try:
        if deed == "reopen":
            reopen(blend)
            return 0
        start(blend, photos, sys.argv[-1] == "keep")
        if deed == "start":
            time.sleep(120)
    finally:
        gaussian_wrapping_addon.unregister()
    return 0


if __name__ == "__main__":
    sys.exit(main())

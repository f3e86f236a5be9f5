# SPDX-License-Identifier: GPL-3.0-or-later
"""A finished job of a coloured ball, without its training: photos can be baked from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gaussian_wrapping_addon.core.jobs.stages.cameras import write_scene_summary
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.scene.scene import load_saved_scene, save_scene
from tests.blender.synthetic_result import WORLD_FROM_SCENE, write_region_result
from tests.core.jobs.finished_sphere import write_finished_sphere


def write_ball_job(root: Path) -> JobFolder:
    """Write a job with a finished training and a result, far from the world's origin."""
    folder = write_finished_sphere(root)
    (cameras,) = folder.stages.glob("cameras-*")
    scene = replace(load_saved_scene(cameras), world_from_scene=WORLD_FROM_SCENE)
    save_scene(scene, cameras)
    write_region_result(folder.result / "auto")
    write_scene_summary(folder.result / "scene.json", scene)
    (folder.result / "report.json").write_text("{}")
    folder.write_status(JobStatus("DONE", result=str(folder.result)))
    return folder

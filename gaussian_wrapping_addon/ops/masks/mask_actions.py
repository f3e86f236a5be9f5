# SPDX-License-Identifier: GPL-3.0-or-later
"""Start a job that masks the photos to what stands in regions, and trains anew."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import bpy

from ...core.jobs.store.job_folder import JobFolder
from ...core.jobs.store.rollback import finished_job
from ...core.settings import with_values
from ..jobs.job_actions import common_frame, refuse_running, start_on_regions
from ..jobs.panel_settings import job_settings
from ..jobs.scene_folders import job_folder_of
from ..worker.preferred_worker import WorkerChoice

CAMERA_SETTINGS: Final = (
    "seed", "turntable", "equirectangular", "mask_invert", "mask_grow_px", "georeference",
    "markers", "control_points", "video_frames", "video_fps",
)  # fmt: skip
"""What a job's cameras depend on besides its input."""


def start_region_masks(
    scene: bpy.types.Scene, regions: list[bpy.types.Object], choice: WorkerChoice
) -> Path:
    """Train a finished job's photos anew, masked to regions, and mesh these; return its folder.

    Cameras are re-used; so are masks that were made of the same regions.

    Parameters
    ----------
    regions : list of Object
        Region objects under the frame of one result.

    Raises
    ------
    WrapError
        A region or a setting cannot be used, or the job folder holds no job.
    """
    folder = job_folder_of(common_frame(regions))
    refuse_running(folder)
    earlier = finished_job(JobFolder(folder))
    # The region lies in the world of the job's cameras, which would move with any of these.
    changed = {name: getattr(earlier.settings, name) for name in CAMERA_SETTINGS}
    changed |= {"make_masks": "region", "mask_model": ""}
    settings = with_values(job_settings(scene, choice.threads, choice.device), changed)
    return start_on_regions(scene, regions, choice, "wrap", earlier.source, settings)

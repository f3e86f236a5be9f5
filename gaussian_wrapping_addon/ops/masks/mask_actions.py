# SPDX-License-Identifier: GPL-3.0-or-later
"""Start a job that masks the photos to what stands in regions, and trains anew."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...core.jobs.client import JobClient, worker_python
from ...core.jobs.store.job_file import make_job
from ...core.jobs.store.job_folder import JobFolder
from ...core.jobs.store.rollback import finished_job
from ...core.names import region_names
from ...core.settings import with_values
from ..common import tags
from ..common.addon import properties_of
from ..jobs import job_timer
from ..jobs.job_actions import common_frame, export_requests, refuse_running
from ..jobs.panel_settings import job_settings, meshing_choices, texture_choices
from ..jobs.scene_folders import job_folder_of
from ..regions.region_resolution import own_lengths, world_per_blender
from ..worker.preferred_worker import WorkerChoice


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
    frame = common_frame(regions)
    folder = job_folder_of(frame)
    refuse_running(folder)
    earlier = finished_job(JobFolder(folder))
    own = own_lengths(scene, regions, frame)
    requests = export_requests(regions, frame, folder)
    settings = with_values(
        job_settings(scene, choice.threads, choice.device),
        {
            "regions": tuple(requests),
            "make_masks": "region",
            "mask_model": "",
            **meshing_choices(scene, world_per_blender(frame)),
            **texture_choices(scene),
        },
    )
    lengths = {
        request: length for request, length in zip(requests, own, strict=True) if length is not None
    }
    job = make_job("wrap", Path(earlier.source), settings, lengths)
    names = region_names(job.settings.regions, job.region_bodies)
    client = JobClient.start(
        folder, job, python=worker_python(choice.python), keep_running=choice.keep_running
    )
    for region, name in zip(regions, names, strict=True):
        region[tags.REGION] = name  # the import finds this box and adds no second one
    properties_of(scene).job_command = "WRAP"
    job_timer.watch(scene, folder, client)
    return folder

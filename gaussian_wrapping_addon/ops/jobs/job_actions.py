# SPDX-License-Identifier: GPL-3.0-or-later
"""Actions of the job buttons as plain functions: from properties to a running worker."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import bpy

from ...core.errors import DatasetError, UsageError
from ...core.jobs.client import JobClient, worker_python
from ...core.jobs.store.continue_training import continue_training_job
from ...core.jobs.store.job_file import make_job
from ...core.jobs.store.job_folder import JobFolder
from ...core.jobs.store.rollback import finished_job
from ...core.jobs.store.stage_folder import read_done
from ...core.names import AUTOMATIC_REGIONS, region_name, region_names
from ...core.regions.region_file import read_region_file
from ...core.settings import JobSettings, with_values
from ..common import tags
from ..common.addon import properties_of
from ..regions.region_objects import export_region
from ..regions.region_resolution import own_lengths, world_per_blender
from ..worker.preferred_worker import WorkerChoice
from . import job_timer, watched_jobs
from .panel_settings import computers_choices, job_settings, meshing_choices, texture_choices
from .scene_folders import job_folder_of, output_of, source_of


def start_wrap(scene: bpy.types.Scene, choice: WorkerChoice) -> Path:
    """Start the whole pipeline for a scene's photos; return the job folder.

    Raises
    ------
    WrapError
        The source, the output or a setting cannot be used.
    """
    properties = properties_of(scene)
    source = source_of(scene)
    folder = output_of(scene, source)
    job = make_job("wrap", source, job_settings(scene, choice.threads, choice.device))
    refuse_running(folder)
    client = JobClient.start(
        folder, job, python=worker_python(choice.python), keep_running=choice.keep_running
    )
    properties.output = str(folder)
    properties.job_command = "WRAP"
    job_timer.watch(scene, folder, client)
    return folder


def start_mesh(
    scene: bpy.types.Scene, regions: list[bpy.types.Object], choice: WorkerChoice
) -> Path:
    """Mesh regions of a finished training, each at its resolution; return the job folder.

    Parameters
    ----------
    regions : list of Object
        Region objects under the frame of one result.

    Raises
    ------
    WrapError
        A region cannot be used, or the job folder contains no finished training.
    """
    frame = common_frame(regions)
    folder = job_folder_of(frame)
    _require_training(folder)
    refuse_running(folder)
    earlier = finished_job(JobFolder(folder))
    changed = {"threads": choice.threads, "device": choice.device, **computers_choices(scene)}
    settings = with_values(earlier.settings, changed)
    return start_on_regions(scene, regions, choice, "mesh", earlier.source, settings)


def start_on_regions(
    scene: bpy.types.Scene,
    regions: list[bpy.types.Object],
    choice: WorkerChoice,
    command: str,
    source: str,
    settings: JobSettings,
) -> Path:
    """Start a job in the folder of a result that meshes regions; return the folder.

    Parameters
    ----------
    regions : list of Object
        Region objects under the frame of the result.
    command : str
        Of the job.
    source : str
        Input of the job.
    settings : JobSettings
        Those of the regions, of meshing and texture are taken from the scene.
    """
    frame = common_frame(regions)
    folder = job_folder_of(frame)
    own = own_lengths(scene, regions, frame)
    requests = export_requests(regions, frame, folder)
    settings = with_values(
        settings,
        {
            "regions": tuple(requests),
            **meshing_choices(scene, world_per_blender(frame)),
            **texture_choices(scene),
        },
    )
    lengths = {
        request: length for request, length in zip(requests, own, strict=True) if length is not None
    }
    job = make_job(command, Path(source), settings, lengths)
    names = region_names(job.settings.regions, job.region_bodies)
    client = JobClient.start(
        folder, job, python=worker_python(choice.python), keep_running=choice.keep_running
    )
    for region, name in zip(regions, names, strict=True):
        region[tags.REGION] = name  # the import finds this box and adds no second one
    properties_of(scene).job_command = command.upper()
    job_timer.watch(scene, folder, client)
    return folder


def start_more(scene: bpy.types.Scene, frame: bpy.types.Object, choice: WorkerChoice) -> Path:
    """Train a finished job further, then mesh and texture it again; return the job folder.

    Parameters
    ----------
    frame : Object
        The frame of the job's result.

    Raises
    ------
    WrapError
        The job folder contains no finished training, or too many iterations are requested.
    """
    folder = job_folder_of(frame)
    refuse_running(folder)
    earlier = finished_job(JobFolder(folder))
    job = continue_training_job(
        JobFolder(folder), earlier, properties_of(scene).training.more_iterations
    )
    changed = {"threads": choice.threads, "device": choice.device, **computers_choices(scene)}
    job = replace(job, settings=with_values(job.settings, changed))
    client = JobClient.start(
        folder, job, python=worker_python(choice.python), keep_running=choice.keep_running
    )
    properties_of(scene).job_command = "WRAP"
    job_timer.watch(scene, folder, client)
    return folder


def resume(scene: bpy.types.Scene, choice: WorkerChoice) -> Path:
    """Continue a scene's job; finished stages are re-used. Return the job folder."""
    if not properties_of(scene).job_folder:
        raise UsageError("This scene has no job.", "Wrap the scene first.")
    folder = Path(bpy.path.abspath(properties_of(scene).job_folder))
    refuse_running(folder)
    client = JobClient.resume(
        folder, python=worker_python(choice.python), keep_running=choice.keep_running,
        device=choice.device,
    )  # fmt: skip
    job_timer.watch(scene, folder, client)
    return folder


def export_requests(
    regions: list[bpy.types.Object], frame: bpy.types.Object, folder: Path
) -> list[str]:
    """Write the files of regions into their job's folder; return their paths.

    Raises
    ------
    WrapError
        A region is linked from a library, or has no body.
    """
    _refuse_linked(regions)
    requests = []
    for region in regions:
        path = folder / "regions" / f"{region.session_uid}.json"
        path.parent.mkdir(exist_ok=True)
        export_region(region, path, _result_name(region, frame))
        requests.append(str(path))
    return requests


def _require_training(folder: Path) -> None:
    if not any(read_done(path) for path in (folder / "stages").glob("train-*")):
        raise UsageError(
            f"{folder} holds no finished training.", "Wrap the scene again, or find its folder."
        )


def _refuse_linked(regions: list[bpy.types.Object]) -> None:
    for region in regions:
        if not region.is_editable:
            raise UsageError(
                f"Region {region.name} is linked from a library.",
                "Make it local (Object > Relations > Make Local).",
            )


def _result_name(region: bpy.types.Object, frame: bpy.types.Object) -> str:
    """Return the name under which a region's new mesh replaces its earlier one.

    A renamed region keeps it. Its copies, which have the same tag, do not: of several regions, it
    belongs to the one that still has this name, or else to none. Nor does the automatic region
    have it, once the user meshes its box.
    """
    name = region.get(tags.REGION, "")
    if not isinstance(name, str) or name in ("", *AUTOMATIC_REGIONS):
        return ""
    things = [t for t in bpy.data.objects if tags.kind_of(t) == "region"]
    same = [t for t in things if t.get(tags.REGION) == name and tags.frame_of(t) == frame]
    if len(same) == 1 or region_name(region.name, {"blender_object_name": region.name}) == name:
        return _stored_name(frame, name)
    return ""


def _stored_name(frame: bpy.types.Object, folder: str) -> str:
    """Return the name of the region whose result is in a folder; the folder's name is a safe form.

    Under another name it would be another region, whose result may not be replaced.
    """
    try:
        stored = read_region_file(tags.result_folder(frame) / folder / "region.json").name
    except DatasetError:
        return folder
    return stored if region_name(stored, {"blender_object_name": stored}) == folder else folder


def refuse_running(folder: Path) -> None:
    """Raise :class:`UsageError` where a job runs in a folder."""
    if watched_jobs.is_running(str(folder)):
        raise UsageError(f"A job is running in {folder}.", "Cancel it or wait for it.")


def common_frame(regions: list[bpy.types.Object]) -> bpy.types.Object:
    """Return the common frame of regions.

    Raises
    ------
    UsageError
        There is none, or there are several.
    """
    if not regions:
        raise UsageError("No region is selected.", "Select a region box.")
    frames = {tags.frame_of(region) for region in regions}
    frame = next(iter(frames))
    if len(frames) > 1:
        raise UsageError("The regions belong to different results.", "Select those of one result.")
    if frame is None:
        raise UsageError(
            f"{regions[0].name} belongs to no result.", "Add a region after wrapping the scene."
        )
    return frame

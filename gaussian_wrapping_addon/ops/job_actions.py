# SPDX-License-Identifier: GPL-3.0-or-later
"""What the job buttons do, as plain functions: from properties to a running worker."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import UsageError
from ..core.jobs.client import JobClient, worker_python
from ..core.jobs.earlier_job import finished_job
from ..core.jobs.job_file import make_job, region_names
from ..core.jobs.job_folder import JobFolder
from ..core.jobs.more import job_with_more
from ..core.jobs.stages import read_done
from . import job_timer, tags
from .region_objects import export_region, hull_in_blender, scene_from_blender
from .training_choices import job_settings, texture_choices


@dataclass(frozen=True)
class WorkerChoice:
    """What the add-on's preferences say about workers. Never read from a .blend file."""

    python: str = ""
    threads: int = 0
    keep_running: bool = False


def worker_choice(context: bpy.types.Context) -> WorkerChoice:
    """Read the add-on's preferences; defaults where it is not enabled as an add-on."""
    addon = context.preferences.addons.get(__package__.rpartition(".")[0])
    preferences = addon.preferences if addon is not None else None
    if preferences is None:
        return WorkerChoice()
    python = bpy.path.abspath(preferences.worker_python) if preferences.worker_python else ""
    return WorkerChoice(python, preferences.threads, preferences.keep_running)


def source_of(scene: bpy.types.Scene) -> Path:
    """Return the photo folder of a scene.

    Raises
    ------
    UsageError
        None is chosen.
    """
    if not scene.gwrap.source:
        raise UsageError("No photo folder is chosen.", "Choose one in the Photos panel.")
    return Path(bpy.path.abspath(scene.gwrap.source)).resolve()


def output_of(scene: bpy.types.Scene, source: Path) -> Path:
    """Return the job folder for a source: the one chosen, or a sibling of the source.

    Raises
    ------
    UsageError
        It lies inside the photo folder, which is never written to.
    """
    text = scene.gwrap.output
    if source.suffix.lower() == ".ply":
        base = source.with_suffix("")  # a splat: other files in its folder are not its input
    else:
        base = source.parent if source.is_file() else source
    folder = Path(bpy.path.abspath(text)).resolve() if text else base.with_name(f"{base.name}_wrap")
    if folder.is_relative_to(base):
        raise UsageError(
            f"{folder} lies inside the photo folder.", "Choose an output folder outside of it."
        )
    return folder


def start_wrap(scene: bpy.types.Scene, choice: WorkerChoice) -> Path:
    """Start the whole road for a scene's photos; return the job folder.

    Raises
    ------
    WrapError
        The source, the output or a setting cannot be used.
    """
    properties = scene.gwrap
    source = source_of(scene)
    folder = output_of(scene, source)
    job = make_job("wrap", source, job_settings(scene, choice.threads))
    _refuse_running(folder)
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
    """Mesh regions of a finished training, at the scene's resolution; return the job folder.

    Parameters
    ----------
    regions : list of Object
        Region objects under the frame of one result.

    Raises
    ------
    WrapError
        A region cannot be used, or the job folder holds no finished training.
    """
    frame = _common_frame(regions)
    folder = job_folder_of(frame)
    _require_training(folder)
    _refuse_running(folder)
    earlier = finished_job(JobFolder(folder))
    edge_length = _edge_length_world(scene, regions, frame)
    requests = []
    for region in regions:
        path = folder / "regions" / f"{region.session_uid}.json"
        path.parent.mkdir(exist_ok=True)
        export_region(region, path)
        requests.append(str(path))
    properties = scene.gwrap
    settings = replace(
        earlier.settings,
        threads=choice.threads,
        regions=tuple(requests),
        meshing=replace(
            earlier.settings.meshing,
            edge_length=edge_length,
            points=properties.points if properties.resolution == "POINTS" else 0,
            method=properties.method.lower(),
            spacing=properties.spacing.lower(),
            pivots=int(properties.pivots),
            boundary=properties.boundary.lower(),
            unseen=properties.unseen.lower(),
            target_faces=properties.target_faces if properties.decimate else 0,
            smooth_steps=properties.smooth_steps,
        ),
        texture=replace(earlier.settings.texture, **texture_choices(scene)),
    )
    job = make_job("mesh", Path(earlier.source), settings)
    names = region_names(job.settings.regions, job.region_bodies)
    client = JobClient.start(
        folder, job, python=worker_python(choice.python), keep_running=choice.keep_running
    )
    for region, name in zip(regions, names, strict=True):
        region[tags.REGION] = name  # so that the import finds this box and makes no second one
    properties.job_command = "MESH"
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
        The job folder holds no finished training, or too many iterations are asked for.
    """
    folder = job_folder_of(frame)
    _refuse_running(folder)
    earlier = finished_job(JobFolder(folder))
    job = job_with_more(JobFolder(folder), earlier, scene.gwrap.training.more_iterations)
    job = replace(job, settings=replace(job.settings, threads=choice.threads))
    client = JobClient.start(
        folder, job, python=worker_python(choice.python), keep_running=choice.keep_running
    )
    scene.gwrap.job_command = "WRAP"
    job_timer.watch(scene, folder, client)
    return folder


def resume(scene: bpy.types.Scene, choice: WorkerChoice) -> Path:
    """Continue a scene's job; finished stages are re-used. Return the job folder."""
    if not scene.gwrap.job_folder:
        raise UsageError("This scene has no job.", "Wrap the scene first.")
    folder = Path(bpy.path.abspath(scene.gwrap.job_folder))
    _refuse_running(folder)
    client = JobClient.resume(
        folder, python=worker_python(choice.python), keep_running=choice.keep_running
    )
    job_timer.watch(scene, folder, client)
    return folder


def job_folder_of(frame: bpy.types.Object) -> Path:
    """Return the job folder of a result's frame.

    Raises
    ------
    UsageError
        It has been moved or deleted.
    """
    folder = tags.result_folder(frame).resolve().parent
    if not JobFolder(folder).is_job():
        raise UsageError(
            f"{folder} holds no job.", "Import the result again from where its folder is now."
        )
    return folder


def _require_training(folder: Path) -> None:
    if not any(read_done(path) for path in (folder / "stages").glob("train-*")):
        raise UsageError(
            f"{folder} holds no finished training.", "Wrap the scene again, or find its folder."
        )


def _refuse_running(folder: Path) -> None:
    if job_timer.is_running(str(folder)):
        raise UsageError(f"A job is running in {folder}.", "Cancel it or wait for it.")


def _common_frame(regions: list[bpy.types.Object]) -> bpy.types.Object:
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


def _edge_length_world(
    scene: bpy.types.Scene, regions: list[bpy.types.Object], frame: bpy.types.Object
) -> float:
    """Turn the edge length as seen in Blender into world units; 0 where it does not decide."""
    if scene.gwrap.resolution != "EDGE_LENGTH":
        return 0.0
    edge_length = scene.gwrap.edge_length
    for region in regions:
        diagonal = float(np.linalg.norm(np.ptp(hull_in_blender(region)[0], 0)))
        if edge_length > 0.5 * diagonal:
            raise UsageError(
                f"Edge length {edge_length:g} is too coarse for region {region.name}, "
                f"which measures {diagonal:.3g} from corner to corner.",
                "Choose a smaller edge length.",
            )
    scale = abs(np.linalg.det(scene_from_blender(frame)[:3, :3])) ** (1.0 / 3.0)
    return float(edge_length * scale * tags.world_from_scene(frame).scale)

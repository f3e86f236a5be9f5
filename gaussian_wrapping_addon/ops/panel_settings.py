# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel's settings and state, read for a job."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import bpy

from ..core.errors import UsageError, WrapError
from ..core.farm.addresses import scheduler_address
from ..core.files import real_path
from ..core.jobs.store.job_file import read_job
from ..core.jobs.store.job_folder import JobFolder
from ..core.photos.video import is_video_path
from ..core.settings import Declaration, JobSettings, declarations, preset, with_values
from ..core.settings.job import LOCAL, checked_markers
from . import addon, job_timer
from .addon import properties_of, tr

# -- Folders of a scene: its photos, the output of its next job, the job of a result --------------


def source_of(scene: bpy.types.Scene) -> Path:
    """Return the photo folder of a scene. Raises UsageError: none is chosen."""
    if not properties_of(scene).source:
        raise UsageError("No photo folder is chosen.", "Choose one in Dataset.")
    return real_path(bpy.path.abspath(properties_of(scene).source))


def output_of(scene: bpy.types.Scene, source: Path) -> Path:
    """Return the job folder for a source: the one chosen, or a sibling of the source.

    Raises UsageError: it lies inside the photo folder, which is never written to.
    """
    text = "" if _is_of_other_photos(scene, source) else properties_of(scene).output
    if source.suffix.lower() == ".ply" or (is_video_path(source) and not source.is_dir()):
        base = source.with_suffix("")  # other files in its folder are not its input
    else:
        base = source.parent if source.is_file() else source
    if not text and not base.name:  # a memory card, or the root of a disk
        raise UsageError(
            f"{base} is a whole disk, which has no folder beside it.",
            "Copy the photos into a folder of their own.",
        )
    folder = real_path(bpy.path.abspath(text)) if text else base.with_name(f"{base.name}_wrap")
    if folder.is_relative_to(base):
        raise UsageError(
            f"{folder} lies inside the photo folder.", "Choose an output folder outside of it."
        )
    return folder


def _is_of_other_photos(scene: bpy.types.Scene, source: Path) -> bool:
    """Return whether the output is that of this scene's last job with another source.

    Changing the path of the photos must not overwrite a finished job of other photos.
    """
    properties = properties_of(scene)
    if not properties.output or properties.output != properties.job_folder:
        return False
    job = JobFolder(Path(bpy.path.abspath(properties.job_folder)))
    if not job.is_job():
        return False
    try:
        return real_path(read_job(job.job_path).source) != source
    except WrapError:
        return False


def job_folder_of(frame: bpy.types.Object) -> Path:
    """Return the job folder of a result's frame.

    Raises UsageError: it has been moved or deleted.
    """
    folder = real_path(addon.result_folder(frame)).parent
    if not JobFolder(folder).is_job():
        raise UsageError(
            f"{folder} holds no job.", "Import the result again from where its folder is now."
        )
    return folder


# -- Settings of a job from the properties of the panels ------------------------------------------


def settings_of_scene() -> list[Declaration]:
    """Return the settings that a scene has a property for."""
    known = (d for d in declarations(JobSettings) if d.panel is not None)
    return [declared for declared in known if declared.property_owner != "preferences"]


def is_shown(declared: Declaration, properties: bpy.types.PropertyGroup) -> bool:
    """Return whether a setting's property is shown, given the choices of ``Scene.gwrap``."""
    panel = declared.panel
    if panel is None or panel.shown_if is None:
        return panel is not None
    name, value = panel.shown_if
    return bool(getattr(properties, name) == value)


def chosen_values(
    properties: bpy.types.PropertyGroup, settings: Iterable[Declaration]
) -> dict[str, Any]:
    """Return the values of settings, by path, from their properties.

    Numbers left to the preset are omitted.

    ``properties``: ``Scene.gwrap``.
    """
    values = {}
    for declared in settings:
        panel, stored = declared.panel, _stored(declared, properties)
        if panel is None or (panel.preset_if_zero and not stored):
            continue
        hidden = panel.default_if_hidden and not is_shown(declared, properties)
        values[declared.path] = declared.default if hidden else declared.from_panel(stored)
    return values


def owner_of(declared: Declaration, properties: Any) -> Any:
    """Return which of ``Scene.gwrap`` and ``Scene.gwrap.training`` has a setting's property."""
    return properties.training if declared.property_owner == "training" else properties


def _stored(declared: Declaration, properties: Any) -> Any:
    return getattr(owner_of(declared, properties), declared.property_name)


def job_settings(scene: bpy.types.Scene, threads: int, device: str = "auto") -> JobSettings:
    """Return the job settings of a scene's panels: the preset, then the choices.

    Meshing settings are omitted: a job that trains uses their defaults. Raises UsageError: the
    splat to start from or the control points do not exist, or the markers are none.
    """
    settings = [declared for declared in settings_of_scene() if declared.group != "meshing"]
    values = chosen_values(properties_of(scene), settings)
    values["start_splat"] = _splat(values["start_splat"])
    values["markers"] = checked_markers(values["markers"])
    if values["control_points"]:
        path = _local(values["control_points"], "file")
        values["control_points"] = _existing(path, "file of control points")
    model = values["mask_model"]
    values["mask_model"] = str(_local(model, "mask model")) if model else ""
    values |= computers_choices(scene)
    name = values.pop("preset")
    for declared in settings:
        auto = declared.model_selection and name in declared.presets
        if auto and values[declared.path] == declared.default:
            del values[declared.path]  # Auto leaves it to the preset
    return with_values(preset(name, threads=threads, device=device), values)


def computers_choices(scene: bpy.types.Scene) -> dict[str, Any]:
    """Return the settings, by path, that say where the parts of a job run.

    What was chosen for other places than the present one is left out. Raises UsageError: the
    address of the Dask scheduler is none, or not encrypted; the folder of the certificates is on
    another computer.
    """
    properties = properties_of(scene)
    choices, processes = properties.computers, properties.processes
    where = ""
    if choices.kind == "DASK":
        where = str(scheduler_address(choices.dask_address))
    elif choices.kind == "THIS" and processes > 1:
        where = LOCAL
    certificates = certificates_of(scene) if choices.kind == "DASK" else ""
    if where != LOCAL:
        processes = JobSettings().processes
    return {"computers": where, "processes": processes, "certificates": certificates}


def certificates_of(scene: bpy.types.Scene) -> str:
    """Return the folder of the farm's certificates; ``""`` leaves it to the environment.

    Raises UsageError: it is on another computer.
    """
    stored = properties_of(scene).computers.certificates
    return str(_local(stored, "folder of certificates")) if stored else ""


def meshing_choices(scene: bpy.types.Scene, world_per_blender: float) -> dict[str, Any]:
    """Return the meshing settings, by path, of a scene's panels.

    ``world_per_blender``: world units of the input per unit of length in Blender.
    """
    settings = [declared for declared in settings_of_scene() if declared.group == "meshing"]
    values = chosen_values(properties_of(scene), settings)
    if values["meshing.edge_length"]:
        values["meshing.edge_length"] *= world_per_blender
    return values


def method_choices(scene: bpy.types.Scene) -> dict[str, Any]:
    """Return the meshing settings, by name, that an estimate of a mesh depends on.

    The edge length is as in Blender.
    """
    known = settings_of_scene()
    settings = [d for d in known if d.option is not None and d.scope == "method"]
    values = chosen_values(properties_of(scene), settings)
    return {path.rpartition(".")[2]: value for path, value in values.items()}


def texture_choices(scene: bpy.types.Scene) -> dict[str, Any]:
    """Return the texture settings, by path, of a scene's panels."""
    settings = [declared for declared in settings_of_scene() if declared.group == "texture"]
    return chosen_values(properties_of(scene), settings)


def _splat(stored: str) -> str:
    if not stored:
        return ""
    path = _local(stored, "splat")
    if path.suffix.lower() != ".ply":
        raise UsageError(f"{path.name} is not a PLY file.", "Choose a splat saved as PLY, or none.")
    return _existing(path, "splat")


def _local(stored: str, what: str) -> Path:
    path = Path(bpy.path.abspath(stored))
    # A path in the open file may come from elsewhere: no server name is resolved.
    if addon.is_remote(path):
        raise UsageError(f"{path} is on another computer.", f"Copy the {what} to this one.")
    return path


def _existing(path: Path, what: str) -> str:
    if not path.is_file():
        raise UsageError(
            f"The {what} {path} does not exist.",
            "Choose it again in Train, Advanced, or clear the field.",
        )
    return str(real_path(path))


def preset_lines(name: str) -> tuple[str, ...]:
    """Return lines on the preset's values, which apply where a number is 0."""
    training = preset(name.lower()).training
    return (
        tr(
            "0 takes {preset}'s: {iterations},",
            preset=tr(name.capitalize()), iterations=f"{training.iterations:,}",
        ),
        tr(
            "{gaussians} and {pixels} px",
            gaussians=f"{training.max_gaussians:,}", pixels=f"{training.max_image_px:,}",
        ),
    )  # fmt: skip


def choices_key(scene: bpy.types.Scene) -> tuple[object, ...]:
    """Return what an estimate of time and memory depends on; reads no file, for panels."""
    properties = properties_of(scene)
    known = settings_of_scene()
    decisive = (d for d in known if d.property_owner == "training" or d.panel_name == "dataset")
    own = (properties.source, properties.preset, properties.texture_size)
    return (*own, *(_stored(d, properties) for d in decisive))


# -- Stage of a scene and the button of the next step; reads no file, for panels and polls --------


class Stage(enum.Enum):
    """Stage of a scene's work, as the tab shows it."""

    NO_DATA = "no data"
    BAD_DATA = "the check found errors"
    READY = "photos are chosen, nothing is made of them yet"
    RUNNING = "a job runs"
    STOPPED = "a job was cancelled or has failed"
    NOT_OPEN = "the file names a job that is not watched"
    GONE = "the file names a job whose folder is not there any more"
    WAITING = "finished, but Blender is in a mode in which nothing can be imported"
    IMPORTABLE = "finished, but the scene does not show it"
    FINISHED = "the scene shows a result"


PRIMARY: Final = {
    Stage.NO_DATA: "gwrap.choose_input",
    Stage.BAD_DATA: "gwrap.choose_input",
    Stage.READY: "gwrap.wrap_scene",
    Stage.RUNNING: "gwrap.cancel_job",
    Stage.STOPPED: "gwrap.resume_job",
    Stage.NOT_OPEN: "gwrap.resume_job",
    Stage.GONE: "gwrap.find_job",
    Stage.WAITING: "object.mode_set",
    Stage.IMPORTABLE: "gwrap.import_result",
    Stage.FINISHED: "gwrap.mesh_region",
}
"""The one large button of each stage."""


def stage_of(context: bpy.types.Context) -> Stage:
    """Return the stage of the scene."""
    scene = context.scene
    properties = properties_of(scene)
    frame = addon.current_frame(context)
    if properties.job_folder:
        status = job_timer.status_of(properties.job_folder)
        if status is None:
            return Stage.GONE if job_timer.is_gone(properties.job_folder) else Stage.NOT_OPEN
        if status.active:
            return Stage.RUNNING
        if status.state != "DONE":
            return Stage.STOPPED
        if job_timer.waits_for_object_mode(properties.job_folder):
            return Stage.WAITING
        if job_timer.result_to_import(scene):
            return Stage.IMPORTABLE
        if frame is not None:
            return Stage.FINISHED
    elif frame is not None and not properties.source:
        return Stage.FINISHED
    if not properties.source:
        return Stage.NO_DATA
    return Stage.BAD_DATA if has_errors(scene) else Stage.READY


def primary_of(context: bpy.types.Context) -> str:
    """Return the operator that is the next step."""
    return PRIMARY[stage_of(context)]


def is_checked(scene: bpy.types.Scene) -> bool:
    """Return whether the stored findings are those of the chosen input."""
    properties = properties_of(scene)
    return bool(properties.source) and properties.checked_source == properties.source


def has_errors(scene: bpy.types.Scene) -> bool:
    """Return whether the check found errors that prevent loading the input."""
    return is_checked(scene) and any(f.severity == "error" for f in properties_of(scene).findings)

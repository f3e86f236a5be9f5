# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of a job from the properties of the panels."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy

from ...core.cluster.addresses import scheduler_address
from ...core.errors import UsageError
from ...core.files import real_path
from ...core.settings import Declaration, JobSettings, declarations, preset, with_values
from ...core.settings.farm import LOCAL
from ...core.settings.markers import checked_markers
from ..common import known_jobs
from ..common.addon import properties_of
from ..common.translate import tr


def settings_of_scene() -> list[Declaration]:
    """Return the settings that a scene has a property for."""
    return [
        declared
        for declared in declarations(JobSettings)
        if declared.panel is not None and declared.property_owner != "preferences"
    ]


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

    Parameters
    ----------
    properties : bpy.types.PropertyGroup
        ``Scene.gwrap``.
    """
    values = {}
    for declared in settings:
        panel, stored = declared.panel, _stored(declared, properties)
        if panel is None or (panel.preset_if_zero and not stored):
            continue
        hidden = panel.default_if_hidden and not is_shown(declared, properties)
        values[declared.path] = declared.default if hidden else declared.from_panel(stored)
    return values


def _stored(declared: Declaration, properties: bpy.types.PropertyGroup) -> Any:
    owner: Any = properties
    owner = owner.training if declared.property_owner == "training" else owner
    return getattr(owner, declared.property_name)


def job_settings(scene: bpy.types.Scene, threads: int, device: str = "auto") -> JobSettings:
    """Return the job settings of a scene's panels: the preset, then the choices.

    Meshing settings are omitted: a job that trains uses their defaults.

    Raises
    ------
    UsageError
        The splat to start from or the control points do not exist, or the markers are none.
    """
    settings = [declared for declared in settings_of_scene() if declared.group != "meshing"]
    values = chosen_values(properties_of(scene), settings)
    values["start_splat"] = _splat(values["start_splat"])
    values["markers"] = checked_markers(values["markers"])
    values["control_points"] = _control_points(values["control_points"])
    values["mask_model"] = _mask_model(values["mask_model"])
    values |= computers_choices(scene)
    name = values.pop("preset")
    decided = {
        declared.path
        for declared in settings
        if declared.model_selection
        and name in declared.presets
        and values[declared.path] == declared.default
    }  # Auto leaves it to the preset
    given = {path: value for path, value in values.items() if path not in decided}
    return with_values(preset(name, threads=threads, device=device), given)


def computers_choices(scene: bpy.types.Scene) -> dict[str, Any]:
    """Return the settings, by path, that say where the parts of a job run.

    Raises
    ------
    UsageError
        The address of the Dask scheduler is none, or not encrypted; the folder of the certificates
        is on another computer.
    """
    properties = properties_of(scene)
    choices, processes = properties.computers, properties.processes
    where = ""
    if choices.kind == "DASK":
        where = str(scheduler_address(choices.dask_address))
    elif choices.kind == "THIS" and processes > 1:
        where = LOCAL
    certificates = certificates_of(scene)
    if where != LOCAL:
        processes = JobSettings().processes
    return {"computers": where, "processes": processes, "certificates": certificates}


def certificates_of(scene: bpy.types.Scene) -> str:
    """Return the folder of the farm's certificates; ``""`` leaves it to the environment.

    Raises
    ------
    UsageError
        It is on another computer.
    """
    stored = properties_of(scene).computers.certificates
    return str(_local(stored, "folder of certificates")) if stored else ""


def meshing_choices(scene: bpy.types.Scene, world_per_blender: float) -> dict[str, Any]:
    """Return the meshing settings, by path, of a scene's panels.

    Parameters
    ----------
    world_per_blender : float
        World units of the input per unit of length in Blender.
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
    settings = [
        declared
        for declared in settings_of_scene()
        if declared.option is not None and declared.scope == "method"
    ]
    values = chosen_values(properties_of(scene), settings)
    return {path.rpartition(".")[2]: value for path, value in values.items()}


def texture_choices(scene: bpy.types.Scene) -> dict[str, Any]:
    """Return the texture settings, by path, of a scene's panels."""
    settings = [declared for declared in settings_of_scene() if declared.group == "texture"]
    return chosen_values(properties_of(scene), settings)


def _mask_model(stored: str) -> str:
    if not stored:
        return ""
    path = Path(bpy.path.abspath(stored))
    if known_jobs.is_remote(path):  # as of a splat
        raise UsageError(f"{path} is on another computer.", "Copy the mask model to this one.")
    return str(path)


def _splat(stored: str) -> str:
    if not stored:
        return ""
    path = _local(stored, "splat")
    if path.suffix.lower() != ".ply":
        raise UsageError(f"{path.name} is not a PLY file.", "Choose a splat saved as PLY, or none.")
    return _existing(path, "splat")


def _control_points(stored: str) -> str:
    return _existing(_local(stored, "file"), "file of control points") if stored else ""


def _local(stored: str, what: str) -> Path:
    path = Path(bpy.path.abspath(stored))
    # A path in the open file may come from elsewhere: no server name is resolved.
    if known_jobs.is_remote(path):
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
    own = (properties.source, properties.preset, properties.texture_size)
    decisive = [
        d
        for d in settings_of_scene()
        if d.property_owner == "training" or d.panel_name == "dataset"
    ]
    return (*own, *(_stored(declared, properties) for declared in decisive))

# SPDX-License-Identifier: GPL-3.0-or-later
"""From the choices of the sub-panel "Training" to the settings of a job."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import bpy

from ..core.errors import UsageError
from ..core.settings import JobSettings, preset
from . import known_jobs

DECISIONS = ("harmonics", "exposure", "multi_view", "wrapping", "growth")
NUMBERS = ("iterations", "max_gaussians", "max_image_px")
"""Properties whose 0 leaves the preset's number."""


def job_settings(scene: bpy.types.Scene, threads: int) -> JobSettings:
    """Return the settings that the panels of a scene ask for: the preset, then the choices.

    Raises
    ------
    UsageError
        The splat to start from is not there.
    """
    properties = scene.gwrap
    choices = properties.training
    settings = preset(properties.preset.lower(), threads=threads)
    changes = {name: getattr(choices, name).lower() for name in (*DECISIONS, "mask_mode")}
    changes |= {name: value for name in NUMBERS if (value := getattr(choices, name))}
    return replace(
        settings,
        start_splat=_splat(choices.start_splat),
        training=replace(settings.training, **changes),
        texture=replace(settings.texture, **texture_choices(scene)),
    )


def texture_choices(scene: bpy.types.Scene) -> dict[str, object]:
    """Return the texture settings that the panels of a scene ask for."""
    properties = scene.gwrap
    return {
        "size_px": int(properties.texture_size),
        "source": properties.texture_source.lower(),
        "normal_map": properties.normal_map.lower(),
        "ambient_occlusion": "on" if properties.ambient_occlusion else "off",
        "lods": properties.lods,
        "max_atlases": properties.max_atlases,
    }


def _splat(stored: str) -> str:
    if not stored:
        return ""
    path = Path(bpy.path.abspath(stored))
    # A path in the open file may come from elsewhere: no name of a server is looked up.
    if known_jobs.is_remote(path):
        raise UsageError(f"{path} lies on another machine.", "Copy the splat to this one.")
    if path.suffix.lower() != ".ply":
        raise UsageError(f"{path.name} is no PLY file.", "Choose a splat saved as PLY, or none.")
    if not path.is_file():
        raise UsageError(
            f"The splat {path} does not exist.",
            "Choose it again in Train, Advanced, or clear the field.",
        )
    return str(path.resolve())


def preset_lines(name: str) -> tuple[str, ...]:
    """Return what the preset of a scene takes where a number is 0."""
    training = preset(name.lower()).training
    return (
        f"0 takes {name.capitalize()}'s: {training.iterations:,},",
        f"{training.max_gaussians:,} and {training.max_image_px:,} px",
    )


def choices_key(scene: bpy.types.Scene) -> tuple[object, ...]:
    """Return what an estimate of time and memory depends on; reads no file, for panels."""
    properties, choices = scene.gwrap, scene.gwrap.training
    names = (*DECISIONS, "mask_mode", *NUMBERS, "start_splat")
    own = (properties.source, properties.preset, properties.texture_size)
    return (*own, *(getattr(choices, name) for name in names))

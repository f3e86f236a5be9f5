# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties edited by the panels: ``Scene.gwrap``.

Settings of a job come from their declarations (``panel_base.py``). Regions have
``Object.gwrap`` (``region_panel.py``). All other tags of objects are plain custom properties
(``ops/addon.py``), which also exist where the add-on is not enabled. No property has a
callback: in Blender 4.2 one that ever had crashes the process at exit.
"""

from typing import Final

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    PointerProperty,
    StringProperty,
)

from .computers_panel import GWRAP_PG_computers
from .mesh_panel import GWRAP_PG_bake
from .panel_base import with_settings
from .region_panel import GWRAP_PG_region
from .training_panel import GWRAP_PG_training

_RESOLUTIONS: Final = (
    ("AUTOMATIC", "Automatic", "As fine as the photos allow within the preset"),
    ("EDGE_LENGTH", "Edge Length", "Triangles with edges of this length"),
    ("POINTS", "Points", "This many points on the surface"),
)


class GWRAP_PG_finding(bpy.types.PropertyGroup):
    """One line of the photo check."""

    severity: StringProperty()  # type: ignore[valid-type]
    message: StringProperty()  # type: ignore[valid-type]
    hint: StringProperty()  # type: ignore[valid-type]
    extra: StringProperty()  # type: ignore[valid-type]


@with_settings("scene")
class GWRAP_PG_scene(bpy.types.PropertyGroup):
    """Input, output and job of a scene, and the settings that its panels show."""

    source: StringProperty(  # type: ignore[valid-type]
        name="Input",
        description=(
            "Folder of photos, of a COLMAP project, or with a transforms.json; a video, the camera "
            "file of another program, or the PLY of a 3D Gaussian splat"
        ),
    )
    output: StringProperty(  # type: ignore[valid-type]
        name="Output",
        description="Folder for the job and its results; empty makes one beside the photos",
        subtype="DIR_PATH",
    )
    resolution: EnumProperty(  # type: ignore[valid-type]
        name="Resolution",
        description="How the resolution of a mesh is set",
        items=_RESOLUTIONS,
        default="AUTOMATIC",
    )
    decimate: BoolProperty(  # type: ignore[valid-type]
        name="Limit Faces",
        description="Decimate the mesh; it stays closed and keeps its parts and holes",
    )
    show_points: BoolProperty(  # type: ignore[valid-type]
        name="Points in 3D View",
        description="Draw the Gaussians of the running training as points in the 3D view",
        default=True,
    )
    training: PointerProperty(type=GWRAP_PG_training)  # type: ignore[valid-type]
    job_folder: StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]
    job_command: EnumProperty(  # type: ignore[valid-type]
        items=(("WRAP", "Wrap", ""), ("MESH", "Mesh", ""), ("BAKE", "Bake", "")), options={"HIDDEN"}
    )
    bake: PointerProperty(type=GWRAP_PG_bake)  # type: ignore[valid-type]
    computers: PointerProperty(type=GWRAP_PG_computers)  # type: ignore[valid-type]
    checked_source: StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]
    checked_text: StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]
    checked_kind: StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]
    findings: CollectionProperty(type=GWRAP_PG_finding, options={"HIDDEN"})  # type: ignore[valid-type]


CLASSES: Final = (GWRAP_PG_finding, GWRAP_PG_scene)


def add_pointers() -> None:
    """Add the properties of scenes and regions."""
    bpy.types.Scene.gwrap = PointerProperty(type=GWRAP_PG_scene)  # type: ignore[attr-defined]
    bpy.types.Object.gwrap = PointerProperty(type=GWRAP_PG_region)  # type: ignore[attr-defined]


def remove_pointers() -> None:
    """Remove the properties if they exist."""
    for owner in (bpy.types.Object, bpy.types.Scene):
        if hasattr(owner, "gwrap"):
            del owner.gwrap

# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panels edit: ``Scene.gwrap`` and ``Object.gwrap``."""

from typing import Final

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..ops import tags

_PRESETS: Final = (
    ("DRAFT", "Draft", "A first look: small images, few Gaussians"),
    ("STANDARD", "Standard", "For most scenes"),
    ("FINE", "Fine", "Larger images and more Gaussians; needs several times as long"),
)
_RESOLUTIONS: Final = (
    ("AUTOMATIC", "Automatic", "As fine as the photos allow within the preset"),
    ("EDGE_LENGTH", "Edge Length", "Triangles with edges of this length"),
    ("POINTS", "Points", "This many points on the surface"),
)
_TEXTURE_SIZES: Final = (
    ("0", "Automatic", "As many pixels as the photos hold"),
    ("1024", "1024", "1024 pixels each way"),
    ("2048", "2048", "2048 pixels each way"),
    ("4096", "4096", "4096 pixels each way"),
    ("8192", "8192", "8192 pixels each way"),
)


def _source_changed(self: "GWRAP_PG_scene", _context: bpy.types.Context) -> None:
    self.findings.clear()


class GWRAP_PG_finding(bpy.types.PropertyGroup):
    """One line of the photo check."""

    severity: StringProperty()  # type: ignore[valid-type]
    message: StringProperty()  # type: ignore[valid-type]
    hint: StringProperty()  # type: ignore[valid-type]


class GWRAP_PG_scene(bpy.types.PropertyGroup):
    """What a scene is made of and which job works for it."""

    source: StringProperty(  # type: ignore[valid-type]
        name="Folder",
        description="Folder of photos, of a COLMAP project, or with a transforms.json",
        subtype="DIR_PATH",
        update=_source_changed,
    )
    output: StringProperty(  # type: ignore[valid-type]
        name="Output",
        description="Folder for the job and its results; empty makes one beside the photos",
        subtype="DIR_PATH",
    )
    preset: EnumProperty(  # type: ignore[valid-type]
        name="Preset", description="Quality against time", items=_PRESETS, default="STANDARD"
    )
    resolution: EnumProperty(  # type: ignore[valid-type]
        name="Resolution",
        description="What decides how fine the mesh of a region is",
        items=_RESOLUTIONS,
        default="AUTOMATIC",
    )
    edge_length: FloatProperty(  # type: ignore[valid-type]
        name="Edge Length",
        description="Length of triangle edges, as seen in Blender",
        default=0.05,
        min=1e-5,
        soft_max=1.0,
        precision=4,
        subtype="DISTANCE",
        unit="LENGTH",
    )
    points: IntProperty(  # type: ignore[valid-type]
        name="Points",
        description="Number of points on the surface of a region",
        default=50_000,
        min=100,
        max=5_000_000,
        soft_max=500_000,
    )
    texture_size: EnumProperty(  # type: ignore[valid-type]
        name="Texture Size", description="Side of the texture", items=_TEXTURE_SIZES, default="0"
    )
    job_folder: StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]
    job_command: EnumProperty(  # type: ignore[valid-type]
        items=(("WRAP", "Wrap", ""), ("MESH", "Mesh", "")), options={"HIDDEN"}
    )
    findings: CollectionProperty(type=GWRAP_PG_finding, options={"HIDDEN"})  # type: ignore[valid-type]


def _get_is_region(self: "GWRAP_PG_object") -> bool:
    return tags.kind_of(self.id_data) == "region"


def _set_is_region(self: "GWRAP_PG_object", value: bool) -> None:
    thing = self.id_data
    if value and not tags.kind_of(thing):
        thing[tags.KIND] = "region"
    elif not value and tags.kind_of(thing) == "region":
        del thing[tags.KIND]


class GWRAP_PG_object(bpy.types.PropertyGroup):
    """A view of our custom properties, which also exist where the add-on is not enabled."""

    is_region: BoolProperty(  # type: ignore[valid-type]
        name="Region",
        description="Whether this object is a region that can be meshed",
        get=_get_is_region,
        set=_set_is_region,
    )


CLASSES: Final = (GWRAP_PG_finding, GWRAP_PG_scene, GWRAP_PG_object)


def add_pointers() -> None:
    """Give scenes and objects their properties."""
    bpy.types.Scene.gwrap = PointerProperty(type=GWRAP_PG_scene)
    bpy.types.Object.gwrap = PointerProperty(type=GWRAP_PG_object)


def remove_pointers() -> None:
    """Take them away, as far as they are there."""
    for owner in (bpy.types.Scene, bpy.types.Object):
        if hasattr(owner, "gwrap"):
            del owner.gwrap

# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panels edit: ``Scene.gwrap``.

Regions have ``Object.gwrap`` (``region_properties.py``). All other marks of objects are plain
custom properties (``ops/tags.py``), which also exist where the add-on is not enabled. No property
has a callback: in Blender 4.2 one that ever had crashes the process at exit.
"""

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

from ..core import limits
from .region_properties import GWRAP_PG_region
from .training_properties import GWRAP_PG_training

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
_METHODS: Final = (
    ("PAM", "Adaptive", "Primal adaptive meshing: at the chosen resolution"),
    ("PIVOTS", "Pivots", "Marching tetrahedra on the Gaussians' pivots: as fine as they lie"),
)
_SPACINGS: Final = (
    ("ADAPTIVE", "Adaptive", "Vertices where the shape needs them: as true with half as many"),
    ("UNIFORM", "Uniform", "Vertices evenly spread: even triangles"),
)
_PIVOTS: Final = (
    ("2", "2", "Centre and outer pivot"),
    ("3", "3", "Outer pivots on both sides"),
    ("9", "9", "Centre and the corners of a box; several times as many triangles"),
)
_BOUNDARIES: Final = (
    ("CLOSED", "Closed", "Flat faces close the mesh where the region cuts through things"),
    ("OPEN", "Open", "The mesh ends there with an open edge"),
)
_UNSEEN: Final = (
    ("EMPTY", "Empty", "Nothing stands where no camera looks"),
    ("OCCUPIED", "Occupied", "Something stands there: closes the backs of things"),
)
_NORMAL_MAPS: Final = (
    ("AUTO", "Automatic", "Where the faces are limited: what they no longer show"),
    ("ON", "On", "Always; flat where no face was taken away"),
    ("OFF", "Off", "No normal map"),
)
_TEXTURE_SIZES: Final = (
    ("0", "Automatic", "As many pixels as the photos hold"),
    ("1024", "1024", "1024 pixels each way"),
    ("2048", "2048", "2048 pixels each way"),
    ("4096", "4096", "4096 pixels each way"),
    ("8192", "8192", "8192 pixels each way"),
)
_TEXTURE_SOURCES: Final = (
    ("PHOTOS", "Photos", "The photos' own pixels, blended: the finest detail"),
    (
        "GAUSSIANS",
        "Gaussians",
        "What the Gaussians have learned, without highlights and passers-by: even, but softer",
    ),
)


class GWRAP_PG_finding(bpy.types.PropertyGroup):
    """One line of the photo check."""

    severity: StringProperty()  # type: ignore[valid-type]
    message: StringProperty()  # type: ignore[valid-type]
    hint: StringProperty()  # type: ignore[valid-type]


class GWRAP_PG_scene(bpy.types.PropertyGroup):
    """What a scene is made of and which job works for it."""

    source: StringProperty(  # type: ignore[valid-type]
        name="Input",
        description=(
            "Folder of photos, of a COLMAP project, or with a transforms.json; or the PLY of a "
            "3D Gaussian splat"
        ),
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
    method: EnumProperty(  # type: ignore[valid-type]
        name="Method", description="How the mesh is made", items=_METHODS, default="PAM"
    )
    spacing: EnumProperty(  # type: ignore[valid-type]
        name="Spacing", description="Where vertices stand", items=_SPACINGS, default="ADAPTIVE"
    )
    pivots: EnumProperty(  # type: ignore[valid-type]
        name="Pivots", description="Points of each Gaussian", items=_PIVOTS, default="2"
    )
    boundary: EnumProperty(  # type: ignore[valid-type]
        name="Boundary",
        description="How the mesh ends at the region's boundary",
        items=_BOUNDARIES,
        default="CLOSED",
    )
    unseen: EnumProperty(  # type: ignore[valid-type]
        name="Unseen", description="What stands where no camera looks", items=_UNSEEN,
        default="EMPTY",
    )  # fmt: skip
    decimate: BoolProperty(  # type: ignore[valid-type]
        name="Limit Faces",
        description="Decimate the mesh; it stays closed, and its parts and holes stay",
        default=False,
    )
    target_faces: IntProperty(  # type: ignore[valid-type]
        name="Faces",
        description="Number of triangles that the mesh is decimated to",
        default=20_000,
        min=4,
        max=20_000_000,
        soft_max=1_000_000,
    )
    smooth_steps: IntProperty(  # type: ignore[valid-type]
        name="Smooth Steps",
        description="Steps of smoothing that keeps the volume; 0 leaves the surface as measured",
        default=0,
        min=0,
        max=1000,
        soft_max=20,
    )
    texture_size: EnumProperty(  # type: ignore[valid-type]
        name="Texture Size", description="Side of the texture", items=_TEXTURE_SIZES, default="0"
    )
    normal_map: EnumProperty(  # type: ignore[valid-type]
        name="Normal Map",
        description="Detail of the mesh before its faces were limited, as a texture",
        items=_NORMAL_MAPS,
        default="AUTO",
    )
    ambient_occlusion: BoolProperty(  # type: ignore[valid-type]
        name="Ambient Occlusion",
        description="Write how open the surface is as a texture, for glTF and game engines",
        default=False,
    )
    lods: IntProperty(  # type: ignore[valid-type]
        name="Levels of Detail",
        description="Coarser meshes, each with a quarter of the faces of the one before",
        default=0,
        min=0,
        max=8,
    )
    max_atlases: IntProperty(  # type: ignore[valid-type]
        name="Max Textures",
        description=(
            "Textures that a mesh may be spread over where the photos show more than one holds; "
            "0 decides by itself"
        ),
        default=0,
        min=0,
        max=limits.MAX_ATLASES,
    )
    texture_source: EnumProperty(  # type: ignore[valid-type]
        name="Texture From",
        description="Where the colours of the texture come from",
        items=_TEXTURE_SOURCES,
        default="PHOTOS",
    )
    training: PointerProperty(type=GWRAP_PG_training)  # type: ignore[valid-type]
    job_folder: StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]
    job_command: EnumProperty(  # type: ignore[valid-type]
        items=(("WRAP", "Wrap", ""), ("MESH", "Mesh", "")), options={"HIDDEN"}
    )
    checked_source: StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]
    checked_text: StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]
    findings: CollectionProperty(type=GWRAP_PG_finding, options={"HIDDEN"})  # type: ignore[valid-type]


CLASSES: Final = (GWRAP_PG_finding, GWRAP_PG_scene)


def add_pointers() -> None:
    """Give scenes and regions their properties."""
    bpy.types.Scene.gwrap = PointerProperty(type=GWRAP_PG_scene)
    bpy.types.Object.gwrap = PointerProperty(type=GWRAP_PG_region)


def remove_pointers() -> None:
    """Take them away, where they are there."""
    for owner in (bpy.types.Object, bpy.types.Scene):
        if hasattr(owner, "gwrap"):
            del owner.gwrap

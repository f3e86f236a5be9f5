# SPDX-License-Identifier: GPL-3.0-or-later
"""Choices of **Bake Photos**: ``Scene.gwrap.bake``."""

from typing import Final

import bpy
from bpy.props import EnumProperty, IntProperty, PointerProperty

from ...ops.baking.quads import MAX_TRIANGLES

_UVS: Final = (
    ("AUTO", "Automatic", "The active UV map of the mesh if it has one, else a new one"),
    ("OWN", "Active UV Map", "The active UV map of the mesh, with its UDIM tiles"),
    ("NEW", "New", "Unwrap the mesh into a UV map of its own"),
)
_FACES: Final = (
    ("KEEP", "As They Are", "Bake onto the selected mesh itself"),
    ("DECIMATE", "Decimate", "Make a lighter mesh of triangles; its lost detail is a normal map"),
    (
        "QUADS",
        "Quads",
        (
            "Make a new mesh of quads with QuadriFlow; the detail of this one is a normal map. "
            "Blender waits for QuadriFlow, for seconds or a few minutes; meshes of more than "
            f"{MAX_TRIANGLES:,} triangles are decimated for it"
        ),
    ),
)


class GWRAP_PG_bake(bpy.types.PropertyGroup):
    """How photos are baked onto the active mesh."""

    uvs: EnumProperty(name="UVs", description="UV map to bake for", items=_UVS)  # type: ignore[valid-type]
    retopology: EnumProperty(  # type: ignore[valid-type]
        name="Faces", description="Which faces the photos are baked onto", items=_FACES
    )
    faces: IntProperty(  # type: ignore[valid-type]
        name="Target",
        description="Faces of the lighter mesh",
        default=5000,
        min=4,
        soft_min=100,
        soft_max=100_000,
        max=100_000_000,
    )
    quads: IntProperty(  # type: ignore[valid-type]
        name="Target",
        description="Quads of the new mesh; QuadriFlow makes up to a quarter fewer",
        default=5000,
        min=4,
        soft_min=100,
        soft_max=50_000,
        max=100_000,
    )
    dense: PointerProperty(  # type: ignore[valid-type]
        name="Detail From",
        description="Dense mesh at the same place, whose detail is baked into a normal map",
        type=bpy.types.Object,
    )


CLASSES: Final = (GWRAP_PG_bake,)

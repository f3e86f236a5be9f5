# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties of a region: ``Object.gwrap``, stored once changed."""

from typing import Final

import bpy
from bpy.props import BoolProperty

from ...core.settings import declared
from ..common.setting_properties import property_of


class GWRAP_PG_region(bpy.types.PropertyGroup):
    checked: BoolProperty(  # type: ignore[valid-type]
        name="Mesh Together",
        description="Mesh and estimate this region together with the other checked ones",
        default=False,
    )
    own_edge_length: BoolProperty(  # type: ignore[valid-type]
        name="Own Edge Length",
        description="Mesh this region with its own edge length, not that of the Mesh panel",
        default=False,
    )
    edge_length: property_of(  # type: ignore[valid-type]
        declared("meshing.edge_length"),
        description="Length of this region's triangle edges, as seen in Blender",
    )


CLASSES: Final = (GWRAP_PG_region,)

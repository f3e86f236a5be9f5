# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the jobs of a scene run: ``Scene.gwrap.computers``; no property has a callback."""

from typing import Final

import bpy
from bpy.props import EnumProperty, IntProperty, StringProperty

from ...core.farm.flamenco.submission import MAX_PRIORITY
from ...core.limits import MAX_TILES

_KINDS: Final = (
    ("THIS", "Local", "Jobs run on this computer"),
    ("DASK", "Dask", "Parts of jobs run on the computers of a Dask cluster"),
    ("FLAMENCO", "Flamenco", "Jobs are submitted to Flamenco, Blender's render farm"),
)


class GWRAP_PG_computers(bpy.types.PropertyGroup):
    """Which computers run the jobs of a scene."""

    kind: EnumProperty(  # type: ignore[valid-type]
        name="Computers", description="Computers that run the jobs of this scene", items=_KINDS
    )
    dask_address: StringProperty(  # type: ignore[valid-type]
        name="Scheduler",
        description="Address of the Dask scheduler, such as tls://computer:8786",
        default="tls://localhost:8786",
    )
    certificates: StringProperty(  # type: ignore[valid-type]
        name="Certificates",
        description=(
            "Folder of the farm's certificates, for tls:// addresses; empty uses GW_CERTIFICATES"
        ),
        subtype="DIR_PATH",
    )
    flamenco_address: StringProperty(  # type: ignore[valid-type]
        name="Manager",
        description="Address of the Flamenco Manager, such as http://computer:8080",
        default="http://localhost:8080",
    )
    shared: StringProperty(  # type: ignore[valid-type]
        name="Shared Folder",
        description=(
            "Folder of this computer that all workers see; empty uses GW_SHARED, or what the "
            "Manager says"
        ),
        subtype="DIR_PATH",
    )
    tiles: IntProperty(  # type: ignore[valid-type]
        name="Tiles",
        description=(
            "Tiles that the region is meshed in, each a part of its own; 1 meshes it in one piece"
        ),
        default=1,
        min=1,
        max=MAX_TILES,
        soft_max=64,
    )
    priority: IntProperty(  # type: ignore[valid-type]
        name="Priority",
        description="Jobs with higher numbers are first",
        default=50,
        min=0,
        max=MAX_PRIORITY,
    )
    tag: StringProperty(  # type: ignore[valid-type]
        name="Tag", description="Only workers with this tag run the job; empty allows all"
    )
    folder: StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]


CLASSES: Final = (GWRAP_PG_computers,)

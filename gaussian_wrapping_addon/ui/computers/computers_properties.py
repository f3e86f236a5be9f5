# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the jobs of a scene run: ``Scene.gwrap.computers``; no property has a callback."""

from typing import Final

import bpy
from bpy.props import EnumProperty, StringProperty

_KINDS: Final = (
    ("THIS", "Local", "Jobs run on this computer"),
    ("DASK", "Dask", "Parts of jobs run on the computers of a Dask cluster"),
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


CLASSES: Final = (GWRAP_PG_computers,)

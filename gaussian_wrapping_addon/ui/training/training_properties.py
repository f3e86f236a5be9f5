# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties of the sub-panel "Train": ``Scene.gwrap.training``; no property has a callback."""

from typing import Final

import bpy
from bpy.props import IntProperty

from ..common.setting_properties import with_settings


@with_settings("training")
class GWRAP_PG_training(bpy.types.PropertyGroup):
    """Choices that take precedence over the preset; 0 and Auto leave it to preset and photos."""

    more_iterations: IntProperty(  # type: ignore[valid-type]
        name="Iterations",
        description="How many iterations Train More adds to the finished training",
        default=1000,
        min=1,
        max=1_000_000,
        soft_min=100,
        soft_max=10_000,
        step=100,
    )


CLASSES: Final = (GWRAP_PG_training,)

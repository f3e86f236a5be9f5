# SPDX-License-Identifier: GPL-3.0-or-later
"""Base of the tab's panels: location, readiness in the header, the large button."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import bpy

from ...ops.common.translate import tr
from ...ops.jobs import panel_state

CATEGORY: Final = "Gaussian Wrapping"
LARGE: Final = 1.6
"""Height of the button that is the next step."""


if TYPE_CHECKING:
    _Panel = bpy.types.Panel
else:
    _Panel = object


@dataclass(frozen=True)
class Readiness:
    """Text at the right of a header, shown also while its panel is closed."""

    text: str
    icon: str = "NONE"
    """``"NONE"`` dims the text: nothing is there yet."""


class TabPanel(_Panel):
    """Mixin: a panel of our tab; :meth:`readiness` is drawn in its header."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = CATEGORY

    def readiness(self, context: bpy.types.Context) -> Readiness:
        """Return the progress of the panel's part, from memory alone."""
        raise NotImplementedError

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        """Draw at the right of the header; Blender calls this."""
        ready = self.readiness(context)
        row: Any = self.layout.row()
        row.active = ready.icon != "NONE"
        row.label(text=tr(ready.text), icon=ready.icon, translate=False)
        row.separator(factor=0.25)


def plain(layout: Any) -> None:
    """Set the layout: names at the left, values at the right, no animation dots."""
    layout.use_property_split = True
    layout.use_property_decorate = False


def button(layout: Any, context: bpy.types.Context, operator: str, **keywords: Any) -> Any:
    """Draw an operator, large if it is the next step; return its properties."""
    row = layout.row()
    if panel_state.primary_of(context) == operator:
        row.scale_y = LARGE
    return row.operator(operator, **keywords)


def table(layout: Any, rows: tuple[tuple[str, str], ...]) -> None:
    """Draw names at the left and values at the right."""
    column = layout.column(align=True)
    column.scale_y = 0.9
    for name, value in rows:
        split = column.split(factor=0.55)
        split.label(text=tr(name), translate=False)
        right = split.row()
        right.alignment = "RIGHT"
        right.label(text=tr(value), translate=False)

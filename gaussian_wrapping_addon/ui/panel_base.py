# SPDX-License-Identifier: GPL-3.0-or-later
"""Panels: base class, wrapped text, properties made from settings, drawing in views."""

from __future__ import annotations

import logging
import math
import textwrap
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..core.evaluation.report.figures import duration
from ..core.settings import Declaration, JobSettings, declarations
from ..core.settings.declaration import Owner, PanelName, Range
from ..ops import job_timer
from ..ops.addon import tr
from ..ops.panel_settings import is_shown, owner_of, primary_of

# -- Text for narrow panels: wrapped lines, spans of time, counts ---------------------------------


# Width of an average character of Blender's interface font at scale 1, pixels.
_CHARACTER_PX = 6.6
_MARGIN_PX = 60
_NEVER_FIRST = "、。，．：；）」』！？…・ーっゃゅょッャュョ"
"""Characters that begin no line of Japanese."""


def characters_of(context: Any) -> int:
    """Return how many characters fit on a line of the panel's region."""
    region = getattr(context, "region", None)
    width_px = region.width if region is not None else 0
    scale = context.preferences.system.ui_scale
    return max(24, int((width_px / scale - _MARGIN_PX) / _CHARACTER_PX)) if width_px else 40


def wrapped_label(layout: Any, text: str, characters: int, *, icon: str = "NONE") -> None:
    """Draw a sentence, translated, over as many lines as it needs; the icon stands before it."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    for index, line in enumerate(wrapped(tr(text), characters)):
        rest = "BLANK1" if icon != "NONE" else "NONE"
        column.label(text=line, icon=icon if index == 0 else rest, translate=False)


def wrapped(text: str, characters: int) -> list[str]:
    """Return the lines of a text; a character of Chinese or Japanese is as wide as two others.

    Text without blanks, as in Japanese, is cut after any character, but not before punctuation.
    """
    if not any(map(_is_wide, text)):
        return textwrap.wrap(text, characters) or [""]
    lines, width = [""], 0
    for piece in _pieces(text, characters):
        wide = sum(1 + _is_wide(character) for character in piece)
        if lines[-1] and width + wide > characters and piece not in _NEVER_FIRST:
            lines.append("")
            width = 0
        lines[-1] += piece
        width += wide
    return [line.strip() for line in lines]


def _pieces(text: str, most: int) -> Iterator[str]:
    """Yield what stays together on a line: wide characters alone, others as words."""
    word = ""
    for character in text:
        if len(word) == most or (word and (character == " " or _is_wide(character))):
            yield word
            word = ""
        if character == " " or _is_wide(character):
            yield character
        else:
            word += character
    yield word


def _is_wide(character: str) -> bool:
    return unicodedata.east_asian_width(character) in "WF"


def progress_text(stage: str, fraction: float, seconds_left: float | None) -> str:
    """Return the line on the progress bar: stage, percent, time left."""
    parts = [tr(stage.capitalize() or "Starting"), f"{100 * fraction:.0f} %"]
    if seconds_left is not None:
        parts.append(tr("{time} left", time=duration(seconds_left)))
    return " · ".join(parts)


def count_of_regions(count: int) -> str:
    """Return how many regions there are, in words of the interface's language."""
    return tr("1 region") if count == 1 else tr("{count} regions", count=count)


# -- Base of the tab's panels: location, readiness in the header, the large button ----------------


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


class InTab(_Panel):
    """Mixin: a panel of our tab."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = CATEGORY


class TabPanel(InTab):
    """Mixin: a panel of our tab; :meth:`readiness` is drawn in its header."""

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


def plain(layout: Any) -> Any:
    """Set the layout: names at the left, values at the right, no animation dots; return it."""
    layout.use_property_split = True
    layout.use_property_decorate = False
    return layout


def column_of_choices(layout: Any, properties: Any) -> Any:
    """Return a new column of a plain layout, dimmed while the scene's job runs."""
    column = plain(layout).column()
    column.enabled = not job_timer.is_running(properties.job_folder)
    return column


def button(layout: Any, context: bpy.types.Context, operator: str, **keywords: Any) -> Any:
    """Draw an operator, large if it is the next step; return its properties."""
    row = layout.row()
    if primary_of(context) == operator:
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


# -- Blender properties and rows of panels, made from the declarations of the settings ------------


_Group = TypeVar("_Group", bound=type)


def property_of(declared: Declaration, **changes: Any) -> Any:
    """Return the property of a setting, for a class's annotations.

    ``changes``: keywords of Blender's property that differ from the declaration.
    """
    panel = declared.panel
    assert panel is not None
    default = declared.default if panel.default is None else panel.default
    keywords: dict[str, Any] = {"name": panel.label, "description": panel.description}
    if panel.items:
        items = [(declared.to_panel(i.value), i.label, i.description) for i in panel.items]
        return EnumProperty(
            **(keywords | {"items": items, "default": declared.to_panel(default)} | changes)
        )
    if declared.is_switch:
        return BoolProperty(**(keywords | {"default": default == "on"} | changes))
    blender = {"subtype": panel.subtype, "unit": panel.unit}
    keywords |= {name: value for name, value in blender.items() if value}
    if declared.kind is str:
        return StringProperty(**(keywords | {"default": default} | changes))
    kind = FloatProperty if declared.kind is float else IntProperty
    keywords |= _limits(declared) | {"default": 0 if panel.preset_if_zero else default}
    return kind(**(keywords | changes))


def _limits(declared: Declaration) -> dict[str, Any]:
    panel, check = declared.panel, declared.check
    assert panel is not None
    low, high = panel.low, math.inf
    if isinstance(check, Range):
        high = check.high
        if low is None:
            low = 0 if panel.preset_if_zero else check.lowest
    numbers = {
        "min": low, "max": high if math.isfinite(high) else None,
        "soft_min": panel.soft_low, "soft_max": panel.soft_high,
    }  # fmt: skip
    limits = {name: declared.kind(value) for name, value in numbers.items() if value is not None}
    shown = {"step": panel.step, "precision": panel.precision}
    return limits | {name: value for name, value in shown.items() if value is not None}


def with_settings(owner: Owner) -> Callable[[_Group], _Group]:
    """Return a decorator that gives a class the properties of the settings that it owns."""

    def give(cls: _Group) -> _Group:
        for declared in declarations(JobSettings):
            if declared.panel is not None and declared.property_owner == owner:
                cls.__annotations__[declared.property_name] = property_of(declared)
        return cls

    return give


def settings_in(panel_name: PanelName) -> list[Declaration]:
    """Return the settings that a panel shows, in its order."""
    shown = [
        d for d in declarations(JobSettings) if d.panel is not None and d.panel_name == panel_name
    ]
    return sorted(shown, key=lambda declared: declared.panel.order if declared.panel else 0)


def draw_settings(layout: Any, properties: Any, settings: Iterable[Declaration]) -> None:
    """Draw a row for each setting that applies to the current choices.

    ``properties``: ``Scene.gwrap``.
    """
    for declared in settings:
        panel = declared.panel
        if panel is None or not is_shown(declared, properties):
            continue
        target = layout.row() if panel.expand else layout
        keywords: dict[str, Any] = {"text": panel.drawn_label} if panel.drawn_label else {}
        if panel.expand:
            keywords["expand"] = True
        target.prop(owner_of(declared, properties), declared.property_name, **keywords)


# -- Draw handlers of the 3D views: added once, taken away whole, and no error at every redraw ----


_logger = logging.getLogger(__name__)


class ViewDrawing:
    """What draws into each 3D view with shown overlays.

    Parameters
    ----------
    what : str
        What is drawn, for the log.
    draw : callable
        Draws into the view of a context.
    forget : callable
        Gives up shaders and batches; they are made again next time.
    """

    def __init__(
        self, what: str, draw: Callable[[bpy.types.Context], None], forget: Callable[[], None]
    ) -> None:
        self.handle: Any = None
        self._what, self._draw, self._forget = what, draw, forget
        self.failed = False

    def start(self) -> None:
        """Start drawing."""
        self.stop()
        self.handle = bpy.types.SpaceView3D.draw_handler_add(self.draw, (), "WINDOW", "POST_VIEW")

    def stop(self) -> None:
        """Stop drawing."""
        if self.handle is not None:
            bpy.types.SpaceView3D.draw_handler_remove(self.handle, "WINDOW")
        self.handle, self.failed = None, False
        self._forget()

    def draw(self, context: bpy.types.Context | None = None) -> None:
        """Draw into the view of a context, the present one by default. The first error is logged.

        Blender calls this.
        """
        try:
            context = context or bpy.context
            space: Any = context.space_data
            if space is not None and space.overlay.show_overlays:
                self._draw(context)
        except Exception:  # an exception here would recur at every redraw
            if not self.failed:
                _logger.exception("%s cannot be drawn", self._what)
            self.failed = True

# SPDX-License-Identifier: GPL-3.0-or-later
"""Text for narrow panels: wrapped lines, spans of time, counts."""

from __future__ import annotations

import textwrap
from typing import Any

from ...core.evaluation.report.text import duration

# Width of an average character of Blender's interface font at scale 1, pixels.
_CHARACTER_PX = 6.6
_MARGIN_PX = 60


def characters_of(context: Any) -> int:
    """Return how many characters fit on a line of the panel's region."""
    region = getattr(context, "region", None)
    width_px = region.width if region is not None else 0
    scale = context.preferences.system.ui_scale
    return max(24, int((width_px / scale - _MARGIN_PX) / _CHARACTER_PX)) if width_px else 40


def wrapped_label(layout: Any, text: str, characters: int, *, icon: str = "NONE") -> None:
    """Draw a sentence over as many lines as it needs; the icon stands before the first."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    for index, line in enumerate(textwrap.wrap(text, characters) or [""]):
        rest = "BLANK1" if icon != "NONE" else "NONE"
        column.label(text=line, icon=icon if index == 0 else rest, translate=False)


def time_span(seconds: float) -> str:
    """Return a time span in words."""
    return duration(seconds)


def progress_text(stage: str, fraction: float, seconds_left: float | None) -> str:
    """Return the line on the progress bar: stage, percent, time left."""
    parts = [stage.capitalize() or "Starting", f"{100 * fraction:.0f} %"]
    if seconds_left is not None:
        parts.append(f"{time_span(seconds_left)} left")
    return " · ".join(parts)

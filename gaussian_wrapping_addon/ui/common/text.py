# SPDX-License-Identifier: GPL-3.0-or-later
"""Text for narrow panels: wrapped lines, spans of time, counts."""

from __future__ import annotations

import textwrap
import unicodedata
from collections.abc import Iterator
from typing import Any

from ...core.evaluation.report.text import duration
from ...ops.common.translate import tr

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
        wide = sum(2 if _is_wide(character) else 1 for character in piece)
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


def time_span(seconds: float) -> str:
    """Return a time span in words."""
    return duration(seconds)


def progress_text(stage: str, fraction: float, seconds_left: float | None) -> str:
    """Return the line on the progress bar: stage, percent, time left."""
    parts = [tr(stage.capitalize() or "Starting"), f"{100 * fraction:.0f} %"]
    if seconds_left is not None:
        parts.append(tr("{time} left", time=time_span(seconds_left)))
    return " · ".join(parts)


def count_of_regions(count: int) -> str:
    """Return how many regions there are, in words of the interface's language."""
    return tr("1 region") if count == 1 else tr("{count} regions", count=count)

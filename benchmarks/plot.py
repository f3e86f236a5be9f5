# SPDX-License-Identifier: GPL-3.0-or-later
"""Plots with logarithmic axes, written as SVG by hand: no plotting library is needed."""

from __future__ import annotations

import dataclasses
import html
import math
from pathlib import Path

_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#8b4513")
"""Told apart by colour-blind people (Okabe and Ito)."""
_WIDTH, _HEIGHT = 460, 360
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 14, 34, 46


@dataclasses.dataclass(frozen=True)
class Series:
    """Points of one name."""

    name: str
    points: list[tuple[float, float]]
    line: bool = True


@dataclasses.dataclass(frozen=True)
class Panel:
    """One diagram; both axes are logarithmic."""

    title: str
    x_label: str
    y_label: str
    series: list[Series]
    legend_low: bool = False
    """Legend at the lower left instead of the upper left."""


def _decades(values: list[float]) -> tuple[int, int]:
    """Return exponents of ten around all values."""
    low, high = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
    return low, max(high, low + 1)


def _tick(exponent: int) -> str:
    return f"{10.0**exponent:g}" if -3 <= exponent <= 6 else f"1e{exponent}"


def _panel(panel: Panel, left: int) -> list[str]:
    points = [p for s in panel.series for p in s.points if min(p) > 0.0 and math.isfinite(sum(p))]
    x0, x1 = _decades([p[0] for p in points])
    y0, y1 = _decades([p[1] for p in points])
    inner_w, inner_h = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM

    def at(point: tuple[float, float]) -> tuple[float, float]:
        x = (math.log10(point[0]) - x0) / (x1 - x0)
        y = (math.log10(point[1]) - y0) / (y1 - y0)
        return left + _LEFT + inner_w * x, _TOP + inner_h * (1.0 - y)

    def text(x: float, y: float, words: str, anchor: str = "middle", extra: str = "") -> str:
        place = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{extra}'
        return f"<text {place}>{html.escape(words)}</text>"

    middle_x, middle_y = left + _LEFT + inner_w / 2, _TOP + inner_h / 2
    parts = [
        (
            f'<rect x="{left + _LEFT}" y="{_TOP}" width="{inner_w}" height="{inner_h}" '
            'fill="none" stroke="#888"/>'
        ),
        text(middle_x, 20, panel.title, extra=' font-weight="bold"'),
        text(middle_x, _HEIGHT - 8, panel.x_label),
        text(
            left + 14,
            middle_y,
            panel.y_label,
            extra=f' transform="rotate(-90 {left + 14} {middle_y:.1f})"',
        ),
    ]
    for exponent in range(x0, x1 + 1):
        x, _ = at((10.0**exponent, 10.0**y0))
        parts.append(
            f'<path d="M{x:.1f} {_TOP}V{_TOP + inner_h}" stroke="#ddd" stroke-width="0.7"/>'
        )
        parts.append(text(x, _TOP + inner_h + 15, _tick(exponent)))
    for exponent in range(y0, y1 + 1):
        _, y = at((10.0**x0, 10.0**exponent))
        parts.append(
            f'<path d="M{left + _LEFT} {y:.1f}h{inner_w}" stroke="#ddd" stroke-width="0.7"/>'
        )
        parts.append(text(left + _LEFT - 5, y + 4, _tick(exponent), "end"))
    for number, series in enumerate(panel.series):
        color = _COLORS[number % len(_COLORS)]
        places = [at(p) for p in series.points if p in points]
        if series.line and len(places) > 1:
            path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
            parts.append(
                f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="1.5"/>'
            )
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.2" fill="{color}"/>' for x, y in places]
        y = _TOP + 14 + 15 * number
        if panel.legend_low:
            y += inner_h - 15 * len(panel.series) - 8
        parts.append(f'<circle cx="{left + _LEFT + 10}" cy="{y - 4}" r="3.2" fill="{color}"/>')
        parts.append(text(left + _LEFT + 18, y, series.name, "start"))
    return parts


def write_svg(panels: list[Panel], path: Path) -> None:
    """Write panels side by side.

    Points that are not positive and finite cannot be shown on logarithmic axes and are left out.
    """
    width = _WIDTH * len(panels)
    lines = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{_HEIGHT}" '
            f'viewBox="0 0 {width} {_HEIGHT}" font-family="sans-serif" font-size="11">'
        ),
        f'<rect width="{width}" height="{_HEIGHT}" fill="white"/>',
    ]
    for number, panel in enumerate(panels):
        lines += _panel(panel, number * _WIDTH)
    path.write_text("\n".join([*lines, "</svg>"]) + "\n", encoding="utf-8")

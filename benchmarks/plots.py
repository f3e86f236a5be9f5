# SPDX-License-Identifier: GPL-3.0-or-later
"""Plots with linear or logarithmic axes as SVG, without a plotting library."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.evaluation.report.pictures import (
    COLORS,
    PLOT_HEIGHT,
    PLOT_INNER,
    PLOT_LEFT,
    PLOT_TOP,
    PLOT_WIDTH,
    linear_axis,
    svg_document,
    svg_dot,
    svg_frame,
    svg_line,
    svg_text,
    svg_ticks,
)
from gaussian_wrapping_addon.core.files import write_bytes

_COLORS = (*COLORS, "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#8b4513")


@dataclasses.dataclass(frozen=True)
class Series:
    """A named series of points, joined by a line in the order given."""

    name: str
    points: Sequence[tuple[float, float]]
    line: bool = True
    labels: Sequence[str] = ()  # Labels beside the points; none, or one for each point.
    dots: bool = True


@dataclasses.dataclass(frozen=True)
class Panel:
    """One diagram."""

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    legend_low: bool = False  # legend at the lower left instead of the upper left
    x_log: bool = True
    y_log: bool = True


@dataclasses.dataclass(frozen=True)
class _Axis:
    """Maps values onto [0, 1]."""

    low: float
    high: float
    log: bool
    ticks: tuple[float, ...]

    def share(self, value: float) -> float:
        attributes = math.log10(value) if self.log else value
        return (attributes - self.low) / (self.high - self.low)


def _axis(values: Sequence[float], log: bool) -> _Axis:
    if log:
        low = math.floor(math.log10(min(values)))
        high = max(math.ceil(math.log10(max(values))), low + 1)
        return _Axis(low, high, True, tuple(10.0**e for e in range(low, high + 1)))
    begin, end, ticks = linear_axis(values)
    return _Axis(begin, end, False, tuple(ticks))


def _tick(value: float, log: bool) -> str:
    if log and not 1e-3 <= value <= 1e6:
        return f"1e{round(math.log10(value))}"
    return f"{value:.6g}"


def _fits(panel: Panel, point: tuple[float, float]) -> bool:
    """Tell whether a point is within the domain of the axes."""
    finite = math.isfinite(point[0]) and math.isfinite(point[1])
    return finite and (not panel.x_log or point[0] > 0) and (not panel.y_log or point[1] > 0)


def _panel(panel: Panel, left: int, top: int) -> list[str]:
    points = [p for series in panel.series for p in series.points if _fits(panel, p)]
    inner_w, inner_h = PLOT_INNER
    x0, y0 = left + PLOT_LEFT, top + PLOT_TOP
    parts = svg_frame(panel.title, panel.x_label, panel.y_label, left, top)
    if not points:
        return [*parts, svg_text(x0 + inner_w / 2, y0 + inner_h / 2, "no data")]
    across = _axis([p[0] for p in points], panel.x_log)
    up = _axis([p[1] for p in points], panel.y_log)

    def at(point: tuple[float, float]) -> tuple[float, float]:
        return x0 + inner_w * across.share(point[0]), y0 + inner_h * (1.0 - up.share(point[1]))

    parts += svg_ticks(
        [(x0 + inner_w * across.share(value), _tick(value, panel.x_log)) for value in across.ticks],
        [(y0 + inner_h * (1.0 - up.share(value)), _tick(value, panel.y_log)) for value in up.ticks],
        left,
        top,
    )
    for number, series in enumerate(panel.series):
        color = _COLORS[number % len(_COLORS)]
        kept = [i for i, p in enumerate(series.points) if _fits(panel, p)]
        positions = [at(series.points[i]) for i in kept]
        if series.line and len(positions) > 1:
            parts.append(svg_line(positions, color))
        if series.dots:
            parts += [svg_dot(x, y, color) for x, y in positions]
        if series.labels:
            parts += [
                svg_text(x + 5, y - 5, series.labels[i], "start", f' fill="{color}"')
                for i, (x, y) in zip(kept, positions, strict=True)
            ]
        y = y0 + 14 + 15 * number
        if panel.legend_low:
            y += inner_h - 15 * len(panel.series) - 8
        parts.append(svg_dot(x0 + 10, y - 4, color))
        parts.append(svg_text(x0 + 18, y, series.name, "start"))
    return parts


def write_svg(panels: Sequence[Panel], path: Path, *, columns: int = 3) -> None:
    """Write panels side by side, in rows of ``columns``.

    Points that are not finite, or not positive on a logarithmic axis, are left out.
    """
    rows, parts = -(-len(panels) // columns), []
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        parts += _panel(panel, column * PLOT_WIDTH, row * PLOT_HEIGHT)
    width = PLOT_WIDTH * min(columns, len(panels))
    write_bytes(path, svg_document(parts, width, PLOT_HEIGHT * rows))

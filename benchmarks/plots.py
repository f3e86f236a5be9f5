# SPDX-License-Identifier: GPL-3.0-or-later
"""Plots with linear or logarithmic axes as SVG, without a plotting library."""

from __future__ import annotations

import dataclasses
import html
import math
from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.files import write_bytes

_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#8b4513")
"""Distinguishable by colour-blind readers (Okabe and Ito)."""
_WIDTH, _HEIGHT = 460, 360
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 14, 34, 46
_LINEAR_TICKS = 6
_MARGIN = 0.06
"""Margin around the points of a linear axis, as a share of their spread."""


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
    spread = max(values) - min(values) or abs(values[0]) or 1.0
    begin, end = min(values) - _MARGIN * spread, max(values) + _MARGIN * spread
    rough = (end - begin) / _LINEAR_TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * k for k in (1, 2, 5, 10) if power * k >= rough)
    first, last = math.ceil(begin / step), math.floor(end / step)
    return _Axis(begin, end, False, tuple(step * k for k in range(first, last + 1)))


def _tick(value: float, log: bool) -> str:
    if log and not 1e-3 <= value <= 1e6:
        return f"1e{round(math.log10(value))}"
    return f"{value:.6g}"


def _fits(panel: Panel, point: tuple[float, float]) -> bool:
    """Tell whether a point is within the domain of the axes."""
    finite = math.isfinite(point[0]) and math.isfinite(point[1])
    return finite and (not panel.x_log or point[0] > 0) and (not panel.y_log or point[1] > 0)


def _text(x: float, y: float, content: str, anchor: str = "middle", extra: str = "") -> str:
    attributes = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{extra}'
    return f"<text {attributes}>{html.escape(content)}</text>"


def _dot(x: float, y: float, color: str) -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.2" fill="{color}"/>'


def _panel(panel: Panel, left: int, top: int) -> list[str]:
    points = [p for series in panel.series for p in series.points if _fits(panel, p)]
    inner_w, inner_h = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    x0, y0 = left + _LEFT, top + _TOP
    middle_x, middle_y = x0 + inner_w / 2, y0 + inner_h / 2
    turned = f' transform="rotate(-90 {left + 14} {middle_y:.1f})"'
    parts = [
        f'<rect x="{x0}" y="{y0}" width="{inner_w}" height="{inner_h}" fill="none" stroke="#888"/>',
        _text(middle_x, top + 20, panel.title, extra=' font-weight="bold"'),
        _text(middle_x, top + _HEIGHT - 8, panel.x_label),
        _text(left + 14, middle_y, panel.y_label, extra=turned),
    ]
    if not points:
        return [*parts, _text(middle_x, middle_y, "no data")]
    across = _axis([p[0] for p in points], panel.x_log)
    up = _axis([p[1] for p in points], panel.y_log)

    def at(point: tuple[float, float]) -> tuple[float, float]:
        return x0 + inner_w * across.share(point[0]), y0 + inner_h * (1.0 - up.share(point[1]))

    for value in across.ticks:
        x = x0 + inner_w * across.share(value)
        parts.append(f'<path d="M{x:.1f} {y0}V{y0 + inner_h}" stroke="#ddd" stroke-width="0.7"/>')
        parts.append(_text(x, y0 + inner_h + 15, _tick(value, panel.x_log)))
    for value in up.ticks:
        y = y0 + inner_h * (1.0 - up.share(value))
        parts.append(f'<path d="M{x0} {y:.1f}h{inner_w}" stroke="#ddd" stroke-width="0.7"/>')
        parts.append(_text(x0 - 5, y + 4, _tick(value, panel.y_log), "end"))
    for number, series in enumerate(panel.series):
        color = _COLORS[number % len(_COLORS)]
        kept = [i for i, p in enumerate(series.points) if _fits(panel, p)]
        positions = [at(series.points[i]) for i in kept]
        if series.line and len(positions) > 1:
            path = " ".join(f"{x:.1f},{y:.1f}" for x, y in positions)
            parts.append(
                f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="1.5"/>'
            )
        if series.dots:
            parts += [_dot(x, y, color) for x, y in positions]
        if series.labels:
            parts += [
                _text(x + 5, y - 5, series.labels[i], "start", f' fill="{color}"')
                for i, (x, y) in zip(kept, positions, strict=True)
            ]
        y = y0 + 14 + 15 * number
        if panel.legend_low:
            y += inner_h - 15 * len(panel.series) - 8
        parts.append(_dot(x0 + 10, y - 4, color))
        parts.append(_text(x0 + 18, y, series.name, "start"))
    return parts


def write_svg(panels: Sequence[Panel], path: Path, *, columns: int = 3) -> None:
    """Write panels side by side, in rows of ``columns``.

    Points that are not finite, or not positive on a logarithmic axis, are left out.
    """
    rows = -(-len(panels) // columns)
    width, height = _WIDTH * min(columns, len(panels)), _HEIGHT * rows
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
        f'viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="11">'
    )
    lines = [head, f'<rect width="{width}" height="{height}" fill="white"/>']
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        lines += _panel(panel, column * _WIDTH, row * _HEIGHT)
    write_bytes(path, ("\n".join([*lines, "</svg>"]) + "\n").encode())

# SPDX-License-Identifier: GPL-3.0-or-later
"""The plots of the meshing study: what seconds and vertices buy, method by method."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.evaluation.report.plot import Panel, Series, write_svg

from ..speed_error.tables import AT, MIDDLE
from .carry_out import Made
from .plan import LABELS, METHODS

SHOWN = ("spot", "wheel", "room", "fence")
"""Scenes with plots, where they were measured."""

Value = Callable[[Made], float]


def write_plots(made: Sequence[Made], path: Path) -> None:
    """Write all panels into one SVG; none where no scene of :data:`SHOWN` was measured."""
    panels = []
    for scene in SHOWN:
        same = [m for m in made if m.subject.name == scene]
        off, seconds = "mean distance to isosurface, %", "seconds"
        for title, x_label, y_label, x, y, log in (
            ("time against isosurface", seconds, off, _seconds, _off, True),
            ("vertices against isosurface", "vertices", off, _vertices, _off, True),
            ("time against truth", seconds, f"F1 at {AT}", _seconds, _f1, False),
        ):
            series = _series(same, x, y)
            if series:
                panels.append(
                    Panel(f"{scene}: {title}", x_label, y_label, series, legend_low=not log,
                          y_log=log)
                )  # fmt: skip
    if panels:
        write_svg(panels, path)


def _series(made: Sequence[Made], x: Value, y: Value) -> list[Series]:
    """Return a series a method, its sizes joined from small to large."""
    found = []
    for method in METHODS:
        same = sorted((m for m in made if m.method.name == method), key=lambda m: m.method.size)
        kept = [m for m in same if math.isfinite(x(m)) and math.isfinite(y(m))]
        points = [(x(m), y(m)) for m in kept]
        if points:
            labels = tuple(str(m.method.size) for m in kept)
            found.append(Series(LABELS[method], points, labels=labels))
    return found


def _seconds(made: Made) -> float:
    return float(made.figures["wall_s"])


def _vertices(made: Made) -> float:
    return float(made.figures["vertices"])


def _off(made: Made) -> float:
    value = made.scores["distance"]["mean"]
    # A logarithmic axis has no zero.
    return 100 * value if value else math.nan


def _f1(made: Made) -> float:
    if "truth" not in made.scores:
        return math.nan
    return float(made.scores["truth"]["uniform"]["f1"][MIDDLE])

# SPDX-License-Identifier: GPL-3.0-or-later
"""The plot of the ablation: every run as a dot, processor time against F1, a panel a scene."""

from __future__ import annotations

from pathlib import Path

from gaussian_wrapping_addon.core.evaluation.report.plot import Panel, Series, write_svg

from ..speed_error.tables import AT
from ..study.figures import f1_middle
from .plan import CELLS, ON, SCENES
from .tables import Records, of_cell


def write_plot(records: Records, path: Path) -> None:
    """Write one panel for each scene that has runs."""
    panels = []
    for scene in SCENES:
        series = []
        for cell in CELLS:
            same = of_cell(records, cell, scene)
            name = f"{'with' if cell.multi_view == ON else 'without'} multi-view, {cell.label}"
            points = [(r.processor("train"), f1_middle(r)) for r in same]
            if points:
                series.append(Series(name, points, line=False))
        if series:
            panels.append(
                Panel(scene, "training, processor s", f"F1 at {AT}", series, x_log=False,
                      y_log=False)
            )  # fmt: skip
    write_svg(panels, path)

# SPDX-License-Identifier: GPL-3.0-or-later
"""The plot of the ablation: processor time of training against F1, a panel a scene."""

from __future__ import annotations

import statistics
from pathlib import Path

from gaussian_wrapping_addon.core.evaluation.report.plot import Panel, Series, write_svg

from ..speed_error.tables import AT
from ..study.figures import f1_middle
from .plan import CELLS, CLONES, OFF, ON, ORIENTED, PLAIN, SCENES
from .tables import Records, of_cell

NAMES = {OFF: "without multi-view terms", ON: "with multi-view terms"}
SHORT = {PLAIN: "colour, depth-normal", ORIENTED: "+ orientation", CLONES: "+ clones"}
RUNS = "single runs"


def write_plot(records: Records, path: Path) -> None:
    """Write one panel for each scene that has runs: means joined, and every run as a dot."""
    panels = []
    for scene in SCENES:
        runs: list[tuple[float, float]] = []
        means = []
        for views, name in NAMES.items():
            points, labels = [], []
            for cell in CELLS:
                if cell.multi_view != views:
                    continue
                same = [(r.processor("train"), f1_middle(r)) for r in of_cell(records, cell, scene)]
                if same:
                    points.append((statistics.fmean(x for x, _ in same),
                                   statistics.fmean(y for _, y in same)))  # fmt: skip
                    labels.append(SHORT[cell.wrapping])
                    runs += same
            if points:
                means.append(Series(name, points, labels=labels))
        if means:
            several = len(runs) > sum(len(series.points) for series in means)
            single = [Series(RUNS, runs, line=False)] if several else []
            panels.append(
                Panel(scene, "training, processor s", f"F1 at {AT}", [*means, *single],
                      x_log=False, y_log=False)
            )  # fmt: skip
    write_svg(panels, path)

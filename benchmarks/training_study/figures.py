# SPDX-License-Identifier: GPL-3.0-or-later
"""The plots of the training study: what each row of the ablation costs and gains."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.evaluation.report.plot import Panel, Series, write_svg

from ..speed_error.results import Result
from ..speed_error.tables import AT, MIDDLE, thin_recall
from .carry_out import Measured
from .plan import ABLATION, AUTO, ON, PRESET, REAL, ROWS

_SHORT = dict(zip(ROWS, ("base", "+ views", "+ L_N", "+ wrapping"), strict=True))


def write_plots(runs: Sequence[Measured], path: Path) -> None:
    """Write all panels into one SVG."""
    rendered = [m for m in runs if m.case.photos is not None]
    panels = [
        _ablation("Ablation: surface", f"F1 at {AT}", rendered, ABLATION,
                  lambda r: r.f1("uniform", MIDDLE)),
        _ablation("Ablation: thin parts", f"thin recall at {AT}", rendered, ABLATION, _thin),
        _ablation("Ablation: images", "test views, PSNR dB", rendered, ABLATION, _psnr),
        _ablation("Ablation: real photos", "held-out photos, PSNR dB", runs, REAL, _psnr),
        _presets(rendered),
    ]  # fmt: skip
    write_svg(panels, path)


def _ablation(
    title: str, axis: str, runs: Sequence[Measured], part: str, value: Callable[[Result], float]
) -> Panel:
    """Return time against a figure, the rows of each scene joined in their order."""
    series = []
    for scene in dict.fromkeys(m.case.run.scene for m in runs if part in m.case.parts):
        rows = {m.case.run.name: m.result for m in runs
                if part in m.case.parts and m.case.run.scene == scene}  # fmt: skip
        names = [n for n in ROWS if n in rows and math.isfinite(value(rows[n]))]
        points = [(rows[n].wall_s, value(rows[n])) for n in names]
        if points:
            series.append(Series(scene, points, labels=tuple(_SHORT[n] for n in names)))
    return Panel(title, "whole command, s", axis, series, x_log=False, y_log=False)


def _presets(runs: Sequence[Measured]) -> Panel:
    """Return time against F1 of the presets, decided and with everything on."""
    series = []
    for name, words in ((AUTO, "decided"), (ON, "everything on")):
        for scene in dict.fromkeys(m.case.run.scene for m in runs):
            same = [m for m in runs if (m.case.run.scene, m.case.run.name) == (scene, name)]
            points = [(m.result.wall_s, m.result.f1("uniform", MIDDLE)) for m in same]
            if points:
                presets = tuple(m.case.run.preset for m in same)
                series.append(Series(f"{scene}, {words}", points, labels=presets))
    title = "Presets" if any(PRESET in m.case.parts for m in runs) else "Decided and everything on"
    return Panel(title, "whole command, s", f"F1 at {AT}", series, x_log=False, y_log=False)


def _thin(result: Result) -> float:
    found = thin_recall(result.scores["surface"]["uniform"])
    return math.nan if found is None else found


def _psnr(result: Result) -> float:
    value = result.scores["gaussians"]["psnr"]
    return math.nan if value is None else float(value)

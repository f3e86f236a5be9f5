# SPDX-License-Identifier: GPL-3.0-or-later
"""The plot of the report: processor seconds against error, a panel a scene."""

from __future__ import annotations

from pathlib import Path

from gaussian_wrapping_addon.core.evaluation.report.plot import Panel, Series, write_svg

from ..study.figures import f1_middle
from .cases import (
    ADAPTIVE,
    ALPHA,
    LABELS,
    MESHED_PRESETS,
    MESHERS,
    SCENES,
    alpha_case,
    mesher_case,
    preset_case,
)
from .plan import PRESETS
from .preset_tables import Records, spent_s
from .tables import AT


def write_plot(records: Records, path: Path) -> None:
    """Write one panel for each scene that has runs; error is one less F1."""
    panels = []
    for scene in SCENES:
        rows = {
            LABELS[ADAPTIVE]: [(p, preset_case(scene, p)) for p in PRESETS],
            **{LABELS[m]: [(p, mesher_case(scene, p, m)) for p in MESHED_PRESETS] for m in MESHERS},
            LABELS[ALPHA]: [("", alpha_case(scene))],
        }
        series = []
        for name, cases in rows.items():
            found = [(label, records[c.identity]) for label, c in cases if c.identity in records]
            if found:
                points = [(spent_s(r, records), 1.0 - f1_middle(r)) for _, r in found]
                labels = tuple(label for label, _ in found) if name == LABELS[ADAPTIVE] else ()
                series.append(Series(name, points, labels=labels))
        if series:
            panels.append(
                Panel(scene, "cameras, training and mesh, processor s", f"1 - F1 at {AT}", series)
            )
    write_svg(panels, path)

# SPDX-License-Identifier: GPL-3.0-or-later
"""The ablation as Markdown, written from records alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.files import write_bytes

from ..study.case import PHOTOS, Case
from ..study.origin import made_by, photos_said, reading
from .plan import PRESET
from .plots import write_plot
from .tables import Records, cell_table, fixed_options, part_table, settings_table

PAGE, PLOT, READING = "ablation.md", "ablation.svg", "ablation-reading.md"
COMMAND = "python -m benchmarks.ablation"

_GROWTH = {"on": ("With `--growth on` only the cap ends growth, and nothing is pruned.",)}


def write_document(out: Path, records: Records, cases: Sequence[Case]) -> Path:
    """Write page and plot into a folder; the reading lies beside them."""
    write_plot(records, out / PLOT)
    fixed = fixed_options(cases)
    given = ", ".join(f"`{name} {value}`" for name, value in fixed.items())
    tables = (settings_table(cases), part_table(records), cell_table(records))
    lines = [
        "# Ablation: multi-view terms, orientation, clones",
        "",
        *made_by(COMMAND, list(records.values()), cases),
        "",
        photos_said(PHOTOS),
        f"Preset {PRESET}, in every run with {given}.",
        "Nothing is decided from the photos: every part is given.",
        *_GROWTH.get(fixed.get("--growth", ""), ()),
        "Clones turn around what orientation has found. Without orientation there are none: six",
        "cells, not eight.",
        "",
        *reading(out / READING),
        f"![F1 against processor time, every run a dot]({PLOT})",
        "",
        "## Tables",
        "",
        *(table.markdown() for table in tables if table.rows),
    ]
    path = out / PAGE
    write_bytes(path, ("\n".join(lines).rstrip() + "\n").encode())
    return path

# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the figures of a document come from, said from the records; and the reading beside them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from ..speed_error.plan import Photos
from .case import Case
from .record import Record, said_versions


def made_by(command: str, records: Sequence[Record], planned: Sequence[Case]) -> list[str]:
    """Return command, dates, machine, versions, code and completeness, as lines.

    Parameters
    ----------
    command : str
        What makes the missing runs and the document.
    records : sequence of Record
        At least one.
    planned : sequence of Case
        All of the plan: what has no record is counted as missing.
    """
    days = sorted({r.date[:10] for r in records})
    dates = days[0] if len(days) == 1 else f"{days[0]} to {days[-1]}"
    machines = "; ".join(dict.fromkeys(f"{r.machine}, {_threads(r)}" for r in records))
    versions = "; ".join(dict.fromkeys(r.versions for r in records))
    used_s = math.fsum(r.spent_s for r in records)
    loads = [r.load_before for r in records if r.load_before is not None]
    load = f" Load average before a run: {min(loads):.1f} to {max(loads):.1f}." if loads else ""
    done = {r.case.identity for r in records}
    missing = [case for case in planned if case.identity not in done]
    left = (
        "All planned runs are there."
        if not missing
        else f"**{len(missing)} of {len(planned)} planned runs are not made yet.**"
    )
    return [
        f"`{command}`, runs of {dates}. {machines}; {versions}.",
        f"{len(records)} runs of {used_s / 3600:.1f} processor hours together. {left}",
        f"{said_versions(records)}{load}",
    ]


def photos_said(photos: Photos) -> str:
    """Return one sentence about the photos of rendered scenes."""
    return (
        f"Rendered scenes (`benchmarks/scenes`): {photos.count} photos of {photos.width} x "
        f"{photos.height} pixels, exact cameras, 8 test views apart."
    )


def reading(path: Path) -> list[str]:
    """Return the hand-written reading, if there is one."""
    return [path.read_text(encoding="utf-8").strip(), ""] if path.is_file() else []


def _threads(record: Record) -> str:
    return f"{record.threads} thread{'' if record.threads == 1 else 's'} a run"

# SPDX-License-Identifier: GPL-3.0-or-later
"""The page of the trials, written from the outcomes alone."""

from __future__ import annotations

from pathlib import Path

from gaussian_wrapping_addon.core.files import write_bytes
from gaussian_wrapping_addon.core.machine import processor_name

from ..tables import Table, versions
from .outcomes import CODES, LONGEST_END_S, Outcome
from .small_job import HEIGHT_PX, PHOTOS, WIDTH_PX
from .trials import CALLER, DISK, MEMORY, STAGES, WAYS

PAGE = "kills.md"
COMMAND = "python -m benchmarks.kills"


_NOTE = (
    "Ended before: the job was done at the moment drawn, or fitted the limit drawn. Longest end: "
    "from the interruption until no process of the job was left; at most "
    f"{LONGEST_END_S:.0f} s are right. Disks have 2 to 100 % of the room that the job takes; the "
    "address space is limited to a part between half of what the worker takes before its first "
    "stage and all that the job takes."
)


def write_document(out: Path, outcomes: dict[str, Outcome], count: int) -> Path:
    """Write the page into a folder and return its path."""
    path = out / PAGE
    write_bytes(path, (page(list(outcomes.values()), count).rstrip() + "\n").encode())
    return path


def page(outcomes: list[Outcome], count: int) -> str:
    """Return the page."""
    dates = sorted({o.date for o in outcomes})
    codes = sorted({o.code_name for o in outcomes})
    machine = f"{processor_name()}; {versions()}"
    items = max((o.compared for o in outcomes), default=0)
    faults = [
        f"- {o.trial.identity} (at {o.hit or 'the end'}): {fault}"
        for o in outcomes
        for fault in o.faults
    ]
    lines = [
        "# Interrupted jobs",
        "",
        f"`{COMMAND} --n {count}`, {' and '.join(dates)}. {machine}. Code: {', '.join(codes)}.",
        "",
        f"A small job ({PHOTOS} photos of {WIDTH_PX} x {HEIGHT_PX} pixels with cameras, 1 thread)",
        "goes through all stages by the command line. It is interrupted at a moment drawn from a",
        "seed and resumed, and its result is compared with that of the job without interruption:",
        f"{items} arrays, images, textures, files and entries of reports, bit for bit; times,",
        "dates and wording are left out.",
        "",
        _table(outcomes).markdown(),
        "### What was not as it should be",
        "",
        *(faults or ["Nothing."]),
    ]
    return "\n".join(lines)


def _table(outcomes: list[Outcome]) -> Table:
    rows = []
    for way, words in WAYS.items():
        those = [o for o in outcomes if o.trial.way == way]
        if not those:
            continue
        struck = [o for o in those if o.hit]
        stages = ", ".join(
            f"{stage} {n}" for stage in STAGES if (n := sum(o.hit == stage for o in struck))
        )
        timed = way not in (DISK, MEMORY)
        wanted = ", ".join("none" if c is None else str(c) for c in CODES[way] if c != 0)
        rows.append(
            (
                words,
                len(those),
                len(those) - len(struck),
                stages,
                f"{sum(o.code in CODES[way] for o in those)} ({wanted})" if way != CALLER else None,
                sum(not o.traceback for o in those),
                sum(not o.left for o in those),
                f"{max(o.end_s for o in those):.1f}" if timed else None,
                sum(not o.resumed for o in those),
                sum(not o.differences for o in those),
            )
        )
    header = (
        "interruption", "trials", "ended before", "struck at", "right exit code (which)",
        "no traceback", "no process left", "longest end, s", "resumed", "same result",
    )  # fmt: skip
    return Table("Trials", header, rows, (_NOTE,))

# SPDX-License-Identifier: GPL-3.0-or-later
"""The page of the queue, written from its outcome alone."""

from __future__ import annotations

from pathlib import Path

from gaussian_wrapping_addon.core.files import write_bytes

from ..tables import Table
from .outcome import Outcome
from .photo_sets import HEIGHT_PX, PHOTOS, WIDTH_PX
from .strikes import PROCESSES

PAGE = "queue.md"
COMMAND = "python -m benchmarks.farm_queue"


def write_document(out: Path, outcome: Outcome) -> Path:
    """Write the page into a folder and return its path."""
    path = out / PAGE
    write_bytes(path, (page(outcome).rstrip() + "\n").encode())
    return path


def page(outcome: Outcome) -> str:
    """Return the page."""
    faults = [f"- {fault}" for fault in outcome.faults]
    count = len(outcome.rows)
    head = f"`{COMMAND} --n {count} --seed {outcome.seed}`, {outcome.date}. {outcome.machine}."
    lines = [
        "# A queue that is killed twice",
        "",
        f"{head} Code: {outcome.code_name}.",
        "",
        f"{count} sets of {PHOTOS} photos of {WIDTH_PX} x {HEIGHT_PX} pixels with cameras, boxes",
        "drawn from a seed, are wrapped by `queue FOLDER --computers local`, 1 thread a job and",
        f"{PROCESSES} jobs at a time.",
        "At moments drawn from the seed SIGKILL ends first a Dask worker with its job, then the",
        "process of the queue, which is scheduler and client, with all jobs that run. The same",
        "command is given again.",
        "",
        _course(outcome).markdown(),
        "### What was not as it should be",
        "",
        *(faults or ["Nothing."]),
        "",
        _results(outcome).markdown(),
    ]
    return "\n".join(lines)


def _course(outcome: Outcome) -> Table:
    done = sum(row["state"] == "done" for row in outcome.rows)
    rows: list[tuple[str, str]] = []
    for number, strike in enumerate(outcome.strikes, 1):
        jobs = " and ".join(f"{name} ({stage or 'start'})" for name, stage in strike.stages.items())
        met = f"{strike.what}, with {jobs}, after {strike.jobs_done} jobs"
        rows.append((f"strike {number} ended", met))
    rows += [
        ("first command", f"exit code {outcome.first_code} after {outcome.first_s:.0f} s"),
        ("no process left", f"{outcome.end_s:.1f} s after strike {len(outcome.strikes)}"),
        ("second command", f"exit code {outcome.second_code} after {outcome.second_s:.0f} s"),
        ("jobs done", f"{done} of {len(outcome.rows)}"),
        ("processes left running", str(len(outcome.processes_left))),
        ("locks, part files, temporary files left", str(len(outcome.left_behind))),
        ("results that lack a file", str(len(outcome.incomplete))),
    ]
    compared = f"{outcome.items} arrays, images, files and entries each"
    apart = f"{', '.join(outcome.compared)}: {len(outcome.differences)} differences in {compared}"
    rows.append(("made alone as well, and compared", apart))
    return Table("What happened", ("what", "how"), list(rows))


def _results(outcome: Outcome) -> Table:
    rows = [
        (row["name"], row["state"], row["seconds"], row["psnr"], row["faces"])
        for row in outcome.rows
    ]
    note = (
        "The queue's own table. Seconds are of the clock, beside whatever else the machine did, "
        "and of the process that finished the job: less where stages were done before."
    )
    return Table("Results", ("job", "state", "s", "held out dB", "faces"), rows, (note,))

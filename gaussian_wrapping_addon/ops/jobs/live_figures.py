# SPDX-License-Identifier: GPL-3.0-or-later
"""The figures of a running training as label and text, from the job's status."""

from __future__ import annotations

from typing import Any

from ...core.evaluation.report.text import duration, measured, number, part
from ...core.jobs.store.job_folder import JobStatus
from ..common.translate import tr

RATE = "iterations_per_s"

Row = tuple[str, str]


def live_rows(status: JobStatus) -> tuple[Row, ...]:
    """Return the rows that the panel shows of a running training; none in other stages.

    Parameters
    ----------
    status : JobStatus
        With ``figures``: ``iteration``, ``iterations`` (of the whole plan), ``gaussians``,
        ``held_out_psnr`` (dB), ``psnr`` (dB, of the photos being trained),
        ``iterations_per_s``. What is missing has no row.
    """
    figures = part({"live": status.figures}, "live")
    if not status.active or measured(figures.get("iteration")) is None:
        return ()
    rows = [("Iteration", _of(figures.get("iteration"), figures.get("iterations")))]
    _add(rows, "Gaussians", figures.get("gaussians"), digits=0)
    if measured(figures.get("held_out_psnr")) is not None:
        _add(rows, "PSNR, Held Out", figures.get("held_out_psnr"), "dB", digits=1)
    else:
        _add(rows, "PSNR, Trained", figures.get("psnr"), "dB", digits=1)
    _add(rows, "Iterations per Second", figures.get(RATE), digits=1)
    done, total, rate = map(measured, map(figures.get, ("iteration", "iterations", RATE)))
    if done is not None and total is not None and rate:
        rows.append(("Training Left", duration((total - done) / rate)))
    return tuple(rows)


def _add(rows: list[Row], name: str, value: Any, unit: str = "", *, digits: int) -> None:
    if measured(value) is not None:
        rows.append((name, number(value, unit, digits=digits)))


def _of(done: Any, total: Any) -> str:
    text = number(done, digits=0)
    if not measured(total):
        return text
    return tr("{done} of {total}", done=text, total=number(total, digits=0))

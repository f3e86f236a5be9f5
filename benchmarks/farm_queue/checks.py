# SPDX-License-Identifier: GPL-3.0-or-later
"""What is looked at after a queue: its table, each result, what it left, and some bit for bit."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import WorkerError
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.jobs.queue_process import TABLE_NAME
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from tools.version_comparison.contents import differences

from ..kills.small_job import LONGEST_S, result_contents
from ..speed_error.runs import BATCH, ROOT
from .strikes import OPTIONS

SHOWN_DIFFERENCES = 5
LEFT_BEHIND = ("lock*.json", "lock.*", "cancel", "*.writing.*", "*.making*", "*.stale")
"""Patterns of what only exists while something runs."""
KEPT_BY_DASK = ("dask-scratch-space", "global.lock", "purge.lock")
"""What Dask keeps beside temporary files for good: an empty folder and two empty files."""


def table_of(out: Path) -> list[dict[str, Any]]:
    """Return the rows of the queue's table of results."""
    rows: list[dict[str, Any]] = read_json(out / TABLE_NAME)["jobs"]
    return rows


def left_behind(out: Path, temporary: Path) -> list[str]:
    """Return what a queue has left that it should not, as paths within its folders."""
    found = {path for pattern in LEFT_BEHIND for path in out.rglob(pattern)}
    found |= {p for p in temporary.rglob("*") if p.name not in KEPT_BY_DASK}
    return [path.relative_to(out.parent).as_posix() for path in sorted(found)]


def files_of(job: Path) -> set[str]:
    """Return the files of a result that have content."""
    result = JobFolder(job).result
    found = (path for path in result.rglob("*") if path.is_file() and path.stat().st_size)
    return {path.relative_to(result).as_posix() for path in found}


def wrap_alone(photos: Path, out: Path, region: Path) -> None:
    """Make one job by ``wrap`` in one process.

    Raises
    ------
    WorkerError
        It failed.
    """
    words = ["wrap", str(photos), "--out", str(out), "--region", str(region), *OPTIONS]
    done = subprocess.run(
        [sys.executable, str(BATCH), *words, "--no-blend"],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=LONGEST_S,
    )  # fmt: skip
    if done.returncode:
        raise WorkerError(f"The wrap alone failed: {done.stdout}{done.stderr}")


def apart(job: Path, alone: Path) -> tuple[int, list[str]]:
    """Return how many items of two results were compared, and how they differ."""
    one, two = result_contents(alone), result_contents(job)
    found = [f"{name}: {how}" for name, how in differences(one, two)[:SHOWN_DIFFERENCES]]
    return len(one.items), found

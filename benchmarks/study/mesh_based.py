# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh-based rendering of meshes that this machine has kept, filled into their records."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.errors import WorkerError

from ..scenes import ensure_scene
from ..speed_error.runs import Settings, judged_by
from .case import Case
from .making import KEPT_RUNS, rounded, run_folder
from .record import RECORDS, Record, code_of_tree, read_records, write_record

_logger = logging.getLogger("benchmarks")

MODULE = "mesh_based"
"""Of :mod:`benchmarks.speed_error`."""
KEPT = ("psnr", "ssim", "covered_psnr", "inside_psnr", "uncovered", "beyond")
"""Means over the test views that a record keeps."""


def fill_in(
    cases: Sequence[Case],
    *,
    threads: int,
    runs: int = 0,
    again: bool = False,
    kept: Path = KEPT_RUNS,
    root: Path = RECORDS,
) -> int:
    """Judge meshes whose record lacks mesh-based rendering; return how many failed.

    A mesh that this machine has not kept is left as it is.

    Parameters
    ----------
    runs : int
        Judge no more meshes than this; 0: there is no limit.
    again : bool
        Judge meshes again that were judged before.
    """
    failed = judged = 0
    for record in read_records(cases, root).values():
        folder = run_folder(record.case, kept)
        if (record.mbr is not None and not again) or not (folder / "mesh").is_dir():
            continue
        if runs and judged == runs:
            break
        judged += 1
        try:
            found = _judged(record, folder, threads)
        except WorkerError as error:
            failed += 1
            _logger.error("%s: %s", record.case.identity, error)
            continue
        write_record(dataclasses.replace(record, mbr=kept_figures(found)), root)
        _logger.info("%s: mesh-based rendering %.2f dB", record.case.identity, found["psnr"])
    return failed


def kept_figures(found: dict[str, Any]) -> dict[str, Any]:
    """Return what a record keeps, with the code that measured it."""
    figures = {name: found.get(name) for name in KEPT}
    return {**dict(rounded(figures)), "code": code_of_tree().name}


def _judged(record: Record, folder: Path, threads: int) -> dict[str, Any]:
    photos = record.case.photos
    scene = ensure_scene(
        record.case.scene, photos=photos.count, width=photos.width, height=photos.height
    )
    path = folder / "mesh-based.json"
    arguments = [str(scene), str(path), "--mesh", str(folder / "mesh")]
    arguments += ["--job", str(folder / "out")]
    return judged_by(MODULE, arguments, path, Settings(folder, threads, False))

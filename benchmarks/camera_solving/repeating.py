# SPDX-License-Identifier: GPL-3.0-or-later
"""Is a hall whose walls repeat solved, or warned of? By its matches alone, for several seeds."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.dataset.poses.mapping import joined, place_one_by_one
from gaussian_wrapping_addon.core.dataset.poses.mending import mended
from gaussian_wrapping_addon.core.dataset.poses.solution_check import check_solution
from gaussian_wrapping_addon.core.evaluation.alignment.pose_error import pose_errors

from .tracks import hall_tracks, write_database

PHOTOS, FLOOR_POINTS = 32, 150
KINDS = ((1, 1.0), (2, 1.0), (3, 1.0), (4, 1.0), (2, 0.7), (4, 0.5))
"""Walls that look the same, and the share of their points that do."""
SEEDS = (0, 1)


def repeating_record(tell: Callable[[str], None]) -> dict[str, Any]:
    """Return rows of all kinds and seeds."""
    rows = []
    for repeats, alike in KINDS:
        for seed in SEEDS:
            with tempfile.TemporaryDirectory() as folder:
                rows.append(solve_hall(Path(folder), repeats, alike, seed))
            tell(f"{rows[-1]}")
    return {"photos": PHOTOS, "rows": rows}


def solve_hall(folder: Path, repeats: int, alike: float, seed: int) -> dict[str, Any]:
    """Solve the hall from its matches; return errors and what the check says."""
    tracks = hall_tracks(PHOTOS, FLOOR_POINTS, repeats=repeats, seed=seed, alike=alike)
    database = folder / "database.db"
    write_database(database, tracks, seed=seed)
    (folder / "images").mkdir()

    def solve(database: Path) -> Any:
        models = place_one_by_one(database, folder, seed, PHOTOS)
        return joined(database, folder, seed, models)[0] if models else None

    model = solve(database)
    verdict = check_solution(database, model)
    first = _degrees(model, tracks.cameras)
    is_suspected, is_mended = verdict.is_doubtful, False
    if is_suspected:
        model, verdict, is_mended = mended(database, folder, solve, model, verdict)
    return {
        "repeats": repeats, "alike": alike, "seed": seed, "placed": model.num_reg_images(),
        "degrees_first": first, "degrees": _degrees(model, tracks.cameras),
        "is_suspected": is_suspected, "is_doubtful": verdict.is_doubtful, "is_mended": is_mended,
        "contradicting_pairs": len(verdict.contradicting), "strong_pairs": len(verdict.strong),
        "contradicting_share": verdict.contradicting_share,
    }  # fmt: skip


def _degrees(model: Any, exact: tuple[Camera, ...]) -> float:
    """Return the median rotation error."""
    cameras = [
        Camera(
            model.image(number).name, 2, 2, 1.0, 1.0, 1.0, 1.0,
            np.asarray(model.image(number).cam_from_world().matrix()),
        )
        for number in sorted(model.reg_image_ids())
    ]  # fmt: skip
    return float(np.median(pose_errors(cameras, exact).rotation_degrees))

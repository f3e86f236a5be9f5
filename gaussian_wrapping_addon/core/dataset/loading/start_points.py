# SPDX-License-Identifier: GPL-3.0-or-later
"""Make start points for inputs without any: triangulated from the photos, else random."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...errors import MemoryShortageError, ResourceError, WorkerError
from ...progress import Progress
from ...report_warning import ReportWarning
from ...tolerances import NEAR_Z, SCENE_RADIUS
from ..camera import Camera
from ..poses.pose_solver import triangulate_points
from .sparse_points import MIN_POINTS

_logger = logging.getLogger(__name__)

RANDOM_POINTS = 20_000
_ROUNDS = 40
_MIN_SEEN = 2

_HINT = "Photos with more texture help, or a COLMAP model with its points."


def make_start_points(
    cameras: Sequence[Camera],
    photos: Sequence[Path],
    masks: Sequence[Path | None],
    work_folder: Path,
    progress: Progress,
    warnings: list[ReportWarning],
    *,
    seed: int,
    threads: int,
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return points (n, 3) float64 and colours (n, 3) uint8 in the scene frame, and their origin.

    Triangulation keeps the poses of the input. If it finds too few points (no texture, inaccurate
    poses), points are drawn at random in view of the cameras, and a warning is added.

    Raises
    ------
    MemoryShortageError
        The system gave the triangulation too little memory.
    """
    try:
        points, colors = triangulate_points(
            cameras, photos, masks, work_folder, progress, seed=seed, threads=threads
        )
    except MemoryShortageError:
        raise  # with enough memory the same photos would give points
    except (WorkerError, ResourceError) as error:
        _logger.warning("triangulation failed: %s", error)
        text = f"Start points could not be triangulated: {error.message}"
        warnings.append(ReportWarning("points-not-triangulated", text, _HINT))
        points, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if len(points) >= MIN_POINTS:
        return points, colors, "triangulated from the photos"
    text = (
        f"The photos gave only {len(points)} start points; random ones are used, which makes "
        "training slower and less exact."
    )
    warnings.append(ReportWarning("random-start-points", text, _HINT))
    points = random_points(cameras, seed=seed)
    return points, np.full(points.shape, 128, np.uint8), "random"


def focus_point(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the (3,) point nearest to the rays of all images' middles (regularised towards 0)."""
    total, right = 1e-3 * np.eye(3), np.zeros(3)
    for camera in cameras:
        gaze = camera.gaze / np.linalg.norm(camera.gaze)
        across = np.eye(3) - np.outer(gaze, gaze)
        total += across
        right += across @ camera.center
    return np.linalg.solve(total, right)


def random_points(
    cameras: Sequence[Camera], *, seed: int, count: int = RANDOM_POINTS
) -> np.ndarray:
    """Draw (count, 3) points around the point that the cameras look at.

    Points are uniform in a ball whose radius follows the cameras' median distance; those seen by
    at least two cameras are kept.
    """
    rng = np.random.default_rng(seed)
    focus = focus_point(cameras)
    distances = np.array([np.linalg.norm(c.center - focus) for c in cameras])
    radius = min(max(0.75 * float(np.median(distances)), 0.1 * SCENE_RADIUS), 2.0 * SCENE_RADIUS)
    kept: list[np.ndarray] = []
    found = 0
    for _ in range(_ROUNDS):
        directions = rng.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points = focus + directions * radius * rng.uniform(size=(count, 1)) ** (1 / 3)
        good = points[count_observing_views(cameras, points) >= _MIN_SEEN]
        kept.append(good)
        found += len(good)
        if found >= count:
            break
    return np.concatenate(kept)[:count]


def count_observing_views(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """Count the cameras whose image contains each of (n, 3) points, (n,) int."""
    seen = np.zeros(len(points), np.int64)
    for camera in cameras:
        pixels, depth = camera.project(points)
        inside = (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
        seen += inside & (depth > NEAR_Z)
    return seen

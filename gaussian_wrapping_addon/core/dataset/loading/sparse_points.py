# SPDX-License-Identifier: GPL-3.0-or-later
"""Take over the sparse points of an input."""

from __future__ import annotations

import numpy as np

from ...errors import DatasetError
from ...report_warning import LEFT_OUT_HINT, ReportWarning
from ...tolerances import POINT_REACH, SCENE_RADIUS
from ..frames.scene_grid import POINT_STEP, snapped
from ..readers.source_model import PosedPhoto, SourceModel
from ..scene import usable_points
from ..similarity import Similarity

MIN_POINTS = 100
"""Smallest number of points to start from."""
_ONE_PLACE_REACH = 100.0 * SCENE_RADIUS
"""Points farther than this are far away for the distances between the cameras."""
_MIN_NEAR_SHARE = 0.1
"""Where fewer of the sparse points are nearer, it is not the points that are far: the cameras
hardly moved."""

_COMMON_SAMPLE = 2000
"""Points that are looked for in the photos, evenly chosen."""
_FIELD_MARGIN = 1.5
"""Width of a camera's field over that of its photo without distortion."""


def nothing_in_common(model: SourceModel) -> ReportWarning | None:
    """Return a warning if no sparse point lies in the photos of two cameras.

    ``None`` as well where the input has too few points to tell.
    """
    if len(model.points) < MIN_POINTS:
        return None
    step = max(1, len(model.points) // _COMMON_SAMPLE)
    points = model.points[::step].astype(np.float64)
    seen = np.zeros(len(points), np.int64)
    with np.errstate(over="ignore", invalid="ignore"):
        for photo in model.photos:
            local = points @ photo.cam_from_world[:, :3].T + photo.cam_from_world[:, 3]  # (n, 3)
            seen += in_field(local, photo)
    if (seen >= 2).any():
        return None
    return ReportWarning(
        "nothing-in-common",
        "No sparse point lies in the photos of two cameras: they show nothing in common.",
        "Check the poses, or take photos of the same thing from several places.",
    )


def in_field(local: np.ndarray, photo: PosedPhoto) -> np.ndarray:
    """Tell which (n, 3) points in camera coordinates lie in the photo, with a margin."""
    ahead = local[:, 2] > 0.0
    if photo.lens is None:
        return ahead
    lens = photo.lens
    (fx, fy), (cx, cy) = lens.focal, lens.principal_point
    x = fx * local[:, 0] + (cx - 0.5 * lens.width) * local[:, 2]
    y = fy * local[:, 1] + (cy - 0.5 * lens.height) * local[:, 2]
    reach = 0.5 * _FIELD_MARGIN * local[:, 2]
    inside: np.ndarray = (
        ahead & (np.abs(x) <= lens.width * reach) & (np.abs(y) <= lens.height * reach)
    )
    return inside


def points_in_scene(
    points: np.ndarray,
    colors: np.ndarray,
    scene_from_world: Similarity,
    warnings: list[ReportWarning],
) -> tuple[np.ndarray, np.ndarray]:
    """Transform sparse points of an input to the scene frame's grid; leave out unusable ones.

    Parameters
    ----------
    points, colors : (n, 3) ndarrays
        World frame; colours go along.

    Raises
    ------
    DatasetError
        The cameras hardly moved, for the distances of the points.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        points = snapped(scene_from_world.points(points.reshape(-1, 3)), POINT_STEP)
        beyond = ~(np.linalg.norm(points, axis=1) <= _ONE_PLACE_REACH)
    if len(points) >= MIN_POINTS and beyond.mean() > 1.0 - _MIN_NEAR_SHARE:
        raise DatasetError(
            f"{int(beyond.sum())} of {len(points)} sparse points are more than "
            f"{_ONE_PLACE_REACH / SCENE_RADIUS:.0f} times as far away as the cameras are from each "
            "other: all photos were taken from nearly one place, so that no depth can be measured.",
            "Walk around the object while taking photos.",
        )
    near = usable_points(points)
    if not near.all():
        text = (
            f"{int((~near).sum())} of {len(near)} sparse points were left out: they are not finite "
            f"or farther away than {POINT_REACH / SCENE_RADIUS:.0f} scene radii."
        )
        warnings.append(ReportWarning("points-far-away", text, LEFT_OUT_HINT))
    return points[near], colors[near]

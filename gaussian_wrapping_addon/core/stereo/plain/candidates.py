# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes that the known depths of one plain segment propose."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...dataset.camera import Camera
from .planes import Plane, fit_plane, lifted_pixels, with_ones
from .segments import Segment

PLANE_SHARE = 0.01
"""Largest relative difference in inverse depth of an inlier of a proposal; known depths speak for
a plane in question up to :data:`SPEAKING_SHARE`."""
SPEAKING_SHARE = 0.015

TRIALS = 600
LEAST_TRIANGLE = 50.0
"""Twice the least area of the triangle of three pixels that propose a plane."""

MOST_PLANES = 4
LEAST_WEIGHT, LEAST_SUPPORT = 25.0, 0.12
"""Weight of the inliers of a proposal, and its share of the segment's."""

FULL_SPREAD, LEAST_SPREAD = 0.5, 0.25
"""Standard deviation of the inliers across their line over that of the segment's pixels, from which
a proposal counts fully, and which it needs: depths along a single edge, as where a wall meets the
floor, fit every plane through that edge."""

SAME_INLIERS = 0.7
"""Share of inliers in common with a better proposal from which one is left out."""


def proposed_planes(
    segment: Segment, camera: Camera, random: np.random.Generator
) -> Iterator[Plane]:
    """Yield up to :data:`MOST_PLANES` planes found by random consensus in inverse depth."""
    inverse, weights = segment.inverse_depths, segment.weights
    if weights.sum() < LEAST_WEIGHT or len(inverse) < 3:
        return
    at = with_ones(segment.places)
    picked = random.choice(len(at), (TRIALS, 3), p=weights / weights.sum())
    picked = picked[np.abs(np.linalg.det(at[picked])) > LEAST_TRIANGLE]
    if len(picked) == 0:
        return
    q = np.linalg.solve(at[picked], inverse[picked][..., None])[..., 0]  # (t, 3)
    inliers = (np.abs(q @ at.T / inverse - 1.0) < PLANE_SHARE).astype(np.float32)  # (t, b)
    total = inliers @ weights
    score = total * np.minimum(spreads(inliers, segment) / FULL_SPREAD, 1.0)
    for _ in range(MOST_PLANES):
        best = int(np.argmax(score))
        if score[best] < max(LEAST_WEIGHT, LEAST_SUPPORT * weights.sum()):
            return
        common = inliers @ (weights * inliers[best]) / np.maximum(total, 1e-9)
        score = np.where(common > SAME_INLIERS, 0.0, score)
        score[best] = 0.0
        chosen = _settled(inliers[best] > 0, at, segment)
        if chosen.sum() < 8 or spreads(chosen[None], segment)[0] < LEAST_SPREAD:
            continue
        points = lifted_pixels(camera, segment.places[chosen], inverse[chosen])
        relative = weights[chosen] * inverse[chosen] ** 2
        normal, offset, center = fit_plane(points, relative)
        distance = float(np.linalg.norm(center - camera.center))
        yield Plane(
            normal, offset, center, points, relative, float(weights[chosen].sum()),
            frozenset([segment.view]), distance,
        )  # fmt: skip


def _settled(chosen: np.ndarray, at: np.ndarray, segment: Segment) -> np.ndarray:
    """Return the inliers of the plane of least squares through inliers, (b,) bool."""
    inverse = segment.inverse_depths
    for _ in range(2):
        if chosen.sum() < 3:
            break
        root = np.sqrt(segment.weights[chosen]) / inverse[chosen]
        q = np.linalg.lstsq(at[chosen] * root[:, None], inverse[chosen] * root, rcond=None)[0]
        chosen = np.abs(at @ q / inverse - 1.0) < PLANE_SHARE
    return chosen


def spreads(
    inliers: np.ndarray, segment: Segment, extent: np.ndarray | None = None
) -> np.ndarray:  # fmt: skip
    """Return (t,) how widely sets of known depths spread across their line.

    Parameters
    ----------
    inliers : (t, b) array
        1 or true where a known depth of the segment belongs to a set.
    extent : (2, 2) array, optional
        Covariance of the pixels to compare with, those of the segment by default.

    Returns
    -------
    (t,) float64
        Standard deviation along the shorter axis of each set, over that of the pixels along it.
    """
    extent = segment.extent if extent is None else extent
    x, y = (segment.places - segment.places.mean(0)).T
    moments = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1) * segment.weights[:, None]
    total, mean_x, mean_y, xx, xy, yy = (inliers @ moments).T
    total = np.maximum(total, 1e-12)
    mean_x, mean_y = mean_x / total, mean_y / total
    xx, xy, yy = xx / total - mean_x**2, xy / total - mean_x * mean_y, yy / total - mean_y**2
    least = np.maximum((xx + yy) / 2 - np.hypot((xx - yy) / 2, xy), 0.0)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
    axis = np.stack([np.cos(angle), np.sin(angle)], 1)
    own = np.einsum("ti,ij,tj->t", axis, extent, axis)
    return np.sqrt(least / np.maximum(own, 1e-9))

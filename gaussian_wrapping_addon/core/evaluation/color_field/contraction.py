# SPDX-License-Identifier: GPL-3.0-or-later
"""Contract unbounded space to a ball in which a pixel's footprint hardly grows with distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...dataset.camera import Camera

MIN_RADIUS_SHARE = 0.1
"""Least radius as a share of the distance to what is seen: without it cameras in one place would
leave no inside."""


@dataclass(frozen=True)
class Contraction:
    """Identity within a ball around the cameras, ``(2 - 1 / n) x / n`` outside (n in radii).

    The map of Mip-NeRF 360 (docs/method.md, section 9.3), which the published colour field uses.
    """

    center: np.ndarray
    """(3,) float64, world frame."""
    radius: float
    """World units."""

    @classmethod
    def of_cameras(cls, cameras: Sequence[Camera], distance: float) -> Contraction:
        """Return the contraction around the mean camera centre, out to the farthest one.

        Parameters
        ----------
        distance : float
            Typical distance of the surface from the cameras, world units, > 0.
        """
        centers = np.array([camera.center for camera in cameras])
        center = centers.mean(axis=0)
        spread = float(np.linalg.norm(centers - center, axis=1).max())
        return cls(center, max(spread, MIN_RADIUS_SHARE * distance))

    def points(self, points: np.ndarray) -> np.ndarray:
        """Map (n, 3) world points into the ball of radius 2; float64."""
        local = (np.asarray(points, np.float64) - self.center) / self.radius
        norm = np.maximum(np.linalg.norm(local, axis=1, keepdims=True), 1.0)
        return local * ((2.0 - 1.0 / norm) / norm)

    def scales(self, points: np.ndarray) -> np.ndarray:
        """Return (n,) contracted lengths per world length, across the direction to the centre."""
        local = (np.asarray(points, np.float64) - self.center) / self.radius
        norm = np.maximum(np.linalg.norm(local, axis=1), 1.0)
        return (2.0 - 1.0 / norm) / (norm * self.radius)

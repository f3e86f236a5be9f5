# SPDX-License-Identifier: GPL-3.0-or-later
"""Place virtual cameras around a splat that comes without photos."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...errors import DatasetError
from ...tolerances import SCENE_RADIUS
from ..camera import Camera
from ..frames.normalisation import RADIUS_MARGIN
from ..similarity import Similarity

PHOTO_SIDE_PX = 800
FIELD_OF_VIEW_DEG = 50.0

FAR_VIEWS, NEAR_VIEWS = 28, 20
"""Far views show the whole splat, near views its middle at higher resolution."""

FAR_MARGIN = 1.05
NEAR_DISTANCE = 1.7
"""Distance of the near views in radii; from the far views the sphere fits the image."""

MIN_OPACITY = 0.1
"""Gaussians of lower opacity are ignored when measuring the extent."""

WHOLE_SHARE, MIDDLE_SHARE = 0.98, 0.5
SURROUNDINGS_RATIO = 3.0
"""If the radius of :data:`WHOLE_SHARE` is more than this many times that of :data:`MIDDLE_SHARE`,
the splat has surroundings, and this ratio limits the radius that the cameras cover."""

MAX_RADIUS = 1e15
"""Of half of the Gaussians: beyond it, float32 holds no scene."""

NO_PHOTOS_WARNING = (
    "A splat without photos is wrapped from virtual views around its middle: surroundings and "
    "rooms seen from inside are not covered, and errors of the splat remain."
)
NO_PHOTOS_HINT = "If its photos exist, give them as the input and the splat as the start."


@dataclass(frozen=True)
class SplatExtent:
    """Centre and radius of a splat, frame of the file."""

    center: np.ndarray
    """(3,) float64."""
    radius: float
    has_surroundings: bool
    """Whether a substantial part lies beyond ``radius``."""


def splat_extent(means: np.ndarray, opacities: np.ndarray) -> SplatExtent:
    """Return the robust centre and radius of the opaque Gaussians.

    Parameters
    ----------
    means : (n, 3)
        Finite.
    opacities : (n,)
        Effective opacities in [0, 1], used as weights.

    Raises
    ------
    DatasetError
        All Gaussians are transparent or coincide, or they are scattered without bounds.
    """
    opaque = opacities >= MIN_OPACITY
    if not opaque.any():
        raise DatasetError(
            "All Gaussians of the splat are transparent.",
            "Check that opacities are stored as logits.",
        )
    points = np.asarray(means, np.float64)[opaque]
    weights = np.asarray(opacities, np.float64)[opaque]
    center = np.array([_quantile(points[:, k], weights, 0.5) for k in range(3)])
    with np.errstate(over="ignore"):  # some may lie as far away as numbers go
        distance = np.linalg.norm(points - center, axis=1)
    middle = _quantile(distance, weights, MIDDLE_SHARE)
    whole = _quantile(distance, weights, WHOLE_SHARE)
    if not whole > 0.0:
        raise DatasetError("All Gaussians of the splat coincide.", "Export it again.")
    if not middle < MAX_RADIUS:
        raise DatasetError(
            "The Gaussians of the splat are scattered too far for one scene.", "Export it again."
        )
    has_surroundings = middle > 0.0 and whole > SURROUNDINGS_RATIO * middle
    radius = SURROUNDINGS_RATIO * middle if has_surroundings else whole
    return SplatExtent(center, float(radius), bool(has_surroundings))


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][min(np.searchsorted(total, share * total[-1]), len(values) - 1)])


def cameras_on_spheres(extent: SplatExtent) -> list[Camera]:
    """Return cameras on two spheres around a splat that look at its centre, frame of the file."""
    half = math.radians(0.5 * FIELD_OF_VIEW_DEG)
    focal_px = 0.5 * PHOTO_SIDE_PX / math.tan(half)
    far = FAR_MARGIN / math.sin(half)
    cameras: list[Camera] = []
    for count, distance in ((FAR_VIEWS, far), (NEAR_VIEWS, NEAR_DISTANCE)):
        for direction in fibonacci_directions(count):
            eye = extent.center + distance * extent.radius * direction
            cameras.append(
                Camera(
                    f"view_{len(cameras):03d}.png",
                    PHOTO_SIDE_PX,
                    PHOTO_SIDE_PX,
                    focal_px,
                    focal_px,
                    0.5 * PHOTO_SIDE_PX,
                    0.5 * PHOTO_SIDE_PX,
                    _look_at(eye, -direction),
                )
            )
    return cameras


def _look_at(eye: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return (3, 4) ``cam_from_world`` with Z up; no direction of the lattice is a pole."""
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.concatenate([rotation, -(rotation @ eye)[:, None]], axis=1)


def scene_frame(cameras: list[Camera]) -> Similarity:
    """Return ``scene_from_world``: translation and scale only, keeping the file's axes."""
    centers = np.stack([camera.center for camera in cameras])
    mean = centers[0] + (centers - centers[0]).mean(axis=0)
    reach = float(np.linalg.norm(centers - mean, axis=1).max())
    return Similarity(RADIUS_MARGIN * reach / SCENE_RADIUS, np.eye(3), mean).inverse()


def fibonacci_directions(count: int) -> np.ndarray:
    """Return (count, 3) unit vectors of a spherical Fibonacci lattice; none is a pole."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)

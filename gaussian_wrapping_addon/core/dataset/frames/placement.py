# SPDX-License-Identifier: GPL-3.0-or-later
"""Place a scene: set its scale, level the ground at z = 0 with +Z up, set the origin.

Each step is a similarity applied after the present placement. Scaling is always uniform, and steps
are idempotent: a step from points that are placed already is the identity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...errors import UsageError
from ..similarity import Similarity

COINCIDENT = 1e-6
"""Distance over size of the coordinates below which two points coincide: in Blender's single
precision such a distance has hardly one significant digit."""
COLLINEAR = 0.01
"""Second over first extent below which points count as collinear: within the picking error, the
plane through them could rotate freely about the line."""
SMALLEST_SCALE, LARGEST_SCALE = 1e-9, 1e9
"""Bounds of a placement's scale. Beyond them single precision is not sufficient, and the distance
was mistyped."""
SIMILAR = 1e-4
"""Relative tolerance of a matrix's axis lengths and right angles: object matrices are single
precision, and a hierarchy accumulates a few rounding errors."""


@dataclass(frozen=True)
class Plane:
    """A plane with an upper side."""

    point: np.ndarray
    """(3,) float64, a point on it."""
    normal: np.ndarray
    """(3,) float64, unit length, pointing up."""


def scale_step(points: np.ndarray, length: float) -> Similarity:
    """Scale about the origin so that two points are ``length`` apart.

    A ground at z = 0 and a chosen origin stay where they are.

    Parameters
    ----------
    points : (2, 3) float64
    length : float
        True distance, in the unit of the placed scene.

    Raises
    ------
    UsageError
        There are not exactly two points, they coincide, or the length is not positive.
    """
    points = _finite(points)
    if len(points) != 2:
        raise UsageError(
            f"{_count(len(points))} picked.", "Pick two points whose distance you know."
        )
    if not (math.isfinite(length) and length > 0.0):
        raise UsageError(f"{length:g} is not a distance.", "Enter a length greater than zero.")
    distance = float(np.linalg.norm(points[1] - points[0]))
    if distance <= COINCIDENT * float(np.abs(points).max()):
        raise UsageError("The two points coincide.", "Pick two points that are far apart.")
    return Similarity(length / distance)


def plane_through(points: np.ndarray, above: np.ndarray) -> Plane:
    """Return the plane through three points, or the least-squares plane of more.

    Parameters
    ----------
    points : (n, 3) float64
    above : (k, 3) float64
        Points above the plane, such as camera centres. Without any, or with as many below as
        above, up is the side nearer to +Z.

    Raises
    ------
    UsageError
        Fewer than three points, or all of them on one line.
    """
    points = _finite(points)
    if len(points) < 3:
        raise UsageError(
            f"{_count(len(points))} picked.", "Pick three points or more on the ground."
        )
    center = points.mean(0)
    offsets = points - center
    _, extents, axes = np.linalg.svd(offsets, full_matrices=False)  # (3,), (3, 3)
    if extents[0] <= COINCIDENT * float(np.abs(points).max()):
        raise UsageError("The points coincide.", "Pick three points that are far apart.")
    if extents[1] <= COLLINEAR * extents[0]:
        raise UsageError(
            "The points lie on one line.", "Pick a third point well to the side of the line."
        )
    normal = np.cross(axes[0], axes[1])
    side = float(np.median((np.asarray(above, np.float64) - center) @ normal)) if len(above) else 0
    if abs(side) <= COINCIDENT * extents[0]:
        side = normal[2]
    return Plane(center, normal if side >= 0.0 else -normal)


def ground_step(plane: Plane) -> Similarity:
    """Rotate the plane's normal to +Z by the smallest angle and move the plane to z = 0.

    The plane's point keeps its x and y.
    """
    rotation = turn_to_z(plane.normal)
    target = np.array([plane.point[0], plane.point[1], 0.0])
    return Similarity(1.0, rotation, target - rotation @ plane.point)


def origin_step(point: np.ndarray) -> Similarity:
    """Move ``point``, (3,) float64, to the origin."""
    return Similarity(1.0, np.eye(3), -_finite(np.reshape(point, (1, 3)))[0])


def turn_to_z(direction: np.ndarray) -> np.ndarray:
    """Return the (3, 3) rotation of smallest angle that maps a unit vector to +Z."""
    if direction[2] >= 0.0:
        return _least_turn(direction)
    # Near -Z the axis is undetermined: a half turn about X first is one of the smallest.
    half_turn = np.diag([1.0, -1.0, -1.0])
    return _least_turn(half_turn @ direction) @ half_turn


def _least_turn(direction: np.ndarray) -> np.ndarray:
    x, y, z = direction / np.linalg.norm(direction)
    axis = np.array([y, -x, 0.0])  # direction cross Z
    cross = np.array([[0.0, 0.0, axis[1]], [0.0, 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + z)


def similarity_of_matrix(matrix: np.ndarray, name: str) -> Similarity:
    """Convert a (4, 4) matrix to a similarity.

    Parameters
    ----------
    matrix : (4, 4) float64
    name : str
        Name of the object, for the message.

    Raises
    ------
    UsageError
        The matrix is not finite, is singular, mirrors, or scales its axes differently.
    """
    matrix = np.asarray(matrix, np.float64)
    linear = matrix[:3, :3]
    hint = "Clear its scale (Alt S)."
    if not np.isfinite(matrix).all():
        raise UsageError(f"{name} has a position that is not finite.", "Clear its transform.")
    rotation, stretches, axes = np.linalg.svd(linear)
    if stretches[0] <= 0.0 or stretches[2] < (1.0 - SIMILAR) * stretches[0]:
        raise UsageError(f"{name} is scaled differently along its axes.", hint)
    rotation = rotation @ axes
    if np.linalg.det(rotation) < 0.0:
        raise UsageError(f"{name} is mirrored.", hint)
    return Similarity(float(stretches.mean()), rotation, matrix[:3, 3].copy())


def check_scale(placement: Similarity) -> None:
    """Raise if the scale of a placement is too small or large for single precision.

    Raises
    ------
    UsageError
        The scale lies outside of :data:`SMALLEST_SCALE` to :data:`LARGEST_SCALE`.
    """
    if not SMALLEST_SCALE <= placement.scale <= LARGEST_SCALE:
        raise UsageError(
            f"The scene would be scaled by {placement.scale:.3g}.", "Check the distance entered."
        )


def _count(number: int) -> str:
    return "No point is" if number == 0 else "One point is" if number == 1 else f"{number} are"


def _finite(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points, np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise UsageError("A picked point is not finite.", "Pick another point.")
    return points

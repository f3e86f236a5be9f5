# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a result stands in the world of its user."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DatasetError, ParseError, UsageError
from ..files import read_json, write_json
from .camera import Similarity

# -- Similarity between corresponding points: closed form (Umeyama) and RANSAC --------------------
#
# Everything is computed about the centroids, so that coordinates of millions of units (a
# cadastral frame) cost no digits beyond those already lost in the input.

COLLINEAR_SHARE = 1e-6
"""Ratio of second to first extent below which points count as collinear: the rotation about their
line would depend on a millionth of the scene, less than the error of any pose estimate."""
RANSAC_CONFIDENCE = 1.0 - 1e-9
"""Drawing ends when one of the drawn triples is free of outliers with this probability."""
RANSAC_BATCH = 512
"""Triples scored together; bounds the memory to batch x points x 3 numbers."""
RANSAC_POLISH = 20


@dataclass(frozen=True)
class RansacResult:
    """Result of :func:`umeyama_ransac`."""

    transform: Similarity
    """``target_from_source``."""
    inliers: np.ndarray
    """(n,) bool, pairs within the threshold under ``transform``."""
    rmse: float
    """Root mean square distance of the inliers, units of the target."""


def umeyama(source: np.ndarray, target: np.ndarray, *, with_scale: bool) -> Similarity:
    """Return the similarity that maps ``source`` to ``target`` in the least-squares sense.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
    PAMI 1991. The rotation is proper even where a reflection would fit better.

    Parameters
    ----------
    source, target : (n, 3) float64
        Corresponding points, n >= 3, not collinear.
    with_scale : bool
        Also fit the scale; otherwise it is 1.

    Raises
    ------
    DatasetError
        Fewer than three pairs, values that are not finite, or collinear points.
    """
    return fit_similarity(*_pairs(source, target), with_scale)


def _pairs(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.ndim != 2 or source.shape[1:] != (3,) or source.shape != target.shape:
        text = f"Points of shapes {source.shape} and {target.shape} do not match."
        raise DatasetError(text, "Give two (n, 3) arrays of the same length.")
    if len(source) < 3:
        text = f"{len(source)} pairs of points do not determine an alignment."
        raise DatasetError(text, "At least 3 are needed.")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise DatasetError("The points to align are not all finite.", "Remove NaN and infinities.")
    for points, name in ((source, "source"), (target, "target")):
        require_plane(points, name)
    return source, target


def require_plane(points: np.ndarray, name: str) -> None:
    local = points - points.mean(0)
    extents = np.sqrt(np.maximum(np.linalg.eigvalsh(local.T @ local / len(local))[::-1], 0.0))
    rounding = 8 * np.finfo(np.float64).eps * np.abs(points).max()
    if extents[1] <= max(COLLINEAR_SHARE * extents[0], rounding):
        what = "in one place" if extents[0] <= rounding else "on one line"
        text = f"The {len(points)} {name} points lie {what}, so the rotation is undetermined."
        raise DatasetError(text, "Use cameras or points that span at least a plane.")


def fit_similarity(source: np.ndarray, target: np.ndarray, with_scale: bool) -> Similarity:
    """:func:`umeyama` without its checks."""
    source_mean, target_mean = source.mean(0), target.mean(0)
    a, b = source - source_mean, target - target_mean
    u, d, vt = np.linalg.svd(b.T @ a / len(a))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0])
    rotation = (u * signs) @ vt
    scale = float((d * signs).sum() / (a * a).sum(1).mean()) if with_scale else 1.0
    return Similarity(scale, rotation, target_mean - scale * (rotation @ source_mean))


def umeyama_ransac(
    source: np.ndarray,
    target: np.ndarray,
    *,
    threshold: float,
    iterations: int,
    seed: int,
) -> RansacResult:
    """Fit a similarity to pairs with outliers by RANSAC.

    Triples are drawn, fitted and scored by their number of inliers within ``threshold``; the best
    one is refitted to its inliers until these no longer change. Drawing ends early once an
    outlier-free triple was drawn with a probability of ``RANSAC_CONFIDENCE``.

    Parameters
    ----------
    source, target : (n, 3) float64
    threshold : float
        Largest distance of an inlier, units of the target.
    iterations : int
        Maximum number of triples.

    Raises
    ------
    DatasetError
        Degenerate pairs (see :func:`umeyama`), or no triple with at least three inliers.
    """
    source, target = _pairs(source, target)
    source_mean, target_mean = source.mean(0), target.mean(0)
    a, b = source - source_mean, target - target_mean
    rng = np.random.default_rng(seed)
    best_count, best_cost, best = 0, np.inf, np.zeros(len(a), bool)
    drawn, needed = 0, float(iterations)
    while drawn < min(iterations, needed):
        batch = min(RANSAC_BATCH, iterations - drawn)
        drawn += batch
        # The three smallest of n random keys are a triple without repetition.
        triples = np.argpartition(rng.random((batch, len(a))), 2, axis=1)[:, :3]
        within, cost = _score_triples(a, b, triples, threshold)
        counts = within.sum(1)
        order = np.lexsort((cost, -counts))
        if (counts[order[0]], -cost[order[0]]) > (best_count, -best_cost):
            best_count, best_cost = int(counts[order[0]]), float(cost[order[0]])
            best = within[order[0]]
            clean = (best_count / len(a)) ** 3
            if clean >= 1.0:
                needed = 0.0
            elif clean > 0.0:
                needed = np.log(1.0 - RANSAC_CONFIDENCE) / np.log1p(-clean)
    if best_count < 3:
        text = f"No alignment brings three of {len(a)} pairs within {threshold:g}."
        hint = "The pairs do not correspond, or the threshold is far too small."
        raise DatasetError(text, hint)
    for _ in range(RANSAC_POLISH):
        require_plane(a[best], "agreeing source")
        fit = fit_similarity(a[best], b[best], with_scale=True)
        distances = np.linalg.norm(fit.points(a) - b, axis=1)
        within = distances <= threshold
        if within.sum() < 3 or (within == best).all():
            break
        best = within
    shift = fit.translation + target_mean - fit.scale * (fit.rotation @ source_mean)
    transform = Similarity(fit.scale, fit.rotation, shift)
    inliers = distances <= threshold
    rmse = float(np.sqrt((distances[inliers] ** 2).mean())) if inliers.any() else float("inf")
    return RansacResult(transform, inliers, rmse)


def _score_triples(
    a: np.ndarray, b: np.ndarray, triples: np.ndarray, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inliers of each triple, (k, n) bool, and the sum of their squares, (k,)."""
    p, q = a[triples], b[triples]  # (k, 3, 3)
    p_mean, q_mean = p.mean(1), q.mean(1)
    p, q = p - p_mean[:, None], q - q_mean[:, None]
    u, d, vt = np.linalg.svd(np.einsum("kij,kil->kjl", q, p))
    signs = np.ones_like(d)
    signs[:, 2] = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0, -1.0, 1.0)
    rotation = np.einsum("kij,kj,kjl->kil", u, signs, vt)
    spread = (p * p).sum((1, 2))
    scale = (d * signs).sum(1) / np.maximum(spread, 1e-300)
    shift = q_mean - scale[:, None] * np.einsum("kij,kj->ki", rotation, p_mean)
    moved = scale[:, None, None] * np.einsum("nj,kij->kni", a, rotation) + shift[:, None]
    squared = ((moved - b) ** 2).sum(2)  # (k, n)
    usable = (d[:, 1] > COLLINEAR_SHARE * d[:, 0]) & (scale > 0)
    within = (squared <= threshold * threshold) & usable[:, None]
    return within, np.where(within, squared, 0.0).sum(1)


# -- Place a scene: set its scale, level the ground at z = 0 with +Z up, set the origin -----------
#
# Each step is a similarity applied after the present placement. Scaling is always uniform, and
# steps are idempotent: a step from points that are placed already is the identity.

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
        hint = "Pick two points whose distance you know."
        raise UsageError(f"{_count(len(points))} picked.", hint)
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
        hint = "Pick three points or more on the ground."
        raise UsageError(f"{_count(len(points))} picked.", hint)
    center = points.mean(0)
    _, extents, axes = np.linalg.svd(points - center, full_matrices=False)  # (3,), (3, 3)
    if extents[0] <= COINCIDENT * float(np.abs(points).max()):
        raise UsageError("The points coincide.", "Pick three points that are far apart.")
    if extents[1] <= COLLINEAR * extents[0]:
        hint = "Pick a third point well to the side of the line."
        raise UsageError("The points lie on one line.", hint)
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

    Raises UsageError: the scale lies outside of :data:`SMALLEST_SCALE` to :data:`LARGEST_SCALE`.
    """
    if not SMALLEST_SCALE <= placement.scale <= LARGEST_SCALE:
        text = f"The scene would be scaled by {placement.scale:.3g}."
        raise UsageError(text, "Check the distance entered.")


def _count(number: int) -> str:
    return "No point is" if number == 0 else "One point is" if number == 1 else f"{number} are"


def _finite(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points, np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise UsageError("A picked point is not finite.", "Pick another point.")
    return points


# -- Read and write ``placement.json``: the transform of Blender's parent empty in float64 --------

FILE_NAME = "placement.json"
VERSION = 1
_ORTHONORMAL = 1e-9
"""Tolerance for products of a few float64 rotations."""


def write_placement(
    path: Path, blender_from_scene: Similarity, world_from_scene: Similarity
) -> None:
    """Write a placement together with its scene frame.

    Raises UsageError: the file cannot be written.
    """
    values = {
        "version": VERSION, "blender_from_scene": blender_from_scene.to_json(),
        "world_from_scene": world_from_scene.to_json(),
    }  # fmt: skip
    try:
        write_json(path, values)
    except OSError as error:
        text = f"{path} cannot be written: {error.strerror}."
        raise UsageError(text, "Check the folder's permissions.") from None


def read_placement(path: Path, world_from_scene: Similarity) -> Similarity | None:
    """Read ``blender_from_scene``.

    ``world_from_scene``: scene frame of the result that the placement applies to.
    Returns None if the file was written for another scene frame (the cameras were solved again), in
    which its lengths and directions differ.
    Raises ParseError: the file holds no placement.
    """
    hint = "Delete the file; the scene is then placed as it was trained."
    try:
        values = read_json(path)
    except ParseError as error:
        raise ParseError(path, "whole file", "not JSON.", hint) from error
    try:
        if values["version"] != VERSION:
            raise ValueError(f"version {values['version']!r} is not {VERSION}")
        placement = Similarity.from_json(values["blender_from_scene"])
        known = Similarity.from_json(values["world_from_scene"])
        if not (np.isfinite(placement.matrix()).all() and np.isfinite(known.matrix()).all()):
            raise ValueError("a number is not finite")
        gram = placement.rotation @ placement.rotation.T
        if np.abs(gram - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(placement.rotation) < 0:
            raise ValueError("not a rotation")
        check_scale(placement)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, UsageError) as error:
        raise ParseError(path, "whole file", f"not a placement ({error}).", hint) from None
    return placement if known.to_json() == world_from_scene.to_json() else None

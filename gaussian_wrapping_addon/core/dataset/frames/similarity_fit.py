# SPDX-License-Identifier: GPL-3.0-or-later
"""Similarity between corresponding points: closed form (Umeyama) and RANSAC.

Everything is computed about the centroids, so that coordinates of millions of units (a cadastral
frame) cost no digits beyond those already lost in the input.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import DatasetError
from ..similarity import Similarity

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
    source, target = _pairs(source, target)
    for points, name in ((source, "source"), (target, "target")):
        require_plane(points, name)
    return fit_similarity(source, target, with_scale)


def _pairs(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.ndim != 2 or source.shape[1:] != (3,) or source.shape != target.shape:
        raise DatasetError(
            f"Points of shapes {source.shape} and {target.shape} do not match.",
            "Give two (n, 3) arrays of the same length.",
        )
    if len(source) < 3:
        raise DatasetError(
            f"{len(source)} pairs of points do not determine an alignment.",
            "At least 3 are needed.",
        )
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise DatasetError("The points to align are not all finite.", "Remove NaN and infinities.")
    return source, target


def require_plane(points: np.ndarray, name: str) -> None:
    local = points - points.mean(0)
    variances = np.linalg.eigvalsh(local.T @ local / len(local))[::-1]
    extents = np.sqrt(np.maximum(variances, 0.0))
    rounding = 8 * np.finfo(np.float64).eps * np.abs(points).max()
    if extents[1] <= max(COLLINEAR_SHARE * extents[0], rounding):
        what = "in one place" if extents[0] <= rounding else "on one line"
        raise DatasetError(
            f"The {len(points)} {name} points lie {what}, so the rotation is undetermined.",
            "Use cameras or points that span at least a plane.",
        )


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
    with_scale: bool,
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
    for points, name in ((source, "source"), (target, "target")):
        require_plane(points, name)
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
        within, cost = _score_triples(a, b, triples, threshold, with_scale)
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
        raise DatasetError(
            f"No alignment brings three of {len(a)} pairs within {threshold:g}.",
            "The pairs do not correspond, or the threshold is far too small.",
        )
    for _ in range(RANSAC_POLISH):
        require_plane(a[best], "agreeing source")
        fit = fit_similarity(a[best], b[best], with_scale)
        distances = np.linalg.norm(fit.points(a) - b, axis=1)
        within = distances <= threshold
        if within.sum() < 3 or (within == best).all():
            break
        best = within
    transform = Similarity(
        fit.scale,
        fit.rotation,
        fit.translation + target_mean - fit.scale * (fit.rotation @ source_mean),
    )
    inliers = distances <= threshold
    rmse = float(np.sqrt((distances[inliers] ** 2).mean())) if inliers.any() else float("inf")
    return RansacResult(transform, inliers, rmse)


def _score_triples(
    a: np.ndarray, b: np.ndarray, triples: np.ndarray, threshold: float, with_scale: bool
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
    scale = (d * signs).sum(1) / np.maximum(spread, 1e-300) if with_scale else np.ones(len(d))
    shift = q_mean - scale[:, None] * np.einsum("kij,kj->ki", rotation, p_mean)
    moved = scale[:, None, None] * np.einsum("nj,kij->kni", a, rotation) + shift[:, None]
    squared = ((moved - b) ** 2).sum(2)  # (k, n)
    usable = (d[:, 1] > COLLINEAR_SHARE * d[:, 0]) & (scale > 0)
    within = (squared <= threshold * threshold) & usable[:, None]
    return within, np.where(within, squared, 0.0).sum(1)

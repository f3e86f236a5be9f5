# SPDX-License-Identifier: GPL-3.0-or-later
"""Similarity transforms between point sets: closed form (Umeyama), RANSAC, and ICP.

Everything is computed about the centroids, so that coordinates of millions of units (a cadastral
frame) cost no digits beyond those already lost in the input.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...dataset.similarity import Similarity
from ...errors import DatasetError
from ..surface.samples import voxel_downsample_points

COLLINEAR_SHARE = 1e-6
"""Ratio of second to first extent below which points count as collinear: the rotation about their
line would depend on a millionth of the scene, less than the error of any pose estimate."""
RANSAC_CONFIDENCE = 1.0 - 1e-9
"""Drawing ends when one of the drawn triples is free of outliers with this probability."""
RANSAC_BATCH = 512
"""Triples scored together; bounds the memory to batch x points x 3 numbers."""
RANSAC_POLISH = 20
ICP_ITERATIONS = 100
ICP_TOLERANCE = 1e-6
"""Relative change of fitness and rmse under which ICP has converged."""
TANKS_TOLERANCE = 1e-4
"""The same for the three stages: at an rmse of a third of the threshold, this is a change of 3e-5
thresholds an iteration, which no share within the threshold shows."""
TANKS_STAGES = ((1.0, 80.0), (0.5, 20.0), (0.0, 2.0))
"""Voxel and largest distance of each refinement stage in thresholds (docs/method.md, section 9.1);
voxel 0 takes every k-th point instead."""
TANKS_MAX_POINTS = 4_000_000
"""Maximum number of points in the last stage, after taking every k-th."""


@dataclass(frozen=True)
class RansacResult:
    """Result of :func:`umeyama_ransac`."""

    transform: Similarity
    """``target_from_source``."""
    inliers: np.ndarray
    """(n,) bool, pairs within the threshold under ``transform``."""
    rmse: float
    """Root mean square distance of the inliers, units of the target."""


@dataclass(frozen=True)
class IcpResult:
    """Result of :func:`icp`."""

    transform: Similarity
    """``target_from_source``."""
    fitness: float
    """Share of the source points with a correspondence within ``max_distance``."""
    rmse: float
    """Root mean square distance of the correspondences, units of the target."""
    iterations: int = 0
    converged: bool = False


@dataclass(frozen=True)
class TanksRefinement:
    """The three stages of the refinement, in order."""

    transform: Similarity
    """``target_from_source`` after the last stage."""
    stages: tuple[IcpResult, ...]

    def to_json(self) -> list[dict[str, Any]]:
        """Return fitness, rmse and iterations of every stage as plain JSON values."""
        return [
            {
                "fitness": s.fitness,
                "rmse": s.rmse,
                "iterations": s.iterations,
                "converged": s.converged,
            }
            for s in self.stages
        ]


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
        _require_plane(points, name)
    return _fit(source, target, with_scale)


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


def _require_plane(points: np.ndarray, name: str) -> None:
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


def _fit(source: np.ndarray, target: np.ndarray, with_scale: bool) -> Similarity:
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
        _require_plane(points, name)
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
        _require_plane(a[best], "agreeing source")
        fit = _fit(a[best], b[best], with_scale)
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


def icp(
    source: np.ndarray,
    target: np.ndarray,
    start: Similarity,
    *,
    max_distance: float,
    iterations: int = ICP_ITERATIONS,
    with_scale: bool,
    tolerance: float = ICP_TOLERANCE,
    threads: int = 1,
) -> IcpResult:
    """Refine an alignment by the iterative closest point algorithm.

    Point to point (Besl and McKay 1992). It ends when no correspondence changes, when fitness and
    rmse both change by less than ``tolerance`` (relative), or after ``iterations``.

    Parameters
    ----------
    source : (n, 3) float64
    target : (m, 3) float64
    start : Similarity
        Initial ``target_from_source``.
    max_distance : float
        Pairs farther apart are ignored, units of the target.
    with_scale : bool
        Whether the scale is optimised; otherwise that of ``start`` is kept.
    threads : int
        Threads of the search; the result does not depend on it.

    Raises
    ------
    DatasetError
        Fewer than three points, no pair within ``max_distance``, or collinear pairs.
    """
    from scipy.spatial import cKDTree

    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    for points, name in ((source, "source"), (target, "target")):
        if points.ndim != 2 or points.shape[1:] != (3,) or len(points) < 3:
            raise DatasetError(
                f"ICP needs at least 3 {name} points, not an array {points.shape}.",
                "Check that the crop contains parts of both surfaces.",
            )
        if not np.isfinite(points).all():
            raise DatasetError(f"The {name} points are not all finite.", "Remove NaN from them.")
    center = target.mean(0)
    aim = target - center
    tree = cKDTree(aim)
    # "placed" are the source points under ``start``; only the increment is iterated.
    placed = start.points(source) - center
    added = Similarity()
    partners, fitness, rmse, round_, converged = np.zeros(0, np.int64), 0.0, 0.0, 0, False
    while True:
        distances, nearest = tree.query(
            added.points(placed), distance_upper_bound=max_distance, workers=max(threads, 1)
        )
        near = np.isfinite(distances)
        if near.sum() < 3:
            raise DatasetError(
                f"Only {int(near.sum())} of {len(source)} points lie within {max_distance:g} of "
                "the true surface.",
                "The initial alignment is wrong: check cameras, matrices and units.",
            )
        before = (fitness, rmse)
        fitness = float(near.mean())
        rmse = float(np.sqrt((distances[near] ** 2).mean()))
        if round_ and (
            np.array_equal(nearest, partners)
            or (
                abs(fitness - before[0]) <= tolerance * fitness
                and abs(rmse - before[1]) <= tolerance * rmse
            )
        ):
            converged = True
            break
        if round_ == iterations:
            break
        partners = nearest
        pairs = placed[near], aim[nearest[near]]
        for points, name in zip(pairs, ("paired source", "paired target"), strict=True):
            _require_plane(points, name)
        added = _fit(*pairs, with_scale)
        round_ += 1
    # added(start(x) - c) + c as one similarity of x.
    rotation = added.rotation @ start.rotation
    scale = added.scale * start.scale
    translation = added.points((start.translation - center)[None])[0] + center
    return IcpResult(Similarity(scale, rotation, translation), fitness, rmse, round_, converged)


def refine_as_tanks(
    source: np.ndarray,
    target: np.ndarray,
    start: Similarity,
    threshold: float,
    *,
    inside: Callable[[np.ndarray], np.ndarray] | None = None,
    iterations: int = ICP_ITERATIONS,
    threads: int = 1,
) -> TanksRefinement:
    """Refine an alignment as Tanks and Temples does: ICP with scale in three stages.

    See docs/method.md, section 9.1.

    Stage 1: both sets downsampled to voxels of ``threshold``, pairs up to 80 thresholds. Stage 2:
    half of it and 20. Stage 3: every k-th point and 2. Points outside the crop are ignored; for
    the source, the crop is evaluated again at the start of every stage.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) float64
    threshold : float
        The scene's tau, units of the target.
    inside : callable or None
        The crop: maps (n, 3) points in the target's frame to (n,) bool.

    Raises
    ------
    DatasetError
        See :func:`icp`; also if the crop is empty.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if inside is not None:
        target = target[inside(target)]
    transform, stages = start, []
    for voxels, reach in TANKS_STAGES:
        moving = source if inside is None else source[inside(transform.points(source))]
        if min(len(moving), len(target)) < 3:
            raise DatasetError(
                f"The crop leaves {len(moving)} points of the mesh and {len(target)} of the truth.",
                "The initial alignment is wrong, or the crop belongs to another scene.",
            )
        aim = target
        if voxels:
            # Voxels are in the target's frame, so that both sets are equally dense.
            moving = transform.inverse().points(
                voxel_downsample_points(transform.points(moving), voxels * threshold)
            )
            aim = voxel_downsample_points(aim, voxels * threshold)
        else:
            moving, aim = _every_kth(moving), _every_kth(aim)
        stages.append(
            icp(
                moving,
                aim,
                transform,
                max_distance=reach * threshold,
                iterations=iterations,
                with_scale=True,
                tolerance=TANKS_TOLERANCE,
                threads=threads,
            )
        )
        transform = stages[-1].transform
    return TanksRefinement(transform, tuple(stages))


def _every_kth(points: np.ndarray) -> np.ndarray:
    return points[:: max(1, -(-len(points) // TANKS_MAX_POINTS))]

# SPDX-License-Identifier: GPL-3.0-or-later
"""Similarity alignment, ICP, pose errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import DatasetError
from ..scene.camera import Camera, Similarity
from ..scene.placement import fit_similarity, require_plane, umeyama
from .surface_scores import voxel_downsample

# -- Errors of solved camera poses after a similarity alignment of the camera centres -------------


@dataclass(frozen=True)
class PoseErrors:
    """Errors of the cameras present in both sets."""

    names: tuple[str, ...]
    center_shares: np.ndarray
    """(n,) distance of the aligned centre from the true one, over the true cameras' spread: the
    root mean square distance of their centres from their mean."""
    given_shares: np.ndarray  # (n,) the same distance before any alignment
    rotation_degrees: np.ndarray  # (n,) angle between the aligned and the true orientation
    spread: float  # the spread, units of the true frame
    transform: Similarity  # ``true_from_solved``
    missing: tuple[str, ...]  # true cameras missing in the solved set

    def to_json(self) -> dict[str, Any]:
        """Return counts, medians and maxima as plain JSON values."""
        return {
            "cameras": len(self.names),
            "missing": list(self.missing),
            "spread": self.spread,
            "center_share_median": float(np.median(self.center_shares)),
            "center_share_max": float(self.center_shares.max()),
            "given_share_median": float(np.median(self.given_shares)),
            "rotation_degrees_median": float(np.median(self.rotation_degrees)),
            "rotation_degrees_max": float(self.rotation_degrees.max()),
            "transform": self.transform.to_json(),
        }


def pose_errors(cameras: Sequence[Camera], true_cameras: Sequence[Camera]) -> PoseErrors:
    """Align cameras of equal names by their centres (with scale) and return the residual errors.

    The solved cameras may be in any frame.

    Raises
    ------
    DatasetError
        Duplicate names, fewer than three common names, or collinear centres.
    """
    solved, true = _by_name(cameras, "solved"), _by_name(true_cameras, "true")
    names = [name for name in true if name in solved]
    if len(names) < 3:
        raise DatasetError(
            f"{len(names)} of {len(true)} true cameras are named like one of the {len(solved)} "
            "solved ones.",
            "At least 3 names must be the same in both.",
        )
    centers = np.array([solved[name].center for name in names])
    true_centers = np.array([true[name].center for name in names])
    transform = umeyama(centers, true_centers, with_scale=True)
    spread = float(np.sqrt(((true_centers - true_centers.mean(0)) ** 2).sum(1).mean()))
    distances = np.linalg.norm(transform.points(centers) - true_centers, axis=1)
    given = np.linalg.norm(centers - true_centers, axis=1)
    moved = np.array([solved[name].rotation @ transform.rotation.T for name in names])
    difference = moved - np.array([true[name].rotation for name in names])  # (n, 3, 3)
    # ||A - B||_F = 2 sqrt(2) sin(angle / 2): accurate for tiny angles, unlike the trace.
    sines = np.linalg.norm(difference, axis=(1, 2)) / np.sqrt(8.0)
    angles = np.degrees(2.0 * np.arcsin(np.minimum(sines, 1.0)))
    missing = tuple(name for name in true if name not in solved)
    return PoseErrors(
        tuple(names), distances / spread, given / spread, angles, spread, transform, missing
    )


def _by_name(cameras: Sequence[Camera], kind: str) -> dict[str, Camera]:
    found: dict[str, Camera] = {}
    for camera in cameras:
        if camera.name in found:
            raise DatasetError(
                f"Two {kind} cameras are named {camera.name!r}.", "Give every camera its own name."
            )
        found[camera.name] = camera
    return found


# -- Similarity transforms between point sets without known pairs: ICP ----------------------------
#
# Everything is computed about the centroids, so that coordinates of millions of units (a
# cadastral frame) cost no digits beyond those already lost in the input.


ICP_ITERATIONS = 100
ICP_TOLERANCE = 1e-6
"""Relative change of fitness and rmse under which ICP has converged."""
TANKS_TOLERANCE = 1e-4
"""The same for the three stages: at an rmse of a third of the threshold, this is a change of 3e-5
thresholds an iteration, which no share within the threshold shows."""
TANKS_STAGES = ((1.0, 80.0), (0.5, 20.0), (0.0, 2.0))
"""Voxel and largest distance of each refinement stage in thresholds (docs/method.md, section 9.1);
voxel 0 takes every k-th point instead."""
TANKS_MAX_POINTS = 4_000_000  # maximum number of points in the last stage, after taking every k-th


@dataclass(frozen=True)
class IcpResult:
    """Result of :func:`icp`."""

    transform: Similarity  # ``target_from_source``
    fitness: float  # share of the source points with a correspondence within ``max_distance``
    rmse: float  # root mean square distance of the correspondences, units of the target
    iterations: int = 0
    converged: bool = False


@dataclass(frozen=True)
class TanksRefinement:
    """The three stages of the refinement, in order."""

    transform: Similarity  # ``target_from_source`` after the last stage
    stages: tuple[IcpResult, ...]

    def to_json(self) -> list[dict[str, Any]]:
        """Return fitness, rmse and iterations of every stage as plain JSON values."""
        names = ("fitness", "rmse", "iterations", "converged")
        return [{name: getattr(stage, name) for name in names} for stage in self.stages]


def icp(
    source: np.ndarray, target: np.ndarray, start: Similarity, *, max_distance: float,
    iterations: int = ICP_ITERATIONS, with_scale: bool, tolerance: float = ICP_TOLERANCE,
    threads: int = 1,
) -> IcpResult:  # fmt: skip
    """Refine an alignment by the iterative closest point algorithm.

    Point to point (Besl and McKay 1992). It ends when no correspondence changes, when fitness and
    rmse both change by less than ``tolerance`` (relative), or after ``iterations``.

    Parameters
    ----------
    source, target : (n, 3), (m, 3) float64
    start : Similarity
        Initial ``target_from_source``.
    max_distance : float
        Pairs farther apart are ignored, units of the target.
    with_scale : bool
        Whether the scale is optimised; otherwise that of ``start`` is kept.
    threads : int
        Of the search; the result does not depend on it.

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
    partners, fitness, rmse, round_ = np.zeros(0, np.int64), 0.0, 0.0, 0
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
        steady = (
            abs(fitness - before[0]) <= tolerance * fitness
            and abs(rmse - before[1]) <= tolerance * rmse
        )
        converged = round_ > 0 and (steady or np.array_equal(nearest, partners))
        if converged or round_ == iterations:
            break
        partners = nearest
        pairs = placed[near], aim[nearest[near]]
        for points, name in zip(pairs, ("paired source", "paired target"), strict=True):
            require_plane(points, name)
        added = fit_similarity(*pairs, with_scale)
        round_ += 1
    # added(start(x) - c) + c as one similarity of x.
    rotation = added.rotation @ start.rotation
    scale = added.scale * start.scale
    translation = added.points((start.translation - center)[None])[0] + center
    return IcpResult(Similarity(scale, rotation, translation), fitness, rmse, round_, converged)


def refine_as_tanks(
    source: np.ndarray, target: np.ndarray, start: Similarity, threshold: float, *,
    inside: Callable[[np.ndarray], np.ndarray], threads: int = 1,
) -> TanksRefinement:  # fmt: skip
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
    inside : callable
        The crop: maps (n, 3) points in the target's frame to (n,) bool.

    Raises
    ------
    DatasetError
        See :func:`icp`; also if the crop is empty.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    target = target[inside(target)]
    transform, stages = start, []
    for voxels, reach in TANKS_STAGES:
        moving = source[inside(transform.points(source))]
        if min(len(moving), len(target)) < 3:
            raise DatasetError(
                f"The crop leaves {len(moving)} points of the mesh and {len(target)} of the truth.",
                "The initial alignment is wrong, or the crop belongs to another scene.",
            )
        if voxels:
            # Voxels are in the target's frame, so that both sets are equally dense.
            moved = voxel_downsample(transform.points(moving), voxels * threshold)
            moving = transform.inverse().points(moved)
            aim = voxel_downsample(target, voxels * threshold)
        else:
            moving, aim = _every_kth(moving), _every_kth(target)
        found = icp(
            moving, aim, transform, max_distance=reach * threshold, with_scale=True,
            tolerance=TANKS_TOLERANCE, threads=threads,
        )  # fmt: skip
        stages.append(found)
        transform = found.transform
    return TanksRefinement(transform, tuple(stages))


def _every_kth(points: np.ndarray) -> np.ndarray:
    return points[:: max(1, -(-len(points) // TANKS_MAX_POINTS))]

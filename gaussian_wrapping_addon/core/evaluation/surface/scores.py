# SPDX-License-Identifier: GPL-3.0-or-later
"""Scores of a reconstructed surface: precision, recall, F1, Chamfer distance, normals.

See docs/method.md, section 9.1.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...dataset.camera import Camera
from ...errors import UsageError
from ...files import finite_json
from ...kernels.parallel import default_threads
from ...mesh.distance import distances_to_cloud, distances_to_mesh
from .samples import (
    SurfaceSamples,
    choose_per_cell,
    face_normals,
    sample_legacy,
    sample_uniformly,
    scan_virtually,
    voxel_downsample_points,
)
from .truth import MIN_CAMERAS, Truth

PROTOCOLS = ("uniform", "scan", "legacy")

MIN_THIN_SHARE = 0.01
"""Recall of thin parts is not meaningful if a smaller share of the true samples is thin."""

SCAN_RAYS = 4_000_000
"""Rays of a virtual scan unless a step is given: at most about 400 MB of points."""

Shares = tuple[float, ...]
"""One number in [0, 1] for each threshold."""

_Mesh = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class SurfaceScore:
    """Scores of one surface under one protocol; conventions: :func:`score_surface`."""

    thresholds: tuple[float, ...]
    precision: Shares
    recall: Shares
    f1: Shares
    visible_recall: Shares | None
    """Recall over the true samples that cameras see; ``None`` if visibility is unknown."""
    thin_recall: Shares | None
    """Recall over visible samples on thin structures; ``None`` without any."""
    accuracy_mean: float
    accuracy_median: float
    """Distance from the predicted samples to the truth; infinite without samples."""
    completeness_mean: float
    completeness_median: float
    """Distance from the true samples to the prediction; infinite if that is empty."""
    chamfer_mean: float
    chamfer_median: float
    """Mean of accuracy and completeness (means, medians)."""
    normal_consistency: float
    """Mean absolute cosine between corresponding normals, averaged over both directions."""
    normal_agreement: float
    """Share of corresponding points whose normals point to the same side, averaged likewise."""
    predicted_count: int
    truth_count: int
    visible_count: int
    thin_count: int
    """Number of evaluated samples."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; infinite distances become ``None``."""
        return dict(finite_json(dataclasses.asdict(self)))


@dataclass(frozen=True)
class CloudScore:
    """Scores of one cloud against another at one threshold."""

    threshold: float
    precision: float
    recall: float
    f1: float
    accuracy_mean: float
    completeness_mean: float
    """Mean distances; infinite if the prediction is empty."""
    predicted_count: int
    truth_count: int
    """Number of points after downsampling."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; infinite distances become ``None``."""
        return dict(finite_json(dataclasses.asdict(self)))


def score_surface(
    predicted: SurfaceSamples,
    predicted_mesh: _Mesh | None,
    truth: Truth,
    thresholds: Sequence[float],
    *,
    reached: SurfaceSamples | None = None,
    min_cameras: int = MIN_CAMERAS,
    threads: int = 1,
) -> SurfaceScore:
    """Compare samples of a surface with the truth.

    The crop selects the samples that are evaluated, on either side, but not what they are compared
    with: a sample at its boundary may have its counterpart outside. Conventions:

    - precision: share of evaluated predicted samples within the threshold (``<=``) of the truth's
      mesh, or of its cloud if it has no mesh;
    - recall: share of evaluated true samples within it of ``predicted_mesh``, or if that is
      ``None`` of the samples ``reached``, or else of the predicted ones; visible recall: of those
      that at least ``min_cameras`` cameras see; thin recall: of those that are thin and, if
      known, visible;
    - F1: harmonic mean of the two, 0 if both are 0;
    - normals: over all evaluated samples of either side, at any distance, if both the sample and
      its nearest counterpart have a normal; 0 without such pairs;
    - an empty prediction, or one outside the crop, has precision, recall, F1 and normal scores of
      0 and infinite distances if there is nothing to measure from or to. No figure is NaN.

    Parameters
    ----------
    predicted : SurfaceSamples
        In the truth's frame, like the mesh.
    predicted_mesh : (vertices, faces) or None
        Given for the uniform protocol; ``None`` for scan and legacy, which evaluate a cloud.
    truth : Truth
    thresholds : sequence of float
        Distances > 0 in the truth's frame.
    reached : SurfaceSamples, optional
        A denser set from which ``predicted`` was evenly subsampled.
    min_cameras : int
        Not used where ``truth.seen`` is boolean.
    threads : int
        Threads of the search in clouds; the result does not depend on it.

    Raises
    ------
    UsageError
        A threshold is not a positive number, or no true sample is inside the crop.
    """
    limits = _checked(thresholds)
    judged = truth.judged()
    if not judged.any():
        raise UsageError("No true sample lies inside the crop.", "Check the crop's frame.")
    inside = np.ones(len(predicted), np.bool_)
    if truth.crop is not None and len(predicted):
        inside = truth.crop.inside(predicted.points)
    true, shown = truth.samples.kept(judged), predicted.kept(inside)

    accuracy, there = _nearest(shown, truth.mesh, truth.samples, threads)
    if len(shown):
        cloud = predicted if reached is None else reached
        completeness, back = _nearest(true, predicted_mesh, cloud, threads)
    else:
        completeness, back = np.full(len(true), np.inf), np.zeros((len(true), 3))
    visible = truth.visible(min_cameras)[judged]
    thin = np.zeros(len(true), np.bool_) if truth.thin is None else truth.thin[judged] & visible
    precision, recall = _shares(accuracy, limits), _shares(completeness, limits)
    knows_seen = truth.seen is not None and bool(visible.any())
    cosines = (shown.normals * there).sum(1), (true.normals * back).sum(1)
    known = (
        shown.normals.any(1) & there.any(1),
        true.normals.any(1) & back.any(1),
    )
    pairs = [cosine[mask] for cosine, mask in zip(cosines, known, strict=True)]
    means = _mean(accuracy), _mean(completeness)
    medians = _median(accuracy), _median(completeness)
    return SurfaceScore(
        thresholds=limits,
        precision=precision,
        recall=recall,
        f1=tuple(_f1(p, r) for p, r in zip(precision, recall, strict=True)),
        visible_recall=_shares(completeness[visible], limits) if knows_seen else None,
        thin_recall=_shares(completeness[thin], limits) if thin.any() else None,
        accuracy_mean=means[0],
        accuracy_median=medians[0],
        completeness_mean=means[1],
        completeness_median=medians[1],
        chamfer_mean=(means[0] + means[1]) / 2,
        chamfer_median=(medians[0] + medians[1]) / 2,
        normal_consistency=_symmetric_mean([np.abs(values) for values in pairs]),
        normal_agreement=_symmetric_mean([(values > 0).astype(np.float64) for values in pairs]),
        predicted_count=len(shown),
        truth_count=len(true),
        visible_count=int(visible.sum()) if knows_seen else 0,
        thin_count=int(thin.sum()),
    )


def score_protocols(
    vertices: np.ndarray,
    faces: np.ndarray,
    truth: Truth,
    cameras: Sequence[Camera],
    thresholds: Sequence[float],
    *,
    count: int = 200_000,
    seed: int = 0,
    threads: int = 1,
    protocols: Sequence[str] = PROTOCOLS,
    step_px: float | None = None,
    min_cameras: int = MIN_CAMERAS,
) -> dict[str, SurfaceScore]:
    """Score a mesh by several protocols (docs/method.md, section 9.1).

    - ``uniform``: ``count`` samples uniform over the mesh; recall is measured against the mesh
      itself, so it does not depend on their density. Inner sides and hidden parts count.
    - ``scan``: the surface seen by the cameras, downsampled to one point per voxel of half the
      smallest threshold, so that parts near many cameras do not weigh more. Recall is measured
      against all points seen, and only over the true samples that at least ``min_cameras``
      cameras see (all, if unknown), because a scan cannot reach others. Hidden parts do not count
      on either side. The distance between neighbouring points of the scan must be well below the
      thresholds.
    - ``legacy``: vertices and face centres; recall is measured against these points. Biased by
      tessellation: only for comparison with older figures.

    Parameters
    ----------
    vertices, faces : (v, 3), (f, 3)
        The mesh in the truth's frame, possibly empty.
    truth : Truth
    cameras : sequence of Camera
        In the truth's frame; only used by ``scan``.
    thresholds : sequence of float
        Distances > 0.
    count, seed
        See :func:`~.samples.sample_uniformly`.
    threads : int
        Threads to use, 0 for every core; the result does not depend on it. Distances to meshes
        always use every core (see :func:`~...mesh.distance.distances_to_mesh`).
    protocols : sequence of str
        Elements of :data:`PROTOCOLS`.
    step_px : float, optional
        See :func:`~.samples.scan_virtually`; by default the smallest with at most
        :data:`SCAN_RAYS` rays in total.

    Returns
    -------
    dict of str to SurfaceScore
        By protocol, in the given order.

    Raises
    ------
    UsageError
        An unknown protocol, a scan without cameras or without a visible true sample, or as in
        :func:`score_surface`.
    MeshingError
        A vertex is not finite.
    """
    limits = _checked(thresholds)
    threads = threads or default_threads()
    result: dict[str, SurfaceScore] = {}
    for protocol in protocols:
        judged, mesh, reached = truth, None, None
        if protocol == "uniform":
            predicted, mesh = _uniform(vertices, faces, count, seed), (vertices, faces)
        elif protocol == "scan":
            if len(cameras) == 0:
                raise UsageError("A virtual scan needs cameras.", "Give those of the photos.")
            visible = truth.visible(min_cameras)
            if not visible.any():
                raise UsageError(
                    f"No true sample is seen by {min_cameras} cameras.", "Require fewer cameras."
                )
            judged = truth.kept(visible)
            predicted = SurfaceSamples.empty()
            if len(faces):
                step = _scan_step(cameras) if step_px is None else step_px
                reached = scan_virtually(vertices, faces, cameras, threads=threads, step_px=step)
                predicted = choose_per_cell(reached, min(limits) / 2)
        elif protocol == "legacy":
            predicted = sample_legacy(vertices, faces) if len(faces) else SurfaceSamples.empty()
        else:
            raise UsageError(f"Protocol {protocol!r} is unknown.", f"Use {', '.join(PROTOCOLS)}.")
        # A mesh of degenerate faces only counts as empty.
        result[protocol] = score_surface(
            predicted, mesh if len(predicted) else None, judged, limits,
            reached=reached, min_cameras=min_cameras, threads=threads,
        )  # fmt: skip
    return result


def score_clouds(
    predicted_points: np.ndarray,
    truth_points: np.ndarray,
    threshold: float,
    *,
    voxel: float | None,
    threads: int = 1,
) -> CloudScore:
    """Compare point clouds by the protocol of Tanks and Temples, after alignment and crop.

    See docs/method.md, section 9.1.

    Parameters
    ----------
    predicted_points : (n, 3) float64
        May be empty; precision, recall and F1 are then 0.
    truth_points : (m, 3) float64
    threshold : float
        A point counts within this distance (``<=``).
    voxel : float or None
        Both clouds are first downsampled to one mean per voxel of this side; the protocol uses
        half of the threshold. ``None``: no downsampling.
    threads : int
        Threads of the search; the result does not depend on it.

    Raises
    ------
    UsageError
        The truth is empty, a value is not finite, or threshold or voxel is not positive.
    """
    (limit,) = _checked([threshold])
    clouds = []
    for name, points in (("predicted", predicted_points), ("true", truth_points)):
        points = np.asarray(points, np.float64).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise UsageError(f"The {name} cloud has a point that is not finite.", "Remove it.")
        if voxel is not None:
            points = voxel_downsample_points(points, voxel)
        clouds.append(points)
    predicted, truth = clouds
    if len(truth) == 0:
        raise UsageError("The true cloud is empty.", "Check the crop and the alignment.")
    accuracy, _ = distances_to_cloud(predicted, truth, threads=threads)
    completeness, _ = distances_to_cloud(truth, predicted, threads=threads)
    precision, recall = _shares(accuracy, (limit,))[0], _shares(completeness, (limit,))[0]
    return CloudScore(
        limit, precision, recall, _f1(precision, recall), _mean(accuracy), _mean(completeness),
        len(predicted), len(truth),
    )  # fmt: skip


def _scan_step(cameras: Sequence[Camera]) -> float:
    pixels = sum(camera.width * camera.height for camera in cameras)
    return max(1.0, math.sqrt(pixels / SCAN_RAYS))


def _uniform(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int) -> SurfaceSamples:
    if len(faces) == 0 or (
        np.isfinite(vertices[np.unique(faces)]).all() and not face_normals(vertices, faces)[1].any()
    ):
        return SurfaceSamples.empty()
    return sample_uniformly(vertices, faces, count, seed=seed)


def _nearest(
    samples: SurfaceSamples, mesh: _Mesh | None, cloud: SurfaceSamples, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (n,) to the mesh, or to the cloud without one, and normals (n, 3) there."""
    if mesh is not None:
        distances, face, _ = distances_to_mesh(samples.points, *mesh)
        if len(mesh[1]) == 0:
            return distances, np.zeros((len(samples), 3))
        met = np.asarray(mesh[1])[face]  # (n, 3), vertices of the nearest faces
        low = np.asarray(mesh[0], np.float64)
        corners = low[met]  # (n, 3, 3)
        flat = (corners - corners[:, :1]).reshape(-1, 3)
        normals, _ = face_normals(flat, np.arange(len(flat)).reshape(-1, 3))
        return distances, normals
    distances, index = distances_to_cloud(samples.points, cloud.points, threads=threads)
    if len(cloud) == 0:
        return distances, np.zeros((len(samples), 3))
    return distances, cloud.normals[index]


def _checked(thresholds: Sequence[float]) -> tuple[float, ...]:
    limits = tuple(float(value) for value in thresholds)
    if not limits or not all(math.isfinite(value) and value > 0 for value in limits):
        raise UsageError(f"Thresholds of {limits} cannot be used.", "Give lengths > 0.")
    return limits


def _shares(distances: np.ndarray, limits: tuple[float, ...]) -> Shares:
    if len(distances) == 0:
        return (0.0,) * len(limits)
    return tuple(float((distances <= limit).mean()) for limit in limits)


def _f1(precision: float, recall: float) -> float:
    total = precision + recall
    return 2.0 * precision * recall / total if total > 0 else 0.0


def _mean(distances: np.ndarray) -> float:
    return float(distances.mean()) if len(distances) else math.inf


def _median(distances: np.ndarray) -> float:
    return float(np.median(distances)) if len(distances) else math.inf


def _symmetric_mean(pairs: list[np.ndarray]) -> float:
    """Return the mean of both directions' means; of one if the other has no pair; 0 without any."""
    means = [float(values.mean()) for values in pairs if len(values)]
    return sum(means) / len(means) if means else 0.0

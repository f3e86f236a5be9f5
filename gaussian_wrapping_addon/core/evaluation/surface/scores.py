# SPDX-License-Identifier: GPL-3.0-or-later
"""How close a reconstructed surface is to the true one: F1, Chamfer, normals.

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
"""Recall of thin parts says nothing where fewer of the true samples than these are thin."""

SCAN_RAYS = 4_000_000
"""Rays of a virtual scan unless a step is given: some 400 MB of points at most."""

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
    """Recall over the true samples that cameras see; ``None`` where that is not known of any."""
    thin_recall: Shares | None
    """Recall over seen samples on thin structures; ``None`` where there are none."""
    accuracy_mean: float
    accuracy_median: float
    """Distance from the predicted samples to the truth; infinite without any."""
    completeness_mean: float
    completeness_median: float
    """Distance from the true samples to the prediction; infinite where that is empty."""
    chamfer_mean: float
    chamfer_median: float
    """Mean of accuracy and completeness (means, medians)."""
    normal_consistency: float
    """Mean absolute cosine between normals of counterparts, both directions averaged."""
    normal_agreement: float
    """Share of counterparts whose normals point to the same side, likewise."""
    predicted_count: int
    truth_count: int
    visible_count: int
    thin_count: int
    """Samples that were judged."""

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
    """Mean distances; infinite where the prediction is empty."""
    predicted_count: int
    truth_count: int
    """Points after thinning out."""

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

    The crop decides which samples are judged, on either side, never what they are measured
    against: a sample at its boundary finds its counterpart beyond. Conventions:

    - precision: share of judged predicted samples within the threshold (``<=``) of the truth's
      mesh, or of its cloud where it has no mesh;
    - recall: share of judged true samples within it of ``predicted_mesh``, or where that is
      ``None`` of the samples ``reached``, or else of those predicted; visible recall: of those
      that at least ``min_cameras`` cameras see; thin recall: of those that are thin and, where
      that is known, visible;
    - F1: harmonic mean of the two, 0 where both are 0;
    - normals: over all judged samples of either side, whatever their distance, as far as both the
      sample and its nearest counterpart have one. 0 where no pair has;
    - an empty prediction, or one outside of the crop, has precision, recall, F1 and normal scores
      of 0 and infinite distances, where there is nothing to measure from or to. No figure is NaN.

    Parameters
    ----------
    predicted : SurfaceSamples
        In the truth's frame, as is the mesh.
    predicted_mesh : (vertices, faces) or None
        Given for the uniform protocol; ``None`` for scan and legacy, which judge a cloud.
    truth : Truth
    thresholds : sequence of float
        Distances > 0 in the truth's frame.
    reached : SurfaceSamples, optional
        A denser set out of which ``predicted`` was chosen to be even.
    min_cameras : int
        Not used where ``truth.seen`` is boolean.
    threads : int
        Of the search in clouds; the result does not depend on it.

    Raises
    ------
    UsageError
        A threshold is not a positive number, or no true sample is inside of the crop.
    """
    limits = _checked(thresholds)
    judged = truth.judged()
    if not judged.any():
        raise UsageError("No true sample lies inside of the crop.", "Check the crop's frame.")
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
    """Judge a mesh by several protocols (docs/method.md, section 9.1).

    - ``uniform``: ``count`` samples spread evenly over the mesh; recall is measured against the
      mesh itself, so it does not depend on their density. Inner sides and hidden parts count.
    - ``scan``: what the cameras see of the mesh, thinned out to one point in each cell of half the
      smallest threshold, so that parts near to many cameras do not weigh more. Recall is measured
      against all that they see, and over those true samples only that at least ``min_cameras``
      cameras see (all, where that is not known), because a scan cannot reach others. Hidden parts
      do not count on either side. The distance between neighbouring points of the scan has to be
      well below the thresholds.
    - ``legacy``: vertices and centres of faces; recall is measured against these points. Biased by
      tessellation: reported to be compared with older figures only.

    Parameters
    ----------
    vertices, faces : (v, 3), (f, 3)
        The mesh in the truth's frame, possibly empty.
    truth : Truth
    cameras : sequence of Camera
        In the truth's frame; used by ``scan`` only.
    thresholds : sequence of float
        Distances > 0.
    count, seed
        See :func:`~.samples.sample_uniformly`.
    threads : int
        Threads to use, 0 for every core; the result does not depend on it. The distances to meshes
        take every core whatever is said here (see :func:`~...mesh.distance.distances_to_mesh`).
    protocols : sequence of str
        Out of :data:`PROTOCOLS`.
    step_px : float, optional
        See :func:`~.samples.scan_virtually`; the smallest with :data:`SCAN_RAYS` rays in
        all unless given.

    Returns
    -------
    dict of str to SurfaceScore
        By protocol, in the order asked for.

    Raises
    ------
    UsageError
        An unknown protocol, a scan without cameras or of which no true sample is visible, or what
        :func:`score_surface` refuses.
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
                    f"No true sample is seen by {min_cameras} cameras.", "Ask for fewer cameras."
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
        # An area that lies on nothing but degenerate faces is as empty as no faces.
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
    """Compare clouds as Tanks and Temples does, after alignment and crop.

    See docs/method.md, section 9.1.

    Parameters
    ----------
    predicted_points : (n, 3) float64
        May be empty: precision, recall and F1 are 0 then.
    truth_points : (m, 3) float64
    threshold : float
        Distance within which (``<=``) a point counts.
    voxel : float or None
        Both clouds are thinned out to one mean per cell of this side first; the protocol takes
        half of the threshold. ``None``: they are compared as they are.
    threads : int
        Of the search; the result does not depend on it.

    Raises
    ------
    UsageError
        The truth is empty, a value is not finite, or threshold or voxel are not positive.
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
    """Distances (n,) to a mesh, or to a cloud without one, and normals (n, 3) of what is there."""
    if mesh is not None:
        distances, face, _ = distances_to_mesh(samples.points, *mesh)
        if len(mesh[1]) == 0:
            return distances, np.zeros((len(samples), 3))
        met = np.asarray(mesh[1])[face]  # (n, 3), vertices of the faces that were met
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
    """Mean of the two directions' means; of one where the other has no pair; 0 without any."""
    means = [float(values.mean()) for values in pairs if len(values)]
    return sum(means) / len(means) if means else 0.0

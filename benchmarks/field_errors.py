# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors of depth and vacancy of trained Gaussians against a true surface, without meshing."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.gaussians.files import load_gaussians
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians, without_blur
from gaussian_wrapping_addon.core.mesh.depth_buffer import depth_buffer
from gaussian_wrapping_addon.core.parallel import default_threads
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.settings import MeshingSettings, TrainingSettings


def field_gaussians(path: Path) -> OrientedGaussians:
    """Read trained Gaussians as fields take them by default (docs/method.md, section 5.7)."""
    variances = MeshingSettings.blur_variance, TrainingSettings.filter_variance
    return without_blur(load_gaussians(path), *variances)


PROBE_REACH = 2.0
"""Vacancy is sampled along each normal over this many largest thresholds to both sides."""
PROBES_PER_SIDE = 40


@dataclass(frozen=True)
class DepthErrors:
    """Depths against those of the true surface, over the pixels that show it."""

    pixels: int
    """Pixels whose ray meets the true surface."""
    found: float
    """Share of them that have a depth."""
    median: float
    """Median absolute difference along the ray where found, scene units."""
    percentile_95: float
    within: tuple[float, ...]
    """Share of all these pixels with a depth within each threshold."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class VacancyErrors:
    """Crossings of vacancy 0.5 along the normals of the true surface."""

    samples: int
    found: float
    """Share of samples with a crossing (empty outside, occupied inside) in the sampled range."""
    median_offset: float
    """Median signed offset of the nearest crossing, positive outside, scene units."""
    median: float
    """Median absolute offset."""
    within: tuple[float, ...]
    """Share of all samples with a crossing within each threshold."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return dataclasses.asdict(self)


def depth_errors(
    depths: Iterable[tuple[Camera, np.ndarray]],
    vertices: np.ndarray,
    faces: np.ndarray,
    thresholds: Sequence[float],
    *,
    threads: int = 0,
) -> DepthErrors:
    """Compare depths with the first hit of each pixel's ray.

    Parameters
    ----------
    depths : iterable of (Camera, (h, w) array)
        z-depths of all pixels of a camera; 0, or not finite, where there is none.
    vertices, faces : (v, 3) float64, (f, 3) int
        The true surface in the cameras' frame. Nothing else may occlude it.
    thresholds : sequence of float
        Distances along the ray, unit of the frame.

    Raises
    ------
    UsageError
        No pixel shows the surface.
    """
    threads = threads or default_threads()
    faces = np.ascontiguousarray(faces, np.int32)
    errors, missing = [], 0
    for camera, depth in depths:
        true = depth_buffer(vertices, faces, camera, threads=threads)
        shows = np.isfinite(true.depth)  # (h, w)
        stretch = np.linalg.norm(camera.rays(), axis=2)  # (h, w) ray length of one unit of z
        found = shows & (depth > 0) & np.isfinite(depth)
        missing += int(np.count_nonzero(shows & ~found))
        errors.append(np.abs(depth[found].astype(np.float64) - true.depth[found]) * stretch[found])
    error = np.concatenate(errors) if errors else np.zeros(0)
    total = len(error) + missing
    if total == 0:
        raise UsageError("No pixel shows the true surface.", "Check its frame.")
    return DepthErrors(
        total,
        len(error) / total,
        float(np.median(error)) if len(error) else float("inf"),
        float(np.percentile(error, 95)) if len(error) else float("inf"),
        tuple(float(np.count_nonzero(error <= limit)) / total for limit in thresholds),
    )


def rendered_depths(
    gaussians: OrientedGaussians, cameras: Iterable[Camera], threads: int
) -> Iterator[tuple[Camera, np.ndarray]]:
    """Yield each camera with the depth of the 0.5-isosurface (docs/method.md, section 2.4)."""
    for camera in cameras:
        yield camera, render(gaussians, camera, RenderOptions(threads=threads)).depth.numpy()


def mesh_depths(
    vertices: np.ndarray, faces: np.ndarray, cameras: Iterable[Camera], threads: int
) -> Iterator[tuple[Camera, np.ndarray]]:
    """Yield each camera with the depth of a mesh in its frame."""
    faces = np.ascontiguousarray(faces, np.int32)
    for camera in cameras:
        yield camera, depth_buffer(vertices, faces, camera, threads=threads).depth


def vacancy_errors(
    field: VacancyField,
    points: np.ndarray,
    normals: np.ndarray,
    thresholds: Sequence[float],
) -> VacancyErrors:
    """Sample vacancy along the normals of true surface samples and find where it crosses 0.5.

    Probes are evenly spaced up to ``PROBE_REACH`` times the largest threshold to both sides; a
    crossing lies between an empty probe and the occupied one below it, by linear interpolation.
    The crossing nearest to the sample is used, so that the other side of a thin part is taken
    only if it is nearer.

    Parameters
    ----------
    field : VacancyField
    points, normals : (n, 3) float64
        Samples and unit normals (towards the empty side) of the true surface, frame of the field.
    thresholds : sequence of float
        Unit of the frame.

    Raises
    ------
    UsageError
        There is no sample.
    """
    count = len(points)
    if count == 0:
        raise UsageError("There is no sample of the true surface.", "Check the crop volume.")
    reach = PROBE_REACH * max(thresholds)
    offsets = np.linspace(reach, -reach, 2 * PROBES_PER_SIDE + 1)  # from outside to inside
    probes = points[:, None] + offsets[None, :, None] * normals[:, None]  # (n, k, 3)
    vacancy = field.vacancy(probes.reshape(-1, 3)).vacancy.reshape(count, -1).astype(np.float64)
    outer, inner = vacancy[:, :-1], vacancy[:, 1:]  # (n, k - 1)
    crosses = (outer > 0.5) & (inner <= 0.5)
    share = np.where(crosses, (outer - 0.5) / np.where(crosses, outer - inner, 1.0), 0.0)
    crossing = offsets[:-1] + share * (offsets[1:] - offsets[:-1])  # (n, k - 1)
    distance = np.where(crosses, np.abs(crossing), np.inf)
    nearest = distance.argmin(1)
    rows = np.arange(count)
    least = distance[rows, nearest]
    found = np.isfinite(least)
    signed = crossing[rows, nearest][found]
    return VacancyErrors(
        count,
        float(found.mean()),
        float(np.median(signed)) if len(signed) else float("inf"),
        float(np.median(np.abs(signed))) if len(signed) else float("inf"),
        tuple(float((least <= limit).mean()) for limit in thresholds),
    )

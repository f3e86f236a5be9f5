# SPDX-License-Identifier: GPL-3.0-or-later
"""Samples of the true surface: where, which way, how thin, and by how many cameras seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.regions.convex_region import Region

from .visibility import START_SHARE, RayScene, count_views

SAMPLES = 200_000


@dataclass(frozen=True)
class TruthSamples:
    """Samples of the true surface inside of the crop, uniform by area."""

    points: np.ndarray
    """(n, 3) float64."""
    normals: np.ndarray
    """(n, 3) float64, unit, of the face that the sample lies on, outward."""
    thin: np.ndarray
    """(n,) bool: the solid below the sample is thinner than the scene's bound."""
    seen: np.ndarray
    """(n,) int32: number of cameras that see it."""


def sample_surface(
    vertices: np.ndarray, faces: np.ndarray, crop: Region, count: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return about ``count`` points (n, 3) and unit normals (n, 3), uniform by area in the crop.

    Stratified along the list of faces: every face gets its share of samples, to within one.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1) / 2  # (f,)
    # Faces outside of the crop take samples too: draw so many that the wanted number remains.
    trial = _draw(a, b, c, area, 20_000, random)[0]
    share = float(crop.contains(trial).mean())
    points, owner = _draw(a, b, c, area, int(np.ceil(count / max(share, 1e-3))), random)
    kept = crop.contains(points)
    normals = cross / np.maximum(2 * area, 1e-300)[:, None]
    return points[kept], normals[owner[kept]]


def _draw(
    a: np.ndarray,
    b: np.ndarray,
    c: np.ndarray,
    area: np.ndarray,
    count: int,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    place = (np.arange(count) + random.random(count)) / count * area.sum()
    owner = np.minimum(np.searchsorted(np.cumsum(area), place, side="right"), len(area) - 1)
    u, v = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1 - u, u * (1 - v), u * v], 1)  # (n, 3) barycentric
    corners = np.stack([a[owner], b[owner], c[owner]], 1)  # (n, 3, 3)
    return np.einsum("nk,nkd->nd", weights, corners), owner


def inward_thickness(
    vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Return the way from each sample straight into the solid to its other side, (n,)."""
    rays = RayScene(vertices, faces)
    start = START_SHARE * rays.diagonal
    distance, _ = rays.first_hits(points - start * normals, -normals)
    return distance + start


def truth_samples(
    truth: tuple[np.ndarray, np.ndarray],
    everything: tuple[np.ndarray, np.ndarray],
    cameras: Sequence[Camera],
    crop: Region,
    thin_below: float,
    seed: int,
    count: int = SAMPLES,
) -> TruthSamples:
    """Sample the true surface and label the samples.

    Parameters
    ----------
    truth, everything : (vertices, faces)
        The true surface; all geometry of the scene, which hides things from cameras.
    thin_below : float
        Inward thickness under which a sample is thin, units of the world.
    """
    points, normals = sample_surface(*truth, crop, count, np.random.default_rng([seed, 1]))
    seen = count_views(RayScene(*everything), cameras, points, normals)
    thin = inward_thickness(*truth, points, normals) < thin_below
    return TruthSamples(points, normals, thin, seen)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Ambient occlusion map of the dense mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...mesh.surface_mesh import SurfaceMesh
from ...mesh.tangent_frame import shading_normals
from ...progress import Progress
from ..atlas.atlas_raster import AtlasRaster
from ..atlas.texel_points import texel_points
from ..bake.fill import dilate
from .dense_surface import BLOCK, NO_HIT, DenseSurface, SurfaceCorrespondences, cage_distance

MAX_SIDE_PX = 1024
"""Occlusion varies slowly, and each texel costs :data:`RAYS` rays."""
RAYS = 16
"""The noise of a half-open texel is about 6 %; :func:`smoothed` leaves less than 2 % of it."""
SMOOTHING_RADIUS = 2
"""Texels on each side that are averaged, as far as they lie on the same piece of surface."""
SMOOTHING_SIGMA = 1.5
MAX_DIFFERENCE = 0.3
SAME_PLANE_COSINE = 0.95
"""Texels whose normals differ by more are not averaged: edges and creases stay."""
OFF_PLANE_TEXELS = 0.5
"""Nor are those that lie further off the tangent plane, in steps between texels."""
REACH_SHARE = 0.1
"""Share of the mesh's diagonal: surfaces farther away do not occlude."""
LIFT_SHARE = 1e-6
"""Share of the mesh's diagonal: height of the ray origins above the surface."""
GOLDEN = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the R2 low-discrepancy sequence: powers of 1 / x with x^3 = x + 1."""


@dataclass(frozen=True)
class OcclusionMap:
    """Occlusion map and its statistics."""

    image: np.ndarray
    """(k, k) uint8, 255 if unoccluded."""
    statistics: dict[str, Any]
    """Size, rays per texel, maximum distance in scene units, mean."""


def bake_occlusion(
    light: SurfaceMesh,
    raster: AtlasRaster,
    dense: DenseSurface,
    gutter_px: int,
    progress: Progress,
) -> OcclusionMap:
    """Bake the occlusion of the dense mesh at points that correspond to texels of the light one.

    Parameters
    ----------
    light : SurfaceMesh
        The mesh that uses the map.
    raster : AtlasRaster
        Raster of its UVs at the size of the map (sensibly at most :data:`MAX_SIDE_PX`).
    dense : DenseSurface
        In the same units; the light mesh itself without another one.
    gutter_px : int
        Width by which charts are dilated.
    """
    size = raster.face.shape[0]
    cage = cage_distance(light, DenseSurface(light), dense)
    reach = REACH_SHARE * dense.size
    normals = shading_normals(light.vertices, light.faces)
    texels = np.flatnonzero(raster.face.ravel() >= 0)
    open_share = np.ones(len(texels), np.float32)
    points, directions = (np.zeros((len(texels), 3)) for _ in range(2))
    block = max(1, BLOCK // RAYS)
    for begin in range(0, len(texels), block):
        progress.update(0.9 * begin / len(texels), "ambient occlusion: casting rays")
        part = texels[begin : begin + block]
        at = texel_points(light, raster, part, normals)
        matches = dense.correspondences(at.points, at.normals, cage)
        found = matches.method != NO_HIT
        rows = SurfaceCorrespondences(
            matches.face[found], matches.weights[found], matches.method[found]
        )
        block_rows = begin + np.flatnonzero(found)
        open_share[block_rows] = sky_visibility(dense, rows, reach, part[found])
        points[begin : begin + block] = at.points
        directions[begin : begin + block] = at.normals
    progress.update(0.9, "ambient occlusion: removing noise")
    open_share = smoothed(open_share, points, directions, texels, size)
    values = np.full((size, size), 255, np.uint8)
    values.ravel()[texels] = np.rint(255.0 * open_share).astype(np.uint8)
    image = np.repeat(values[..., None], 3, axis=2)
    owned = raster.face >= 0
    ring, chart = np.where(owned, 0, -1).astype(np.int16), np.where(owned, 0, -1).astype(np.int32)
    dilate(image, ring, chart, gutter_px, inside=False)
    progress.update(1.0, "ambient occlusion: finished")
    mean = float(values.ravel()[texels].mean() / 255.0) if len(texels) else 1.0
    statistics = {"size_px": size, "rays": RAYS, "reach_scene": reach, "open_share": mean}
    return OcclusionMap(np.ascontiguousarray(image[..., 0]), statistics)


def smoothed(
    values: np.ndarray, points: np.ndarray, normals: np.ndarray, texels: np.ndarray, size: int
) -> np.ndarray:
    """Average the values of texels over their neighbours on the same piece of surface.

    Parameters
    ----------
    values : (n,) float32
    points, normals : (n, 3) float64
        Surface points and unit normals of the texels.
    texels : (n,) int64
        Flat indices in an atlas of side ``size``, in ascending order.

    Returns
    -------
    (n,) float32
    """
    number = np.full((size + 2 * SMOOTHING_RADIUS,) * 2, -1, np.int64)
    inner = slice(SMOOTHING_RADIUS, SMOOTHING_RADIUS + size)
    grid = np.full(size * size, -1, np.int64)
    grid[texels] = np.arange(len(texels))
    number[inner, inner] = grid.reshape(size, size)
    row, column = texels // size + SMOOTHING_RADIUS, texels % size + SMOOTHING_RADIUS
    total, weight = values.astype(np.float64), np.ones(len(values))
    steps = range(-SMOOTHING_RADIUS, SMOOTHING_RADIUS + 1)
    spacing = _spacing(points, number, row, column)
    for dy, dx in ((dy, dx) for dy in steps for dx in steps if (dy, dx) != (0, 0)):
        other = number[row + dy, column + dx]
        mine = np.flatnonzero(other >= 0)
        other = other[mine]
        offset = points[other] - points[mine]
        reach = spacing[mine] * (np.hypot(dx, dy) + 1.0)
        flat = np.abs((offset * normals[mine]).sum(axis=1)) < OFF_PLANE_TEXELS * spacing[mine]
        near = (offset**2).sum(axis=1) < reach**2  # another chart lies elsewhere
        same = (normals[other] * normals[mine]).sum(axis=1) > SAME_PLANE_COSINE
        # What differs by more than the noise is an edge of a shadow.
        alike = np.abs(values[other] - values[mine]) < MAX_DIFFERENCE
        chosen = flat & near & same & alike
        share = math.exp(-0.5 * (dx * dx + dy * dy) / SMOOTHING_SIGMA**2)
        total[mine[chosen]] += share * values[other[chosen]]
        weight[mine[chosen]] += share
    averaged: np.ndarray = (total / weight).astype(np.float32)
    return averaged


def _spacing(
    points: np.ndarray, number: np.ndarray, row: np.ndarray, column: np.ndarray
) -> np.ndarray:
    """Return (n,) distances of texels to the nearest of their four neighbours."""
    best = np.full(len(points), np.inf)
    for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        other = number[row + dy, column + dx]
        mine = np.flatnonzero(other >= 0)
        length = np.linalg.norm(points[other[mine]] - points[mine], axis=1)
        best[mine] = np.minimum(best[mine], length)
    return np.where(np.isfinite(best), best, 0.0)


def sky_visibility(
    surface: DenseSurface,
    matches: SurfaceCorrespondences,
    reach: float,
    numbers: np.ndarray,
    rays: int = RAYS,
) -> np.ndarray:
    """Return the share of light from a uniform sky that reaches points of a mesh.

    Parameters
    ----------
    matches : SurfaceCorrespondences
        Points, each on a face.
    reach : float
        Only surfaces nearer than this occlude the sky.
    numbers : (n,) int64
        Offset the fixed ray pattern of each point, so that errors of neighbours are uncorrelated.
    rays : int
        Rays from each point.

    Returns
    -------
    (n,) float64
        1 if unoccluded, weighted by the cosine to the face normal.
    """
    normals = surface.face_normals[matches.face]
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    sign = np.where(normals[:, 2] < 0.0, -1.0, 1.0)
    # Two axes orthogonal to each normal, without a special case (Duff and others, 2017).
    scale = -1.0 / (sign + normals[:, 2])
    mixed = normals[:, 0] * normals[:, 1] * scale
    one = np.stack(
        [1.0 + sign * normals[:, 0] ** 2 * scale, sign * mixed, -sign * normals[:, 0]], axis=1
    )
    other = np.stack([mixed, sign + normals[:, 1] ** 2 * scale, -normals[:, 1]], axis=1)
    turn = (np.asarray(numbers, np.int64)[:, None] % 65_521) * GOLDEN  # (n, 2)
    number = (np.arange(rays)[:, None] + 0.5) * np.array([1.0 / rays, GOLDEN[0]])
    share = (number[None] + turn[:, None]) % 1.0  # (n, rays, 2)
    # Uniform on the disc is cosine-weighted on the hemisphere.
    radius, angle = np.sqrt(share[..., 0]), 2.0 * np.pi * share[..., 1]
    height = np.sqrt(1.0 - share[..., 0])
    directions = (
        (radius * np.cos(angle))[..., None] * one[:, None]
        + (radius * np.sin(angle))[..., None] * other[:, None]
        + height[..., None] * normals[:, None]
    )  # (n, rays, 3)
    origins = surface.points(matches) + LIFT_SHARE * surface.size * normals
    origins = np.repeat(origins, rays, axis=0)
    hit = surface.is_hit(origins, directions.reshape(-1, 3), reach)
    return 1.0 - hit.reshape(-1, rays).mean(axis=1)

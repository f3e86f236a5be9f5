# SPDX-License-Identifier: GPL-3.0-or-later
"""Ambient occlusion of the dense mesh: how much of the sky above it each texel sees."""

from __future__ import annotations

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
RAYS = 64
"""Steps of 1.6 %; the noise of a half-open texel is about 2 %."""
REACH_SHARE = 0.1
"""Of the mesh's diagonal: what is further away than this hides nothing."""
LIFT_SHARE = 1e-6
"""Of the mesh's diagonal: rays begin this far above the surface."""
GOLDEN = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the plane's most even sequence: powers of the root of x^3 = x + 1."""


@dataclass(frozen=True)
class OcclusionMap:
    """The image and how it was made."""

    image: np.ndarray
    """(k, k) uint8, 255 where open."""
    statistics: dict[str, Any]
    """Size, rays a texel, reach in scene units, mean."""


def bake_occlusion(
    light: SurfaceMesh,
    raster: AtlasRaster,
    dense: DenseSurface,
    gutter_px: int,
    progress: Progress,
) -> OcclusionMap:
    """Look around at what of the dense mesh each texel of the light one stands for.

    Parameters
    ----------
    light : SurfaceMesh
        The mesh that will carry the map.
    raster : AtlasRaster
        Of its UVs, at the map's size (:data:`MAX_SIDE_PX` at most is sensible).
    dense : DenseSurface
        Same units; the light mesh's own surface where there is no other.
    gutter_px : int
        How far charts are continued outwards.
    """
    size = raster.face.shape[0]
    cage = cage_distance(light, DenseSurface(light), dense)
    reach = REACH_SHARE * dense.size
    normals = shading_normals(light.vertices, light.faces)
    values = np.full((size, size), 255, np.uint8)
    texels = np.flatnonzero(raster.face.ravel() >= 0)
    block = max(1, BLOCK // RAYS)
    for begin in range(0, len(texels), block):
        progress.update(begin / len(texels), "ambient occlusion: looking around")
        part = texels[begin : begin + block]
        at = texel_points(light, raster, part, normals)
        matches = dense.correspondences(at.points, at.normals, cage)
        found = matches.method != NO_HIT
        rows = SurfaceCorrespondences(
            matches.face[found], matches.weights[found], matches.method[found]
        )
        seen = sky_visibility(dense, rows, reach, part[found])
        values.ravel()[part[found]] = np.rint(255.0 * seen).astype(np.uint8)
    image = np.repeat(values[..., None], 3, axis=2)
    owned = raster.face >= 0
    ring, chart = np.where(owned, 0, -1).astype(np.int16), np.where(owned, 0, -1).astype(np.int32)
    dilate(image, ring, chart, gutter_px, inside=False)
    progress.update(1.0, "ambient occlusion: finished")
    mean = float(values.ravel()[texels].mean() / 255.0) if len(texels) else 1.0
    statistics = {"size_px": size, "rays": RAYS, "reach_scene": reach, "open_share": mean}
    return OcclusionMap(np.ascontiguousarray(image[..., 0]), statistics)


def sky_visibility(
    surface: DenseSurface, matches: SurfaceCorrespondences, reach: float, numbers: np.ndarray
) -> np.ndarray:
    """Return which share of the light of an even sky reaches points of a mesh.

    Parameters
    ----------
    places : Places
        Points, each on a face.
    reach : float
        Only what is nearer than this hides the sky.
    numbers : (n,) int64
        Turn each point's fixed pattern of rays, so that neighbours do not err alike.

    Returns
    -------
    (n,) float64
        1 where nothing is in the way, weighted by the cosine to the face's normal.
    """
    normals = surface.face_normals[matches.face]
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    sign = np.where(normals[:, 2] < 0.0, -1.0, 1.0)
    # Two axes beside each normal, without a special case (Duff and others, 2017).
    scale = -1.0 / (sign + normals[:, 2])
    mixed = normals[:, 0] * normals[:, 1] * scale
    one = np.stack(
        [1.0 + sign * normals[:, 0] ** 2 * scale, sign * mixed, -sign * normals[:, 0]], axis=1
    )
    other = np.stack([mixed, sign + normals[:, 1] ** 2 * scale, -normals[:, 1]], axis=1)
    turn = (np.asarray(numbers, np.int64)[:, None] % 65_521) * GOLDEN  # (n, 2)
    number = (np.arange(RAYS)[:, None] + 0.5) * np.array([1.0 / RAYS, GOLDEN[0]])
    share = (number[None] + turn[:, None]) % 1.0  # (n, rays, 2)
    # Even on the disc below is cosine-weighted on the half sphere above.
    radius, angle = np.sqrt(share[..., 0]), 2.0 * np.pi * share[..., 1]
    height = np.sqrt(1.0 - share[..., 0])
    directions = (
        (radius * np.cos(angle))[..., None] * one[:, None]
        + (radius * np.sin(angle))[..., None] * other[:, None]
        + height[..., None] * normals[:, None]
    )  # (n, rays, 3)
    origins = surface.points(matches) + LIFT_SHARE * surface.size * normals
    origins = np.repeat(origins, RAYS, axis=0)
    hit = surface.is_hit(origins, directions.reshape(-1, 3), reach)
    return 1.0 - hit.reshape(-1, RAYS).mean(axis=1)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Texture stretch of an unwrap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import MeshingError

COLLAPSED_UV_AREA = 1e-14
"""Faces with less area in UVs (a hundredth of a texel is 1e-10 at 8192) have no measurable
direction; the unwrap collapses flat ones to a point."""


@dataclass(frozen=True)
class Stretch:
    """L2 texture stretch: 1 if a texel covers as much surface as on average, in all directions.

    Root mean square over directions of the distance on the surface per unit step in the texture.
    """

    mean: float
    """Mean over the surface."""
    p95: float
    """95th percentile over the surface."""
    collapsed_share: float
    """Share of the surface that has no area in the texture."""


def texture_stretch(vertices: np.ndarray, faces: np.ndarray, corner_uvs: np.ndarray) -> Stretch:
    """Measure the stretch of each face, weighted by its area (Sander and others, 2001).

    Parameters
    ----------
    vertices : (v, 3) float64
    faces : (f, 3) int32
    corner_uvs : (f, 3, 2) float32

    Raises
    ------
    MeshingError
        No face has an area in the texture.
    """
    corners = np.asarray(vertices, np.float64)[faces]  # (f, 3, 3)
    uvs = np.asarray(corner_uvs, np.float64)
    edge_one, edge_two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    uv_one, uv_two = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    areas = 0.5 * np.linalg.norm(np.cross(edge_one, edge_two), axis=1)
    double = uv_one[:, 0] * uv_two[:, 1] - uv_one[:, 1] * uv_two[:, 0]
    spread = 0.5 * np.abs(double) > COLLAPSED_UV_AREA
    total = float(areas.sum())
    if not spread.any():
        raise MeshingError("No face has an area in the texture.", "Mesh the region again.")
    inverse = 1.0 / double[spread, None]
    one, two = uv_one[spread], uv_two[spread]
    along_u = (edge_one[spread] * two[:, 1:] - edge_two[spread] * one[:, 1:]) * inverse
    along_v = (edge_two[spread] * one[:, :1] - edge_one[spread] * two[:, :1]) * inverse
    length = np.sqrt(0.5 * ((along_u**2).sum(axis=1) + (along_v**2).sum(axis=1)))
    weight = areas[spread]
    scale = np.sqrt(weight.sum() / (0.5 * np.abs(double[spread])).sum())
    stretch = length / scale
    order = np.argsort(stretch)
    running = np.cumsum(weight[order])
    at = int(np.searchsorted(running, 0.95 * running[-1]))
    return Stretch(
        float((weight * stretch).sum() / weight.sum()),
        float(stretch[order[min(at, len(order) - 1)]]),
        1.0 - float(weight.sum()) / total,
    )

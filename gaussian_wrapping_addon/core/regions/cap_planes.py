# SPDX-License-Identifier: GPL-3.0-or-later
"""Find the vertices on the boundary planes of a region, so that later steps keep them there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .convex_region import Region

ON_PLANE_SHARE = 1e-9
"""Tolerance for a vertex on a face's plane, in diagonals of the region: caps are made on the planes
up to rounding."""

MAX_PLANES = 3


@dataclass(frozen=True)
class CapPlanes:
    """Planes of a region's boundary, in the caller's coordinates, and the vertices on them."""

    normals: np.ndarray
    """(k, 3) float64, outward."""
    offsets: np.ndarray
    """(k,) float64: inside is ``normals @ x <= offsets``."""
    planes: np.ndarray
    """(v, 3) int64: planes that each vertex lies on, -1 for none."""
    fixed: np.ndarray
    """(v,) bool: vertices on more than three planes, which cannot move."""


def cap_planes(vertices: np.ndarray, region: Region | None) -> CapPlanes:
    """Find the vertices on the faces of a region; without a region there are none."""
    count = len(vertices)
    planes = np.full((count, MAX_PLANES), -1, np.int64)
    fixed = np.zeros(count, np.bool_)
    if region is None:
        return CapPlanes(np.zeros((0, 3)), np.zeros(0), planes, fixed)
    normals, offsets = region.half_spaces
    local = vertices - region.center  # (v, 3)
    found = np.zeros(count, np.int64)
    for number, (normal, offset) in enumerate(zip(normals, offsets, strict=True)):
        on_it = np.flatnonzero(np.abs(local @ normal - offset) <= ON_PLANE_SHARE * region.diagonal)
        room = found[on_it] < MAX_PLANES
        planes[on_it[room], found[on_it[room]]] = number
        fixed[on_it[~room]] = True
        found[on_it] += 1
    return CapPlanes(normals, offsets + normals @ region.center, planes, fixed)

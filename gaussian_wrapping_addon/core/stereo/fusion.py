# SPDX-License-Identifier: GPL-3.0-or-later
"""Points with normals, colours and sizes from depth maps (docs/method.md, section 11.7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .depth_maps import DepthMap

LIKE_NORMAL = 0.7
"""Least cosine between the normals of pixels of one surface."""

OUTLIER_SIGMAS = 1.5
"""Pixels farther from the mean along the normal are left out of the second mean."""

_CELL_RANGE = (0.5, 64.0)
"""Size of a cell over the footprint of a pixel, between which the wanted number is looked for."""

_BISECTIONS = 9


@dataclass(frozen=True)
class DensePoints:
    """Points on surfaces, scene frame."""

    positions: np.ndarray  # (n, 3) float64
    normals: np.ndarray  # (n, 3) float64 unit, towards the cameras
    colors: np.ndarray  # (n, 3) uint8
    sizes: np.ndarray  # (n,) float64, side of the cell that a point stands for
    confidences: np.ndarray  # (n,) float32 in [0, 1]

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, chosen: np.ndarray) -> DensePoints:
        """Return the points of an index or mask array."""
        return DensePoints(
            self.positions[chosen], self.normals[chosen], self.colors[chosen],
            self.sizes[chosen], self.confidences[chosen],
        )  # fmt: skip


def fuse(depth_maps: Sequence[DepthMap], wanted: int) -> DensePoints:
    """Fuse depth maps into about ``wanted`` points.

    One point for each cell of an octree whose level follows the footprint of a pixel, so that
    points are even in the resolution of the photos, not in space. The most confident pixel of a
    cell leads; its place along its normal is the trimmed mean of the cell's pixels of like normal.

    Parameters
    ----------
    depth_maps : sequence of DepthMap
    wanted : int
        Number of points, within some per cent; fewer where there are fewer pixels.

    Returns
    -------
    DensePoints
    """
    return merged(lifted(depth_maps, [m.confidence for m in depth_maps]), wanted)


def merged(pixels: DensePoints, wanted: int) -> DensePoints:
    """Merge points of a pixel each into about ``wanted`` ones (:func:`fuse`)."""
    if len(pixels) == 0:
        return pixels
    size = _cell_size(pixels, wanted)
    cell = np.unique(_cells(pixels, size), return_inverse=True)[1]
    order = np.lexsort((-pixels.confidences, cell))
    first = order[np.unique(cell[order], return_index=True)[1]]  # (m,) most confident of each cell
    lead = first[cell]  # (n,)
    leading = pixels.normals[lead]
    offset = ((pixels.positions - pixels.positions[lead]) * leading).sum(1)
    weight = pixels.confidences * ((pixels.normals * leading).sum(1) > LIKE_NORMAL)
    for _ in range(2):
        total = np.bincount(cell, weight)
        mean = np.bincount(cell, weight * offset) / total
        deviation = offset - mean[cell]
        spread = np.sqrt(np.bincount(cell, weight * deviation**2) / total)
        kept = np.abs(deviation) <= OUTLIER_SIGMAS * spread[cell] + 1e-12
        trimmed = np.where(kept, weight, 0.0)
        # A cell of two pixels can lose both to rounding.
        weight = np.where(np.bincount(cell, trimmed)[cell] > 0, trimmed, weight)
    found = pixels.select(first)
    return DensePoints(
        found.positions + mean[:, None] * found.normals,
        found.normals,
        found.colors,
        found.sizes * size,
        found.confidences,
    )


def lifted(depth_maps: Sequence[DepthMap], weights: Sequence[np.ndarray]) -> DensePoints:
    """Return the pixels of positive weight as points; their size is the footprint of a pixel.

    Parameters
    ----------
    weights : sequence of (h, w) float32
        Become confidences.
    """
    parts = []
    for depth_map, weight in zip(depth_maps, weights, strict=True):
        camera, good = depth_map.camera, weight > 0
        depth = depth_map.depth[good].astype(np.float64)
        points = camera.rays()[good] * depth[:, None] - camera.cam_from_world[:, 3]
        parts.append(
            DensePoints(
                points @ camera.rotation,
                depth_map.normal[good].astype(np.float64),
                depth_map.color[good],
                depth / camera.fx,
                weight[good],
            )
        )
    if not parts:
        none = np.zeros((0, 3))
        return DensePoints(none, none, none.astype(np.uint8), np.zeros(0), np.zeros(0, np.float32))
    return DensePoints(
        *(np.concatenate(arrays) for arrays in zip(*(vars(p).values() for p in parts), strict=True))
    )


def _cell_size(pixels: DensePoints, wanted: int) -> float:
    """Return the size of a cell, in footprints, that gives about ``wanted`` cells."""
    low, high = _CELL_RANGE
    for _ in range(_BISECTIONS):
        middle = (low * high) ** 0.5
        if len(np.unique(_cells(pixels, middle))) > wanted:
            low = middle
        else:
            high = middle
    return high


def _cells(pixels: DensePoints, size: float) -> np.ndarray:
    """Return (n,) int64 keys of the octree cells; equal for equal cells of equal level."""
    # Levels of the footprints alone, so that the number of cells follows ``size`` without steps.
    level = np.round(np.log2(pixels.sizes)).astype(np.int64)
    lowest = pixels.positions.min(0)
    side = size * 2.0 ** level[:, None]
    place = np.floor((pixels.positions - lowest) / side).astype(np.int64)
    # A hash: two cells of one key would merge, which the normals' test makes harmless.
    return ((place[:, 0] * 1000003 + place[:, 1]) * 1000003 + place[:, 2]) * 257 + level

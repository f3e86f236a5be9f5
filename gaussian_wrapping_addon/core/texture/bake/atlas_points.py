# SPDX-License-Identifier: GPL-3.0-or-later
"""Texels of one atlas that belong to a face, as surface points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..atlas.atlas_raster import AtlasRaster
from .photo_samples import SurfacePoints

BLOCK_TEXELS = 4_000_000
"""Texels processed at once: numpy widens 32-bit indices to 64 bits whenever they are used."""


@dataclass(frozen=True)
class AtlasPoints:
    """Texels with a face, in order."""

    texels: np.ndarray
    """(n,) int32 flat indices."""
    points: SurfacePoints
    chart: np.ndarray
    """(size, size) int32 chart of each texel, -1 between charts."""


def atlas_points(raster: AtlasRaster, charts: np.ndarray) -> AtlasPoints:
    """Extract the points of a raster; its face indices are replaced by charts in place.

    Parameters
    ----------
    raster : AtlasRaster
    charts : (f,) int32
        Chart of each face.
    """
    flat, bary = raster.face.reshape(-1), raster.bary.reshape(-1, 2)
    count = int(np.count_nonzero(flat >= 0))
    texels, face = np.empty(count, np.int32), np.empty(count, np.int32)
    weights = np.empty((count, 2), np.float32)
    filled = 0
    for begin in range(0, len(flat), BLOCK_TEXELS):
        block = flat[begin : begin + BLOCK_TEXELS]
        found = np.flatnonzero(block >= 0)
        rows = slice(filled, filled + len(found))
        texels[rows] = found + begin
        face[rows] = block[found]
        weights[rows] = bary[begin : begin + BLOCK_TEXELS][found]
        block[found] = charts[block[found]]
        filled += len(found)
    return AtlasPoints(texels, SurfacePoints(face, weights), raster.face)


def blocks_of(count: int) -> list[slice]:
    """Return slices of at most :data:`BLOCK_TEXELS`."""
    return [slice(b, min(b + BLOCK_TEXELS, count)) for b in range(0, count, BLOCK_TEXELS)]

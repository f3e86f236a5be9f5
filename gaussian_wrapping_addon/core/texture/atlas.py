# SPDX-License-Identifier: GPL-3.0-or-later
"""Which face owns a texel, and where the texel lies on the mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..compiled import inline, kernel
from ..mesh.surface_mesh import SurfaceMesh
from ..parallel import even_bounds, run_chunks

# -- Rasterise an atlas: the face of each texel, and the barycentric coordinates of its centre ----


TOUCH_TEXELS = 0.75
"""A texel whose centre is this close to a triangle may touch it (half diagonal 0.71)."""
BAND_ROWS = 256
"""Rows whose scratch arrays are held at once, per thread."""
STRICT_TEXELS = 0.05
"""Minimum distance to the edges at which a centre counts as inside in the overlap test."""


@dataclass(frozen=True)
class AtlasRaster:
    """Face of each texel of a square atlas; row 0 is the top (v = 1)."""

    face: np.ndarray
    """(size, size) int32, -1 without a face."""
    bary: np.ndarray
    """(size, size, 2) float32 weights of the first two corners."""
    inside: np.ndarray
    """(size, size) bool: the centre lies in the face; otherwise the face only touches the texel."""
    overlaps: int
    """Number of texels whose centre is strictly inside two or more faces."""


def texel_corners(corner_uvs: np.ndarray, size_px: int) -> np.ndarray:
    """Return (f, 3, 2) float64 positions in texels, y downwards; centres lie at + 0.5."""
    corners = np.asarray(corner_uvs, np.float64) * size_px
    corners[..., 1] = size_px - corners[..., 1]
    return corners


def raster_atlas(
    corner_uvs: np.ndarray, size_px: int, threads: int, faces: np.ndarray | None = None
) -> AtlasRaster:
    """Rasterise UV triangles: exact at centres, plus one ring of texels that are only touched.

    UVs are (f, 3, 2) in [0, 1], v upwards; ``faces``, (f,) bool, chooses those in this atlas. The
    result does not depend on the number of threads.
    """
    corners = texel_corners(corner_uvs, size_px)
    if faces is not None:
        corners[~faces] = -2.0 * size_px  # far above the first row
    face = np.full((size_px, size_px), -1, np.int32)
    bary = np.zeros((size_px, size_px, 2), np.float32)
    inside = np.zeros((size_px, size_px), np.bool_)
    bounds = even_bounds(size_px, threads, max(4, -(-size_px // (BAND_ROWS * threads))))
    overlaps: list[int] = []

    def band(begin: int, end: int) -> None:
        shape = (end - begin, size_px)
        hits = np.zeros(shape, np.uint8)
        _raster_centres(corners, begin, end, face, bary, hits)
        overlaps.append(int((hits > 1).sum()))
        touched = np.full(shape, -1, np.int32)
        distance = np.full(shape, TOUCH_TEXELS**2)
        _raster_touched(corners, begin, end, face, bary, distance, touched)
        np.greater_equal(face[begin:end], 0, out=inside[begin:end])
        np.copyto(face[begin:end], touched, where=~inside[begin:end])

    run_chunks(band, bounds, threads)
    return AtlasRaster(face, bary, inside, sum(overlaps))


@kernel(fast=False)
def _raster_centres(corners: Any, begin: int, end: int, face: Any, bary: Any, hits: Any) -> None:
    size = face.shape[1]
    for f in range(len(corners)):
        x0, y0 = corners[f, 0, 0], corners[f, 0, 1]
        x1, y1 = corners[f, 1, 0], corners[f, 1, 1]
        x2, y2 = corners[f, 2, 0], corners[f, 2, 1]
        top = max(begin, int(np.floor(min(y0, y1, y2) - 0.5)))
        bottom = min(end, int(np.ceil(max(y0, y1, y2) + 0.5)))
        if top >= bottom:
            continue
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if abs(area) < 1e-12:
            continue
        left = max(0, int(np.floor(min(x0, x1, x2) - 0.5)))
        right = min(size, int(np.ceil(max(x0, x1, x2) + 0.5)))
        # Distances to the edges are weights times heights.
        height0 = abs(area) / max(np.hypot(x2 - x1, y2 - y1), 1e-30)
        height1 = abs(area) / max(np.hypot(x0 - x2, y0 - y2), 1e-30)
        height2 = abs(area) / max(np.hypot(x1 - x0, y1 - y0), 1e-30)
        for y in range(top, bottom):
            for x in range(left, right):
                px, py = x + 0.5, y + 0.5
                w0 = ((x1 - px) * (y2 - py) - (x2 - px) * (y1 - py)) / area
                w1 = ((x2 - px) * (y0 - py) - (x0 - px) * (y2 - py)) / area
                w2 = 1.0 - w0 - w1
                if w0 < 0.0 or w1 < 0.0 or w2 < 0.0:
                    continue
                strict = min(w0 * height0, w1 * height1, w2 * height2) > STRICT_TEXELS
                if strict and hits[y - begin, x] < 255:
                    hits[y - begin, x] += 1
                if face[y, x] < 0:
                    face[y, x] = f
                    bary[y, x, 0] = w0
                    bary[y, x, 1] = w1


@inline
def _nearest_on_edge(
    px: float, py: float, ax: float, ay: float, bx: float, by: float
) -> tuple[float, float]:
    """Return the squared distance to a segment and the parameter of the nearest point."""
    dx, dy = bx - ax, by - ay
    length2 = dx * dx + dy * dy
    t = ((px - ax) * dx + (py - ay) * dy) / length2 if length2 > 0.0 else 0.0
    t = min(max(t, 0.0), 1.0)
    ex, ey = ax + t * dx - px, ay + t * dy - py
    return ex * ex + ey * ey, t


@kernel(fast=False)
def _raster_touched(
    corners: Any, begin: int, end: int, face: Any, bary: Any, distance: Any, touched: Any
) -> None:
    size = face.shape[1]
    for f in range(len(corners)):
        x0, y0 = corners[f, 0, 0], corners[f, 0, 1]
        x1, y1 = corners[f, 1, 0], corners[f, 1, 1]
        x2, y2 = corners[f, 2, 0], corners[f, 2, 1]
        top = max(begin, int(np.floor(min(y0, y1, y2) - 0.5 - TOUCH_TEXELS)))
        bottom = min(end, int(np.ceil(max(y0, y1, y2) + 0.5 + TOUCH_TEXELS)))
        if top >= bottom:
            continue
        left = max(0, int(np.floor(min(x0, x1, x2) - 0.5 - TOUCH_TEXELS)))
        right = min(size, int(np.ceil(max(x0, x1, x2) + 0.5 + TOUCH_TEXELS)))
        for y in range(top, bottom):
            for x in range(left, right):
                if face[y, x] >= 0:
                    continue
                px, py = x + 0.5, y + 0.5
                d0, t0 = _nearest_on_edge(px, py, x0, y0, x1, y1)
                d1, t1 = _nearest_on_edge(px, py, x1, y1, x2, y2)
                d2, t2 = _nearest_on_edge(px, py, x2, y2, x0, y0)
                if min(d0, d1, d2) >= distance[y - begin, x]:
                    continue
                distance[y - begin, x] = min(d0, d1, d2)
                touched[y - begin, x] = f
                if d0 <= d1 and d0 <= d2:
                    bary[y, x, 0], bary[y, x, 1] = 1.0 - t0, t0
                elif d1 <= d2:
                    bary[y, x, 0], bary[y, x, 1] = 0.0, 1.0 - t1
                else:
                    bary[y, x, 0], bary[y, x, 1] = t2, 0.0


# -- Surface points of texels ---------------------------------------------------------------------


@dataclass(frozen=True)
class TexelPoints:
    """Surface points of texels."""

    face: np.ndarray  # (n,) int32
    weights: np.ndarray  # (n, 3) float64 barycentric weights of the face's corners
    points: np.ndarray  # (n, 3) float64 positions
    raw_normals: np.ndarray  # (n, 3) float64 interpolated vertex normals, not of unit length
    normals: np.ndarray  # (n, 3) float64 the same, normalised


def texel_points(
    mesh: SurfaceMesh, raster: AtlasRaster, texels: np.ndarray, normals: np.ndarray
) -> TexelPoints:
    """Return the surface points of texels: (n,) flat indices into the raster of the mesh's UVs.

    The texels have a face; ``normals`` are those of the vertices, (v, 3).
    """
    face = raster.face.ravel()[texels]
    bary = raster.bary.reshape(-1, 2)[texels].astype(np.float64)
    weights = np.concatenate([bary, 1.0 - bary.sum(axis=1, keepdims=True)], axis=1)
    corners = np.asarray(mesh.faces)[face]  # (n, 3)
    points = np.einsum("nc,ncx->nx", weights, np.asarray(mesh.vertices, np.float64)[corners])
    raw = np.einsum("nc,ncx->nx", weights, normals[corners])
    length = np.linalg.norm(raw, axis=1, keepdims=True)
    return TexelPoints(face, weights, points, raw, raw / np.maximum(length, 1e-12))

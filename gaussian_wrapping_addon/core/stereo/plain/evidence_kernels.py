# SPDX-License-Identifier: GPL-3.0-or-later
"""Kernels that look points up in all photos."""

from __future__ import annotations

import numpy as np

from ...kernels.compiled import kernel

AGREEING, ALIKE, THROUGH, UNLIKE, NEARER = range(5)
"""Columns of what :func:`count_votes` counts."""

AGREEING_SHARE = 0.02
"""Largest relative difference of a point's depth and a photo's own, of those that agree."""

THROUGH_SHARE = 0.03
"""A known depth this much larger than a point's sees through it, one this much smaller hides it."""

ALIKE_LEVELS = 16
"""Largest difference of colours, exposure taken out, of pixels that may show one point."""

_NEAREST_Z = 1e-9


@kernel(fast=False)
def count_votes(
    points: np.ndarray, colors: np.ndarray, own: int, others: np.ndarray,
    projections: np.ndarray, sizes: np.ndarray, depths: np.ndarray, images: np.ndarray,
    agreeing_share: float, counts: np.ndarray,
) -> None:  # fmt: skip
    """Count what other photos say about points.

    Parameters
    ----------
    points : (n, 3) float64
    colors : (n, 3) uint8
        What the points look like in their own photo.
    own : int
        Number of that photo, which is left out.
    others : (m,) int64
        Photos to ask.
    projections : (photos, 3, 4) float64
        From points to pixels times depth; the first pixel's corner at 0.
    sizes : (photos, 2) int64
        Width and height.
    depths : (photos, h, w) float32
        Known depths, 0 where nothing is known.
    images : (photos, h, w, 3) uint8
        Colours, exposure taken out.
    counts : (n, 5) int32
        Added to: photos whose depth agrees; unknown depth and like colour; depth behind the point;
        unknown depth and another colour; depth before the point.
    """
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for j in range(others.shape[0]):
            v = others[j]
            if v == own:
                continue
            p = projections[v]
            depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            if depth <= _NEAREST_Z:
                continue
            u = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / depth
            w = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / depth
            if not (u >= 0.0 and w >= 0.0 and u < sizes[v, 0] and w < sizes[v, 1]):
                continue
            column, row = int(u), int(w)
            known = depths[v, row, column]
            if known > 0.0:
                if abs(known / depth - 1.0) < agreeing_share:
                    counts[i, AGREEING] += 1
                elif known > (1.0 + THROUGH_SHARE) * depth:
                    counts[i, THROUGH] += 1
                elif known < (1.0 - THROUGH_SHARE) * depth:
                    counts[i, NEARER] += 1
                continue
            alike = True
            for k in range(3):
                step = np.int32(images[v, row, column, k]) - np.int32(colors[i, k])
                if abs(step) >= ALIKE_LEVELS:
                    alike = False
            counts[i, ALIKE if alike else UNLIKE] += 1


@kernel(fast=False)
def correlate(
    points: np.ndarray, values: np.ndarray, others: np.ndarray, projections: np.ndarray,
    sizes: np.ndarray, textures: np.ndarray, limit: float,
) -> tuple[float, int]:  # fmt: skip
    """Correlate faint texture at points with that of other photos.

    Parameters
    ----------
    points : (n, 3) float64
    values : (n,) float32
        Texture of the points in their own photo.
    others : (m,) int64
    projections, sizes
        As in :func:`count_votes`.
    textures : (photos, h, w) float32
        NaN where a photo is not plain.
    limit : float32
        Values are clipped at this, so that single steps do not outweigh the rest.

    Returns
    -------
    total : float
        Sum over photos of correlation times number of points.
    count : int
        Points compared.
    """
    total, count = 0.0, 0
    for j in range(others.shape[0]):
        v = others[j]
        p = projections[v]
        ab, aa, bb, found = 0.0, 0.0, 0.0, 0
        for i in range(points.shape[0]):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            if depth <= _NEAREST_Z:
                continue
            u = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / depth - 0.5
            w = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / depth - 0.5
            if not (u >= 0.0 and w >= 0.0 and u < sizes[v, 0] - 1 and w < sizes[v, 1] - 1):
                continue
            column, row = int(u), int(w)
            s, t = u - column, w - row
            top = (1.0 - s) * textures[v, row, column] + s * textures[v, row, column + 1]
            low = (1.0 - s) * textures[v, row + 1, column] + s * textures[v, row + 1, column + 1]
            b = (1.0 - t) * top + t * low
            if not np.isfinite(b):
                continue
            a = min(max(values[i], -limit), limit)
            b = min(max(b, -limit), limit)
            ab += a * b
            aa += a * a
            bb += b * b
            found += 1
        if aa > 0.0 and bb > 0.0:
            total += found * ab / np.sqrt(aa * bb)
        count += found
    return total, count

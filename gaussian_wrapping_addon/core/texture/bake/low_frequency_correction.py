# SPDX-License-Identifier: GPL-3.0-or-later
"""Low-frequency colour correction within photos (vignetting, gradients).

Lenses darken the corners, glass reflects, the sun moves: after one gain per photo, two photos of
a wall still differ by a smooth factor, which would show as a seam wherever the best view changes.
Each photo is multiplied by a smooth field that matches it to the blend of all photos of the same
points. The photos then agree in the low band, and the best view may dominate in the high band
without a seam. The fields are fitted at surface points, so nothing is blurred across silhouettes.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from .photo_gains import BRIGHTEST, DARKEST, ROBUST_LOG

GRID = (9, 12)
"""Rows and columns of nodes over a photo: a twelfth of it is low band; smaller may be detail."""
MAX_LOG_CORRECTION = 0.4
"""A factor of 1.5 either way; more is a mismatch and not brightness."""
SMOOTHNESS = 20.0
"""Weight of the smoothness between neighbouring nodes, in points."""
PRIOR_POINTS = 2.0
"""Weight of the prior factor 1 of a node, in points."""
MIN_CORRECTION_SPREAD = 0.008
"""Fields with a smaller spread of logarithms are noise and not applied. Exact photos of a checker
gave 0.002, samples with noise of 10 % 0.004, dark corners and gradients of 8 % 0.025."""
ROUNDS = 12
MIN_VIEWS = 2


def solve_low_frequency_correction(
    colors: np.ndarray, valid: np.ndarray, image_positions: np.ndarray, gains: np.ndarray
) -> tuple[np.ndarray, float]:
    """Fit smooth factors within each photo that equalise the photos' colours of the same points.

    Robust least squares of ``log c[i, p] + log gain[p] + f[p](x[i, p]) = a[i]`` by alternation,
    with the image position ``x``; ``f`` is bilinear between the nodes of a grid, smooth, and near 0
    without data.

    Parameters
    ----------
    colors : (n, photos, 3) uint8
        Colour of point i in photo p.
    valid : (n, photos) bool
        Whether the photo sees it.
    image_positions : (n, photos, 2) float32
        Position in the photo, in shares of width and height.
    gains : (photos, 3) float64
        Gains of whole photos.

    Returns
    -------
    fields : (photos, gh, gw, 3) float64
        Factors at grid nodes, on top of the gains; all 1 (with one node) if the photos agree.
    spread : float
        Standard deviation of the log factors at the points.
    """
    photos = valid.shape[1]
    shared = np.flatnonzero(valid.sum(axis=1) >= MIN_VIEWS)
    ones = np.ones((photos, 1, 1, 3))
    if len(shared) == 0:
        return ones, 0.0
    seen = [np.flatnonzero(valid[shared, p]) for p in range(photos)]
    bases = [_basis(image_positions[shared[rows], p]) for p, rows in enumerate(seen)]
    stiffness = _stiffness()
    logs = np.zeros((photos, GRID[0] * GRID[1], 3))
    variances = []
    for channel in range(3):
        values = colors[shared, :, channel]
        usable = valid[shared] & (values >= DARKEST) & (values <= BRIGHTEST)
        target = np.log(np.maximum(values, 1).astype(np.float32))
        target += np.log(gains[:, channel]).astype(np.float32)
        logs[:, :, channel], variance = _solve(target, usable, seen, bases, stiffness)
        variances.append(variance)
    spread = float(np.sqrt(np.mean(variances)))
    if spread < MIN_CORRECTION_SPREAD:
        return ones, spread
    corrections = np.exp(np.clip(logs, -MAX_LOG_CORRECTION, MAX_LOG_CORRECTION))
    return corrections.reshape(photos, *GRID, 3), spread


def _basis(image_positions: np.ndarray) -> csr_matrix:
    """Return the (n, nodes) bilinear weights of positions in [0, 1]."""
    rows, columns = GRID
    x = image_positions[:, 0].clip(0.0, 1.0) * (columns - 1)
    y = image_positions[:, 1].clip(0.0, 1.0) * (rows - 1)
    ix = np.minimum(x.astype(np.int64), columns - 2)
    iy = np.minimum(y.astype(np.int64), rows - 2)
    tx, ty = x - ix, y - iy
    first = iy * columns + ix
    nodes = np.stack([first, first + 1, first + columns, first + columns + 1], axis=1)
    weights = np.stack([(1 - tx) * (1 - ty), tx * (1 - ty), (1 - tx) * ty, tx * ty], axis=1)
    begins = np.arange(len(image_positions) + 1) * 4
    return csr_matrix(
        (weights.ravel(), nodes.ravel(), begins), (len(image_positions), rows * columns)
    )


def _stiffness() -> np.ndarray:
    """Return the (nodes, nodes) matrix of the smoothness term and the prior."""
    rows, columns = GRID
    number = np.arange(rows * columns).reshape(rows, columns)
    pairs = np.concatenate(
        [
            np.stack([number[:, 1:].ravel(), number[:, :-1].ravel()], axis=1),
            np.stack([number[1:].ravel(), number[:-1].ravel()], axis=1),
        ]
    )
    matrix = PRIOR_POINTS * np.eye(rows * columns)
    for one, other in pairs.tolist():
        matrix[one, one] += SMOOTHNESS
        matrix[other, other] += SMOOTHNESS
        matrix[one, other] -= SMOOTHNESS
        matrix[other, one] -= SMOOTHNESS
    return matrix


def _solve(
    values: np.ndarray,
    usable: np.ndarray,
    seen: list[np.ndarray],
    bases: list[csr_matrix],
    stiffness: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Return (photos, nodes) log factors and their mean square at the points."""
    correction = np.zeros_like(values)  # (n, photos)
    weight = usable.astype(np.float32)
    nodes = np.zeros((values.shape[1], len(stiffness)))
    for _ in range(ROUNDS):
        total = np.maximum(weight.sum(axis=1), 1e-9)
        level = (weight * (values + correction)).sum(axis=1) / total
        for photo, (rows, basis) in enumerate(zip(seen, bases, strict=True)):
            if len(rows) == 0:
                continue
            own = weight[rows, photo]
            offset = level[rows] - values[rows, photo]
            normal = (basis.multiply(own[:, None]).T @ basis).toarray()
            nodes[photo] = np.linalg.solve(normal + stiffness, basis.T @ (own * offset))
            correction[rows, photo] = basis @ nodes[photo]
        residual = np.abs(level[:, None] - values - correction)
        weight = usable * np.minimum(1.0, ROBUST_LOG / np.maximum(residual, 1e-6))
    points = max(int(usable.sum()), 1)
    return nodes, float((np.where(usable, correction, 0.0) ** 2).sum(dtype=np.float64)) / points

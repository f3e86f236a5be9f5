# SPDX-License-Identifier: GPL-3.0-or-later
"""Pivots of oriented Gaussians: two, three or nine per Gaussian (docs/method.md, section 6.1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ... import tolerances
from ...gaussians.model import GaussianArrays
from ...regions.convex_region import Region

PIVOT_SIGMAS = 3.0
"""The outer pivot lies at this many standard deviations along the normal."""

MAX_PIVOT_GAUSSIANS = 250_000
"""With more, one Gaussian per cell and direction represents its neighbours, to limit memory."""


def gaussians_reaching(arrays: GaussianArrays, region: Region, margin: float) -> np.ndarray:
    """Return indices of the Gaussians whose 3-sigma ellipsoid is within ``margin`` of the region.

    Gaussians too faint to be rendered (opacity below 1/255) are left out, as are those whose centre
    is farther away than 1.5 diagonals of the region.
    """
    normals, offsets = region.half_spaces
    good = arrays.log_opacities > np.log(tolerances.ALPHA_MIN)
    good &= np.isfinite(arrays.means).all(1) & np.isfinite(arrays.scales).all(1)
    local = arrays.means - region.center  # (n, 3)
    good &= np.linalg.norm(local, axis=1) < 1.5 * region.diagonal
    for normal, offset in zip(normals, offsets, strict=True):
        index = np.flatnonzero(good)
        width = directional_sigma(arrays, index, np.broadcast_to(normal, (len(index), 3)))
        good[index] = local[index] @ normal - offset <= PIVOT_SIGMAS * width + margin
    return np.flatnonzero(good)


def directional_sigma(
    arrays: GaussianArrays, index: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """Return ``sqrt(d^T Sigma d)`` of the Gaussians ``index`` along unit ``directions``, (k,)."""
    along = np.einsum("kij,ki->kj", arrays.rotations[index], directions)  # (k, 3) R^T d
    return np.linalg.norm(arrays.scales[index] * along, axis=1)


def two_pivots(arrays: GaussianArrays, index: np.ndarray) -> np.ndarray:
    """Return centre and outer pivots of the Gaussians ``index``.

    A Gaussian without orientation (normal shorter than ``tolerances.ORIENTED_MIN_NORM``) gets
    outer pivots on both sides along its shortest axis.

    Returns
    -------
    (p, 3) float64
        Centres first, then outer pivots.
    """
    means, step, oriented = _outer_steps(arrays, index)
    return np.concatenate([means, means + step, means[~oriented] - step[~oriented]])


def three_pivots(arrays: GaussianArrays, index: np.ndarray) -> np.ndarray:
    """Return centre and outer pivots on both sides of the Gaussians ``index``, (3 k, 3) float64."""
    means, step, _ = _outer_steps(arrays, index)
    return np.concatenate([means, means + step, means - step])


def _outer_steps(
    arrays: GaussianArrays, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres (k, 3), offsets of the outer pivots (k, 3), and whether oriented (k,) bool."""
    means = arrays.means[index]
    normals = arrays.normals[index]
    length = np.linalg.norm(normals, axis=1)
    oriented = length >= tolerances.ORIENTED_MIN_NORM
    rows = np.arange(len(index))
    shortest = arrays.rotations[index][rows, :, arrays.scales[index].argmin(1)]  # (k, 3)
    unit = np.where(oriented[:, None], normals / np.maximum(length, 1e-300)[:, None], shortest)
    step = PIVOT_SIGMAS * directional_sigma(arrays, index, unit)[:, None] * unit  # (k, 3)
    return means, step, oriented


def nine_pivots(arrays: GaussianArrays, index: np.ndarray) -> np.ndarray:
    """Return centre and the corners of the 3-sigma box of the Gaussians ``index`` on their axes.

    As in Gaussian Opacity Fields; the orientation is not used (docs/method.md, section 6.1).

    Returns
    -------
    (9 k, 3) float64
        Centres first, then the corners, Gaussian by Gaussian.
    """
    means = arrays.means[index]
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
    local = PIVOT_SIGMAS * signs * arrays.scales[index][:, None, :]  # (k, 8, 3)
    corners = means[:, None] + np.einsum("kij,kcj->kci", arrays.rotations[index], local)
    return np.concatenate([means, corners.reshape(-1, 3)])


PIVOTS: dict[int, Callable[[GaussianArrays, np.ndarray], np.ndarray]] = {
    2: two_pivots,
    3: three_pivots,
    9: nine_pivots,
}
"""Pivot functions by the number of pivots per Gaussian."""


def representative_gaussians(arrays: GaussianArrays, index: np.ndarray, limit: int) -> np.ndarray:
    """Subsample the Gaussians ``index`` to at most ``limit``, evenly over space and direction.

    Each cell keeps its most opaque Gaussian per octant of normals. Cells grow until few enough
    are left.
    """
    if len(index) <= limit:
        return index
    means = arrays.means[index]
    low, high = means.min(0), means.max(0)
    octant = (arrays.normals[index] > 0) @ np.array([1, 2, 4])  # (k,)
    order = np.argsort(-arrays.log_opacities[index], kind="stable")
    cells_across = 1024.0
    while True:
        side = float((high - low).max()) / cells_across
        cell = np.floor((means - low) / side).astype(np.int64)  # (k, 3)
        key = ((cell[:, 0] * 2048 + cell[:, 1]) * 2048 + cell[:, 2]) * 8 + octant
        _, first = np.unique(key[order], return_index=True)
        if len(first) <= limit:
            return np.sort(index[order[first]])
        cells_across *= 0.8

# SPDX-License-Identifier: GPL-3.0-or-later
"""Pivots of oriented Gaussians: two, three or nine each (docs/method.md, section 6.1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .. import limits
from ..gaussians.model import GaussianArrays
from ..regions.shapes import Region

PivotRule = Callable[[GaussianArrays, np.ndarray], np.ndarray]
"""Maps Gaussians and (k,) indices of some of them to the (p, 3) float64 pivots of these."""

PIVOT_SIGMAS = 3.0  # outer pivots lie at this many standard deviations along a direction

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)

MAX_PIVOT_GAUSSIANS = 250_000
"""With more, one Gaussian per cell and direction represents its neighbours, to limit memory."""


def gaussians_reaching(
    arrays: GaussianArrays, region: Region, margin: float, *, faint: bool = False
) -> np.ndarray:
    """Return indices of the Gaussians whose 3-sigma ellipsoid is within ``margin`` of the region.

    Left out are Gaussians too faint to be rendered (opacity below 1/255) unless ``faint``, and
    those whose centre is farther away than 1.5 diagonals of the region.
    """
    good = (arrays.log_opacities > np.log(limits.ALPHA_MIN)) | faint
    good &= np.isfinite(arrays.means).all(1) & np.isfinite(arrays.scales).all(1)
    local = arrays.means - region.center  # (n, 3)
    good &= np.linalg.norm(local, axis=1) < 1.5 * region.diagonal
    for normal, offset in zip(*region.half_spaces, strict=True):
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
    """Return centres, then outer pivots of the Gaussians ``index``, (p, 3) float64.

    A Gaussian without orientation (normal shorter than ``limits.ORIENTED_MIN_NORM``) gets
    outer pivots on both sides along its shortest axis.
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
    unit, oriented = _unit_normals(arrays, index)
    step = PIVOT_SIGMAS * directional_sigma(arrays, index, unit)[:, None] * unit  # (k, 3)
    return arrays.means[index], step, oriented


def _unit_normals(arrays: GaussianArrays, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals, the shortest axis where not oriented (k, 3), and whether oriented."""
    normals = arrays.normals[index]
    length = np.linalg.norm(normals, axis=1)
    oriented = length >= limits.ORIENTED_MIN_NORM
    rows = np.arange(len(index))
    shortest = arrays.rotations[index][rows, :, arrays.scales[index].argmin(1)]  # (k, 3)
    unit = np.where(oriented[:, None], normals / np.maximum(length, 1e-300)[:, None], shortest)
    return unit, oriented


def normal_bases(arrays: GaussianArrays, index: np.ndarray) -> np.ndarray:
    """Return orthonormal bases of the Gaussians ``index``, (k, 3, 3), columns are directions.

    The first is the unit normal (:func:`_unit_normals`). Gram-Schmidt completes it from the
    Gaussian's axis that is least aligned with it: a basis that turns with the scene, and is the
    Gaussian's own where the normal is one of its axes.
    """
    first, _ = _unit_normals(arrays, index)
    rotations = arrays.rotations[index]
    along = np.einsum("kij,ki->kj", rotations, first)  # (k, 3) cosines
    axis = rotations[np.arange(len(index)), :, np.abs(along).argmin(1)]  # (k, 3)
    second = axis - (axis * first).sum(1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], 2)


def nine_pivots(arrays: GaussianArrays, index: np.ndarray) -> np.ndarray:
    """Return centre and the corners of the 3-sigma box of the Gaussians ``index`` on their normal.

    The box is that of :func:`normal_bases`, with the deviation ``sqrt(d^T Sigma d)`` along each
    direction (docs/method.md, section 6.1). Returns (9 k, 3) float64: centres first, then the
    corners, Gaussian by Gaussian.
    """
    bases = normal_bases(arrays, index)
    sigmas = [directional_sigma(arrays, index, bases[:, :, axis]) for axis in range(3)]
    return _box_pivots(arrays.means[index], bases, np.stack(sigmas, 1))


def nine_pivots_gof(arrays: GaussianArrays, index: np.ndarray) -> np.ndarray:
    """Return centre and the corners of the 3-sigma box of the Gaussians ``index`` on their axes.

    As in Gaussian Opacity Fields; the orientation is not used (docs/method.md, section 6.1).
    Order as in :func:`nine_pivots`.
    """
    return _box_pivots(arrays.means[index], arrays.rotations[index], arrays.scales[index])


def _box_pivots(means: np.ndarray, bases: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Return centres (k, 3), then the corners of the boxes of ``sigmas`` (k, 3) on ``bases``."""
    local = PIVOT_SIGMAS * _CORNERS * sigmas[:, None, :]  # (k, 8, 3)
    corners = means[:, None] + np.einsum("kij,kcj->kci", bases, local)
    return np.concatenate([means, corners.reshape(-1, 3)])


PIVOTS: dict[int, PivotRule] = {2: two_pivots, 3: three_pivots, 9: nine_pivots}
"""Pivot functions by the number of pivots per Gaussian."""


def pivot_rule(pivots: int, box: str) -> PivotRule:
    """Return the pivot function of the settings ``pivots`` and ``pivot_box``."""
    return nine_pivots_gof if (pivots, box) == (9, "gof") else PIVOTS[pivots]


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

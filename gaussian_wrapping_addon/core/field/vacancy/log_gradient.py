# SPDX-License-Identifier: GPL-3.0-or-later
"""Exact gradient of log vacancy: that of log transmittance from the arg-max camera."""

from __future__ import annotations

import math

import numpy as np

from ... import tolerances
from ...gaussians.model import GaussianArrays
from ...kernels.parallel import even_bounds, run_chunks
from .camera_bins import TILE_PX, CameraBins, VirtualScreen
from .gradient_kernels import TABLE_COLUMNS, log_transmittance_gradient


def gradient_table(arrays: GaussianArrays) -> np.ndarray:
    """Return (n, 14) float64 rows in the layout of ``gradient_kernels.TABLE_COLUMNS``."""
    table = np.empty((len(arrays), TABLE_COLUMNS))
    table[:, :3] = arrays.means
    whiten = arrays.rotations.transpose(0, 2, 1) / arrays.scales[:, :, None]  # (n, 3, 3)
    table[:, 3:12] = whiten.reshape(-1, 9)
    table[:, 12] = arrays.log_opacities
    table[:, 13] = 2.0 * (arrays.log_opacities - math.log(tolerances.ALPHA_MIN))
    return table


def gradient_from_camera(
    table: np.ndarray,
    view: VirtualScreen,
    bins: CameraBins,
    points: np.ndarray,
    rows: np.ndarray,
    log_t: np.ndarray,
    gradient: np.ndarray,
    threads: int,
) -> None:
    """Write log T and its gradient of some points from one camera.

    The same Gaussians contribute as in the vacancy field: those whose footprint ``alpha >= 1/255``
    contains the ray. The gradient is that of the contributing terms; at the rim of a footprint,
    log T jumps by at most 1/255 and has none.

    Parameters
    ----------
    points : (n, 3) float64
        Scene frame.
    rows : (k,) int64
        The points to evaluate.
    log_t : (n,) float64
        Written at ``rows``; NaN where the camera does not see the point.
    gradient : (n, 3) float64, 1 / scene units
        Written at ``rows`` that the camera sees.
    """

    def work(begin: int, end: int) -> None:
        log_transmittance_gradient(
            begin, end, rows, points, view.packed, view.camera.center, float(TILE_PX),
            view.tiles_x, view.tiles_y, bins.bounds, bins.rows, bins.tile_start, bins.tile_ids,
            bins.ids, table, log_t, gradient,
        )  # fmt: skip

    run_chunks(work, even_bounds(len(rows), threads), threads)

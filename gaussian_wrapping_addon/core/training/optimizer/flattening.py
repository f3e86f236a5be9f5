# SPDX-License-Identifier: GPL-3.0-or-later
"""Decay of the smallest scale, so that Gaussians become flat unless photos keep them thick.

See docs/method.md, section 3.7.
"""

from __future__ import annotations

import math

import numpy as np

from ...kernels.compiled import kernel
from ...kernels.parallel import even_bounds, run_chunks

MOST_FLAT = math.exp(-4.5)
"""A scale decays no further than this share of the middle one: thinner discs gain nothing, and
their gradients grow with the inverse."""

FILTER_SHARE = 0.2
"""... and no further than this share of the 3D filter, which hides anything thinner."""

_LEAST_SCALE = 1e-9


@kernel(fast=False)
def _flatten_rows(
    begin: int, end: int, log_scales: np.ndarray, filter_3d: np.ndarray, step: float
) -> None:
    log_flat, log_share = math.log(MOST_FLAT), math.log(FILTER_SHARE)
    for i in range(begin, end):
        a, b, c = log_scales[i, 0], log_scales[i, 1], log_scales[i, 2]
        least = 0
        if b < a:
            least = 1
        if c < log_scales[i, least]:
            least = 2
        smallest = log_scales[i, least]
        middle = max(min(a, b), min(max(a, b), c))
        floor = max(middle + log_flat, math.log(max(filter_3d[i], _LEAST_SCALE)) + log_share)
        if smallest > floor:
            log_scales[i, least] = max(smallest - step, floor)


def flatten(log_scales: np.ndarray, filter_3d: np.ndarray, step: float, *, threads: int) -> None:
    """Reduce the smallest scale of each Gaussian, down to a floor.

    Parameters
    ----------
    log_scales : (n, 3) float32
        Changed.
    filter_3d : (n,) float32
    step : float
        Natural logarithm of the factor, > 0.
    """

    def run(begin: int, end: int) -> None:
        _flatten_rows(begin, end, log_scales, filter_3d, step)

    run_chunks(run, even_bounds(len(log_scales), threads, 1), threads)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Decay of the smallest scale, so that large discs become flat unless photos keep them thick.

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

DISC_SHARE = 0.25
"""Least share of the largest scale that the middle one of a disc has. Needles stay round: they are
wires, which a ribbon does not replace."""

LEAST_WIDTH = 8.0
"""Least middle scale of a disc, in 3D filters (a filter is about 0.22 px): what is narrower may be
part of a wire."""

_LEAST_SCALE = 1e-9


@kernel(fast=False)
def _flatten_rows(
    begin: int, end: int, log_scales: np.ndarray, filter_3d: np.ndarray, step: float
) -> None:
    log_flat, log_share = math.log(MOST_FLAT), math.log(FILTER_SHARE)
    log_disc, log_width = math.log(DISC_SHARE), math.log(LEAST_WIDTH)
    for i in range(begin, end):
        a, b, c = log_scales[i, 0], log_scales[i, 1], log_scales[i, 2]
        least = 0
        if b < a:
            least = 1
        if c < log_scales[i, least]:
            least = 2
        smallest = log_scales[i, least]
        middle = max(min(a, b), min(max(a, b), c))
        log_filter = math.log(max(filter_3d[i], _LEAST_SCALE))
        if middle < max(a, b, c) + log_disc or middle < log_filter + log_width:
            continue
        floor = max(middle + log_flat, log_filter + log_share)
        if smallest > floor:
            log_scales[i, least] = max(smallest - step, floor)


def flatten(log_scales: np.ndarray, filter_3d: np.ndarray, step: float, *, threads: int) -> None:
    """Reduce the smallest scale of each disc, down to a floor.

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

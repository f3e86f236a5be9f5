# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled solver of the 0.5-isosurface depth of a block of pixels, from its contributor list.

Along a pixel's ray ``T(t) = prod_i (1 - min(0.99, alpha_i exp(-s_i max(t_i - t, 0)^2 / 2)))`` falls
with t; the depth is where it crosses 0.5 (docs/method.md, section 2.4). Each pixel keeps a bracket,
starts where the Gaussian at which the blending crosses 0.5 would cross it alone, and takes Halley
steps on log T. A step that leaves the bracket, or every second one after the first few, is replaced
by bisection.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...kernels.compiled import inline
from ..simd.raster_math import DEPTH, ONE, SLOPE, STRIDE, ZERO
from ..simd.vector_runs import copy_run
from .isosurface_steps import (
    AT_DEPTH,
    NEAREST,
    SLOPES,
    approach_8,
    approach_16,
    compact_8,
    compact_16,
    drop_occluded_8,
    drop_occluded_16,
    evaluate_8,
    evaluate_16,
    open_8,
    open_16,
    step_8,
    step_16,
)

_NEWTON_STEPS = 8
"""After these, every second step is a bisection, which bounds the number of steps."""
_MAX_STEPS = 80
_NO_PIXELS = np.uint64(0)


@inline
def solve_block(lanes: Any, m: Any, b: Any, lists: Any, count: Any) -> None:
    """Solve one block: z-depth (0 where there is none) and floored slope of its pixels.

    Parameters
    ----------
    lanes : int
        8 or 16.
    m : (n,) float32
        The tile's scratch, with brackets and initial guesses from blending; depth and slope are
        written.
    b : int
        Start of the block in each plane.
    lists : (n,) float32
        Entries of the block, ``count`` of them; none if no pixel has an isosurface. Reordered.
    """
    is_open = _NO_PIXELS
    if count > 0:
        is_open = open_16(m) if lanes == 16 else open_8(m)
    if is_open != _NO_PIXELS and m[NEAREST] <= ZERO:
        # Some Gaussian may reach the camera: a crossing needs T > 0.5 at depth 0.
        if lanes == 16:
            evaluate_16(m, lists, count, ZERO)
            is_open = drop_occluded_16(m)
        else:
            evaluate_8(m, lists, count, ZERO)
            is_open = drop_occluded_8(m)
    if is_open != _NO_PIXELS:
        if lanes == 16:
            approach_16(m, lists, count)
        else:
            approach_8(m, lists, count)
    steps = 0
    while is_open != _NO_PIXELS and steps < _MAX_STEPS:
        bisect = ONE if steps >= _NEWTON_STEPS and steps & 1 else ZERO
        narrowed = steps > 0 and steps & 1 == 0
        if lanes == 16:
            if narrowed:
                count = compact_16(m, lists, count)
            evaluate_16(m, lists, count, ONE)
            is_open = step_16(m, bisect)
        else:
            if narrowed:
                count = compact_8(m, lists, count)
            evaluate_8(m, lists, count, ONE)
            is_open = step_8(m, bisect)
        steps += 1
    copy_run(lanes, m, DEPTH * STRIDE + b, m, AT_DEPTH)
    copy_run(lanes, m, SLOPE * STRIDE + b, m, SLOPES)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Kernels of the trained exposure: an affine map per colour channel and its gradients."""

from __future__ import annotations

from typing import Any

from ...kernels.compiled import kernel


@kernel(fast=True)
def apply_rows(
    begin: int, end: int, color: Any, alpha: Any, gains: Any, offsets: Any, out: Any
) -> None:
    """Write ``gains color + offsets alpha`` of rows; an ``alpha`` without rows stands for 1."""
    with_alpha = alpha.shape[0] > 0
    red, green, blue = gains[0], gains[1], gains[2]
    for y in range(begin, end):
        for x in range(color.shape[1]):
            cover = alpha[y, x] if with_alpha else color.dtype.type(1)
            out[y, x, 0] = red * color[y, x, 0] + offsets[0] * cover
            out[y, x, 1] = green * color[y, x, 1] + offsets[1] * cover
            out[y, x, 2] = blue * color[y, x, 2] + offsets[2] * cover


@kernel(fast=True)
def backward_rows(
    begin: int, end: int, color: Any, alpha: Any, by_out: Any, gains: Any, offsets: Any,
    by_color: Any, by_alpha: Any, sums: Any,
) -> None:  # fmt: skip
    """Write the gradients on colour and alpha, and each row's six sums for gains and offsets.

    ``sums[y]`` = sums over the row of ``by_out color`` (3) and ``by_out alpha`` (3), in float64:
    a row is summed by one thread, so that the total does not depend on the number of threads.
    """
    with_alpha = alpha.shape[0] > 0
    for y in range(begin, end):
        gain_r = gain_g = gain_b = 0.0
        offset_r = offset_g = offset_b = 0.0
        for x in range(color.shape[1]):
            cover = alpha[y, x] if with_alpha else color.dtype.type(1)
            r, g, b = by_out[y, x, 0], by_out[y, x, 1], by_out[y, x, 2]
            gain_r += r * color[y, x, 0]
            gain_g += g * color[y, x, 1]
            gain_b += b * color[y, x, 2]
            offset_r += r * cover
            offset_g += g * cover
            offset_b += b * cover
            by_color[y, x, 0] = gains[0] * r
            by_color[y, x, 1] = gains[1] * g
            by_color[y, x, 2] = gains[2] * b
            if with_alpha:
                by_alpha[y, x] = offsets[0] * r + offsets[1] * g + offsets[2] * b
        sums[y, 0], sums[y, 1], sums[y, 2] = gain_r, gain_g, gain_b
        sums[y, 3], sums[y, 4], sums[y, 5] = offset_r, offset_g, offset_b

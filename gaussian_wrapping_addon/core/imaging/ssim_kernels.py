# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled comparison of two images: errors, structural similarity (SSIM), and the gradient."""

from __future__ import annotations

import numpy as np

from ..kernels.compiled import inline, kernel, part
from .separable_filters import LANES, RING, TAPS, filter_run, filter_two_runs

WINDOW = TAPS
"""Side of the Gaussian window, pixels; sigma is 1.5 (docs/method.md, section 3.1)."""
RADIUS = WINDOW // 2
SIGMA_PX = 1.5
REACH = WINDOW - 1
"""Rows or columns of a window after its first."""

_taps = [np.exp(-0.5 * ((i - RADIUS) / SIGMA_PX) ** 2) for i in range(WINDOW)]
WEIGHTS = tuple(float(tap / sum(_taps)) for tap in _taps)

C1 = 0.01**2
C2 = 0.03**2

BLOCK_PX = 512
"""Width of a column block: the buffered last rows of one fit a cache of 1 MB."""

_AVERAGED = 4  # x, y, x^2 + y^2, x y: SSIM only needs the sum of the two variances
_MAPS = 3  # derivatives of SSIM with respect to E[x], E[x^2] and E[x y] of its window
_MARGIN = 3 * REACH
STRIDE = (3 * (BLOCK_PX + 2 * REACH) + 2 * _MARGIN + 2 * LANES) // LANES * LANES
"""Offset between two scratch rows; constant, so that LLVM can rule out overlap."""


@part(fast=True)
def _filter_along(count, target, target_at, source, source_at, weights):  # type: ignore[no-untyped-def]
    """Filter one row of interleaved colours; writes ``count`` values, rounded up to whole runs."""
    for j in range(0, count, LANES):
        filter_run(target, target_at + j, source, source_at + j, 3, weights)  # type: ignore[call-arg]


@inline
def _filter_rings(at, count, apart, target, ring, weights, first):  # type: ignore[no-untyped-def]
    """Filter one kind of row; ``first`` is a constant, see ``filter_two_runs``."""
    for j in range(at, at + count, LANES):
        filter_two_runs(target, j, apart, ring, j, apart, weights, first)  # type: ignore[call-arg]


@part(fast=True)
def _filter_across(count, kinds, target, ring, first, weights):  # type: ignore[no-untyped-def]
    """Filter a ring of ``kinds`` rows a slot into two times ``kinds`` rows.

    ``first``: slot of the first row of the first window, even.
    """
    apart = kinds * STRIDE
    for q in range(kinds):
        at = q * STRIDE
        if first == 0:
            _filter_rings(at, count, apart, target, ring, weights, 0)
        elif first == 2:
            _filter_rings(at, count, apart, target, ring, weights, 2)
        elif first == 4:
            _filter_rings(at, count, apart, target, ring, weights, 4)
        elif first == 6:
            _filter_rings(at, count, apart, target, ring, weights, 6)
        elif first == 8:
            _filter_rings(at, count, apart, target, ring, weights, 8)
        elif first == 10:
            _filter_rings(at, count, apart, target, ring, weights, 10)


@part(fast=True)
def _keep_row(mask, row, first, last, keep):  # type: ignore[no-untyped-def]
    """Write 1 or 0 for each value of the pixels [first, last) of a row of the mask."""
    for p in range(last - first):
        value = keep.dtype.type(1.0 if mask[row, first + p] else 0.0)
        keep[3 * p] = value
        keep[3 * p + 1] = value
        keep[3 * p + 2] = value


@part(fast=True)
def _load_row(row, first, count, image, photo, scale, keep, rows):  # type: ignore[no-untyped-def]
    """Write x, y, x^2 + y^2 and x y of ``count`` values of a row, 0 outside the mask."""
    kind = rows.dtype.type
    x_row, y_row = image[row, first : first + count], photo[row, first : first + count]
    for j in range(count):
        rows[j] = x_row[j]
    for j in range(count):
        rows[STRIDE + j] = kind(y_row[j]) * scale
    for j in range(count):
        x, y = rows[j] * keep[j], rows[STRIDE + j] * keep[j]
        rows[j] = x
        rows[STRIDE + j] = y
        rows[2 * STRIDE + j] = x * x + y * y
        rows[3 * STRIDE + j] = x * y


@part(fast=True)
def _similarity_row(count, means, keep, partial):  # type: ignore[no-untyped-def]
    """Write SSIM of one row of windows, and its derivatives by E[x], E[x^2] and E[x y]."""
    kind = means.dtype.type
    c1, c2, one, two = kind(C1), kind(C2), kind(1.0), kind(2.0)
    for j in range(count):
        mx, my = means[j], means[STRIDE + j]
        square, product = mx * mx + my * my, mx * my
        a1 = two * product + c1
        a2 = two * (means[3 * STRIDE + j] - product) + c2
        b1 = square + c1
        b2 = (means[2 * STRIDE + j] - square) + c2
        inverse = one / (b1 * b2)
        s = a1 * a2 * inverse
        weight = two * keep[j] * inverse
        partial[_MARGIN + j] = weight * (my * (a2 - a1) - s * mx * (b2 - b1))
        partial[STRIDE + _MARGIN + j] = kind(-0.5) * weight * s * b1
        partial[2 * STRIDE + _MARGIN + j] = weight * a1
        partial[3 * STRIDE + _MARGIN + j] = keep[j] * s


@part(fast=True)
def _sum(values):  # type: ignore[no-untyped-def]
    total = values.dtype.type(0.0)
    for j in range(len(values)):
        total += values[j]
    return total


@part(fast=True)
def _errors_row(count, x_row, y_row, scale_y, keep):  # type: ignore[no-untyped-def]
    """Return the sums of absolute and squared errors of a row."""
    kind = x_row.dtype.type
    total, total_sq = kind(0.0), kind(0.0)
    for j in range(count):
        difference = (x_row[j] - kind(y_row[j]) * scale_y) * keep[j]
        total += abs(difference)
        total_sq += difference * difference
    return total, total_sq


@part(fast=True)
def _gradient_row(count, x_row, y_row, scale_y, keep, maps, step, scale, out):  # type: ignore[no-untyped-def]
    """Write a row of the gradient from the derivatives' maps, filtered both ways."""
    kind = x_row.dtype.type
    zero, two = kind(0.0), kind(2.0)
    for j in range(count):
        x, y = x_row[j], kind(y_row[j]) * scale_y
        similar = maps[j] + two * x * maps[STRIDE + j] + y * maps[2 * STRIDE + j]
        sign = step if x > y else (-step if x < y else zero)
        out[j] = keep[j] * (sign + scale * similar)


@kernel(fast=True)
def compare_rows(  # type: ignore[no-untyped-def]
    begin, end, image, photo, scale_photo, mask, weight_absolute, weight_similar, sums, gradient
):
    """Compare the rows [begin, end) of two images in one pass from top to bottom.

    The window is separable: each row is filtered horizontally, and the last 11 are kept in a ring
    buffer to be filtered vertically. SSIM's derivatives are filtered in the same way. A strip
    recomputes the 10 rows above it, so that results do not depend on where strips begin. Two
    windows are filtered vertically at once, which halves the loads from the ring.

    Parameters
    ----------
    image : (h, 3 w) float
        Interleaved colours in [0, 1].
    photo : (h, 3 w) float or uint8
    scale_photo : float
        Factor of the photo's values.
    mask : (h, w) bool, or (0, 0) for none
        Where it is false both images count as black, and windows centred there are ignored.
    weight_absolute, weight_similar : float
        ``gradient`` is that of ``weight_absolute`` x the sum of absolute errors +
        ``weight_similar`` x the sum of SSIM over all windows and colours.
    sums : (b, h, 3) float64
        Written: sums over a row of one of the b column blocks of absolute errors, squared errors,
        and SSIM of the row of windows that begins in this row.
    gradient : (h, 3 w) float, or (0, 0) for none
        Written.
    """
    height, width = image.shape[0], image.shape[1] // 3
    kind = image.dtype.type
    scale_y, step, scale = kind(scale_photo), kind(weight_absolute), kind(weight_similar)
    masked, differentiated = mask.shape[0] > 0, gradient.shape[0] > 0
    has_windows = height >= WINDOW and width >= WINDOW
    reach = REACH if has_windows else 0
    above = reach if differentiated else 0
    weights = (
        kind(WEIGHTS[0]), kind(WEIGHTS[1]), kind(WEIGHTS[2]),
        kind(WEIGHTS[3]), kind(WEIGHTS[4]), kind(WEIGHTS[5]),
    )  # fmt: skip
    rows = np.empty(_AVERAGED * STRIDE, kind)
    ring = np.zeros(RING * _AVERAGED * STRIDE, kind)
    means = np.empty(2 * _AVERAGED * STRIDE, kind)
    partial = np.empty((_MAPS + 1) * STRIDE, kind)
    maps_ring = np.empty(RING * _MAPS * STRIDE, kind)
    maps = np.zeros(2 * _MAPS * STRIDE, kind)
    keep = np.ones(STRIDE, kind)
    # Rows come in pairs of an even and an odd one, for any strip.
    top = max(0, begin - above) // 2 * 2
    for block in range(sums.shape[0]):
        left = block * BLOCK_PX
        right = min(width, left + BLOCK_PX)
        first = max(0, left - above)
        last = min(width, right + reach)
        inner = 3 * (right - left)
        count = 3 * (last - first - REACH)  # values of a row of windows
        counted = 3 * (min(right, width - REACH) - left)  # of them, those of no other block
        partial[:] = kind(0.0)  # there are no windows beyond the left and right borders,
        maps_ring[:] = kind(0.0)  # nor above the first row
        for pair in range(top // 2, (end + reach + 1) // 2):
            for i in range(2 * pair, 2 * pair + 2):
                if has_windows and i < height:
                    if masked:
                        _keep_row(mask, i, first, last, keep)
                    span = 3 * (last - first)
                    _load_row(i, 3 * first, span, image, photo, scale_y, keep, rows)
                    for q in range(_AVERAGED):
                        at = ((i % RING) * _AVERAGED + q) * STRIDE
                        _filter_along(count, ring, at, rows, q * STRIDE, weights)
            row = 2 * pair - reach  # the windows and the gradient of two rows are complete now
            if row < top:
                continue
            if has_windows:
                _filter_across(count, _AVERAGED, means, ring, row % RING, weights)
                for r in range(row, row + 2):
                    if r + REACH < height:
                        if masked:
                            _keep_row(mask, r + RADIUS, first + RADIUS, last - RADIUS, keep)
                        own = means[(r - row) * _AVERAGED * STRIDE :]
                        _similarity_row(count, own, keep, partial)
                    else:
                        partial[:] = kind(0.0)
                    if begin <= r < end:
                        at = _MAPS * STRIDE + _MARGIN + 3 * (left - first)
                        sums[block, r, 2] = _sum(partial[at : at + max(0, counted)])
                    if differentiated:
                        for q in range(_MAPS):
                            at = ((r % RING) * _MAPS + q) * STRIDE
                            source = q * STRIDE + 3 * (left - first)
                            _filter_along(inner, maps_ring, at, partial, source, weights)
                if differentiated:
                    above_row = (row + 2) % RING  # that of 10 rows above
                    _filter_across(inner, _MAPS, maps, maps_ring, above_row, weights)
            for r in range(max(row, begin), min(row + 2, end)):
                if masked:
                    _keep_row(mask, r, left, right, keep)
                x_row = image[r, 3 * left : 3 * right]
                y_row = photo[r, 3 * left : 3 * right]
                total, total_sq = _errors_row(inner, x_row, y_row, scale_y, keep)
                sums[block, r, 0] = total
                sums[block, r, 1] = total_sq
                if differentiated:
                    out = gradient[r, 3 * left : 3 * right]
                    own = maps[(r - row) * _MAPS * STRIDE :]
                    _gradient_row(inner, x_row, y_row, scale_y, keep, own, step, scale, out)

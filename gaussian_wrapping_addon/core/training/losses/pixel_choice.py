# SPDX-License-Identifier: GPL-3.0-or-later
"""Sample the pixels for the multi-view terms: stratified, with more of them on texture."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...imaging.luma import LUMA
from ...kernels.array_store import ArrayStore
from ...kernels.compiled import kernel
from ...kernels.parallel import even_bounds, run_chunks

BORDER_PX = 2
"""Pixels closer to the border than this have patches that leave the image."""
BLOCK_PX = 8
"""Pixels are traversed in blocks of this side, so that a stratum is a patch and not a line."""
NO_MASK = np.zeros((0, 0), np.bool_)
RED, GREEN, BLUE = LUMA


def grey_image(
    photo: np.ndarray, name: str, *, threads: int, store: ArrayStore | None = None
) -> np.ndarray:
    """Return (h, w) float32 grey in [0, 1] of an (h, w, 3) photo: uint8, or floats in [0, 1].

    ``name`` is its key in ``store``.
    """
    shape = photo.shape[:2]
    grey = np.empty(shape, np.float32) if store is None else store.take(name, shape, np.float32)
    scale = 1.0 / 255.0 if photo.dtype == np.uint8 else 1.0

    def run(begin: int, end: int) -> None:
        _grey_rows(begin, end, photo, scale, grey)

    run_chunks(run, even_bounds(shape[0], threads, 2), threads)
    return grey


def choose_pixels(
    grey: np.ndarray,
    depth: np.ndarray,
    mask: np.ndarray | None,
    count: int,
    random: np.random.Generator,
    *,
    threads: int,
    store: ArrayStore | None = None,
) -> np.ndarray:
    """Sample up to ``count`` distinct pixels with depth, inside the mask; all, if it has no more.

    Stratified along blocks of pixels. The probability of a pixel is proportional to its brightness
    gradient plus the mean one: half of the pixels follow texture, half are uniform.

    Parameters
    ----------
    grey, depth : (h, w) float32
        Depth is > 0 where defined.
    mask : (h, w) bool, optional
        False pixels are never chosen.
    random : numpy Generator
        ``count`` numbers are drawn, whatever the images contain; none if ``count`` is not less
        than the number of pixels.

    Returns
    -------
    (m,) int32
        ``row * width + column``, m <= count.
    """
    height = len(grey)
    takes_all = count >= grey.size
    jitter = random.random(0 if takes_all else count)
    steepness = (
        np.empty(grey.shape, np.float32)
        if store is None
        else store.take("steepness", grey.shape, np.float32)
    )
    sums = np.empty((height, 2))
    flat_mask = NO_MASK if mask is None else np.ascontiguousarray(mask, np.bool_)

    def run(begin: int, end: int) -> None:
        _steepness_rows(begin, end, grey, depth, flat_mask, steepness, sums)

    run_chunks(run, even_bounds(height, threads, 2), threads)
    steep, usable = sums.sum(0).tolist()
    if usable == 0:
        return np.zeros(0, np.int32)
    if takes_all:
        return np.flatnonzero(steepness.reshape(-1) >= 0.0).astype(np.int32)
    even = steep / usable if steep > 0.0 else 1.0
    chosen = np.empty(count, np.int32)
    found = _pick(steepness, even, steep + even * usable, jitter, chosen)
    return chosen[:found]


@kernel(fast=False, fused=True)
def _grey_rows(begin: int, end: int, photo: np.ndarray, scale: float, grey: np.ndarray) -> None:
    red, green = np.float32(RED * scale), np.float32(GREEN * scale)
    blue = np.float32(BLUE * scale)
    for i in range(begin, end):
        for j in range(photo.shape[1]):
            grey[i, j] = (
                red * np.float32(photo[i, j, 0])
                + green * np.float32(photo[i, j, 1])
                + blue * np.float32(photo[i, j, 2])
            )


@kernel(fast=False)
def _steepness_rows(
    begin: int,
    end: int,
    grey: np.ndarray,
    depth: np.ndarray,
    mask: np.ndarray,
    steepness: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Write the length of the brightness gradient, -1 for pixels that cannot be chosen, and for
    each row their sum and number."""
    height, width = grey.shape
    for i in range(begin, end):
        total, usable = 0.0, 0
        for j in range(width):
            steepness[i, j] = np.float32(-1.0)
            if not (BORDER_PX <= i < height - BORDER_PX and BORDER_PX <= j < width - BORDER_PX):
                continue
            if not depth[i, j] > 0.0 or (len(mask) > 0 and not mask[i, j]):
                continue
            across = grey[i, j + 1] - grey[i, j - 1]
            down = grey[i + 1, j] - grey[i - 1, j]
            length = np.sqrt(across * across + down * down)
            if not length < math.inf:
                continue
            steepness[i, j] = length
            total += steepness[i, j]
            usable += 1
        sums[i, 0] = total
        sums[i, 1] = usable


@kernel(fast=False)
def _pick(
    steepness: np.ndarray, even: float, total: float, jitter: np.ndarray, chosen: np.ndarray
) -> Any:
    """Write the pixel selected by each stratum's draw, without duplicates; return their number."""
    height, width = steepness.shape
    stratum = total / len(jitter)
    found, drawn, running = 0, 0, 0.0
    for top in range(0, height, BLOCK_PX):
        for left in range(0, width, BLOCK_PX):
            for i in range(top, min(top + BLOCK_PX, height)):
                for j in range(left, min(left + BLOCK_PX, width)):
                    if steepness[i, j] < 0.0:
                        continue
                    running += steepness[i, j] + even
                    hit = False
                    while drawn < len(jitter) and (drawn + jitter[drawn]) * stratum < running:
                        drawn += 1
                        hit = True
                    if hit:
                        chosen[found] = i * width + j
                        found += 1
    return found

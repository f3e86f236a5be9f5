# SPDX-License-Identifier: GPL-3.0-or-later
"""How far the picture has moved between two frames: parts of small grey pictures are followed.

docs/method.md, section 14.1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import map_coordinates

MOTION_SIDE_PX = 160
"""Long side of the pictures that motion is measured in."""
_BLOCKS = 12
"""Blocks along the long side of a picture; each is followed on its own."""
_ROUNDS = 3
_MIN_TEXTURE = 4.0
"""Mean squared gradient, levels per pixel squared, of a block that can be followed."""
_STEEPEST_SHARE = 1e-2
"""Added to a block's matrix, as a share of its trace: nothing moves along an edge alone."""
_PERCENTILE = 90.0
"""Of the blocks' motion: where the object turns, most of a picture may stand still."""
_STILL_PX = 0.12
"""Motion of noise; steps shorter than this are none."""
_ANCHOR_PX = 3.0
"""Distance at which the frame compared with is replaced; until then errors do not add up."""
_MOST_SHARE = 0.25
"""Longest step that counts, in sides of the picture: cuts and lost tracks measure anything."""


class MotionMeter:
    """Follow a video: :meth:`add` returns how far the picture has moved since its beginning.

    Shaking counts where it is wider than three small pixels, noise never does.
    """

    def __init__(self) -> None:
        self._anchor: np.ndarray | None = None
        self._anchor_at = 0.0
        self._at = 0.0

    def add(self, grey: np.ndarray) -> float:
        """Return the way so far, in long sides of the picture.

        Parameters
        ----------
        grey : (h, w) float32
            The next frame, of the size of those before; ``MOTION_SIDE_PX`` long.
        """
        if self._anchor is None:
            self._anchor = grey
            return 0.0
        side = float(max(grey.shape))
        moved_px = displacement_px(self._anchor, grey)
        step = min(max(moved_px - _STILL_PX, 0.0) / side, _MOST_SHARE)
        self._at = max(self._at, self._anchor_at + step)
        if moved_px > _ANCHOR_PX:
            self._anchor, self._anchor_at = grey, self._at
        return self._at


def displacement_px(first: np.ndarray, second: np.ndarray) -> float:
    """Return the shift of the faster blocks between two (h, w) float32 pictures, pixels."""
    shift_y, shift_x = _whole_shift(first, second)
    height, width = first.shape
    block = max(4, max(height, width) // _BLOCKS)
    rows, columns = height // block, width // block
    if not rows or not columns:
        return float(np.hypot(shift_y, shift_x))
    flow = np.zeros((2, rows, columns))
    flow[0], flow[1] = shift_y, shift_x
    down, across = np.gradient(first)
    cut = (slice(rows * block), slice(columns * block))
    yy = _block_sums(down * down, cut, block)
    xx = _block_sums(across * across, cut, block)
    xy = _block_sums(down * across, cut, block)
    trace = yy + xx
    followed = trace > _MIN_TEXTURE * block * block
    if not followed.any():
        return float(np.hypot(shift_y, shift_x))
    ridge = _STEEPEST_SHARE * trace + 1e-6
    determinant = (yy + ridge) * (xx + ridge) - xy * xy
    y, x = np.mgrid[: rows * block, : columns * block].astype(np.float32)
    for _ in range(_ROUNDS):
        each = flow.repeat(block, 1).repeat(block, 2)  # (2, h, w)
        moved = map_coordinates(second, [y + each[0], x + each[1]], order=1, mode="nearest")
        change = moved - first[cut]
        b_y = _block_sums(down[cut] * change, cut, block)
        b_x = _block_sums(across[cut] * change, cut, block)
        flow[0] -= ((xx + ridge) * b_y - xy * b_x) / determinant
        flow[1] -= ((yy + ridge) * b_x - xy * b_y) / determinant
        # A block that lost its track goes no further than a block from the whole.
        flow[0] = flow[0].clip(shift_y - block, shift_y + block)
        flow[1] = flow[1].clip(shift_x - block, shift_x + block)
    rows_at, columns_at = np.mgrid[:rows, :columns] * block
    leaves = (rows_at + flow[0] < 0) | (rows_at + flow[0] > height - block)
    leaves |= (columns_at + flow[1] < 0) | (columns_at + flow[1] > width - block)
    followed &= ~leaves if (followed & ~leaves).any() else True
    return float(np.percentile(np.hypot(flow[0], flow[1])[followed], _PERCENTILE))


def _whole_shift(first: np.ndarray, second: np.ndarray) -> tuple[int, int]:
    """Return the shift of whole pixels that fits best, by phase correlation; else none."""
    window = np.outer(np.hanning(first.shape[0]), np.hanning(first.shape[1]))
    a = np.fft.rfft2((first - first.mean()) * window)
    b = np.fft.rfft2((second - second.mean()) * window)
    cross = b * a.conj()
    cross /= np.abs(cross) + 1e-3 * (np.abs(cross).max() + 1e-12)
    peak = np.fft.irfft2(cross, s=first.shape)
    y, x = np.unravel_index(int(np.argmax(peak)), peak.shape)
    shift = _signed(int(y), first.shape[0]), _signed(int(x), first.shape[1])
    # A peak of chance would send all blocks astray.
    return shift if _misfit(first, second, shift) < _misfit(first, second, (0, 0)) else (0, 0)


def _misfit(first: np.ndarray, second: np.ndarray, shift: tuple[int, int]) -> float:
    """Return the mean difference where the shifted pictures overlap."""
    height, width = first.shape
    y, x = shift
    moved = second[max(y, 0) : height + min(y, 0), max(x, 0) : width + min(x, 0)]
    base = first[max(-y, 0) : height - max(y, 0), max(-x, 0) : width - max(x, 0)]
    return float(np.abs(moved - base).mean())


def _signed(value: int, size: int) -> int:
    return value - size if value > size // 2 else value


def _block_sums(values: np.ndarray, cut: Sequence[slice], block: int) -> np.ndarray:
    inside = values[tuple(cut)]
    height, width = inside.shape
    return inside.reshape(height // block, block, width // block, block).sum((1, 3))

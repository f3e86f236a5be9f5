# SPDX-License-Identifier: GPL-3.0-or-later
"""Photo masks in the vacancy field: masked points are unseen, or known to be empty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...dataset.camera import Camera
from ...errors import UsageError
from ...kernels.compiled import kernel

MaskMode = Literal["ignore", "background"]
"""As in training: masked pixels are ignored, or show that the space before them is empty."""


@dataclass(frozen=True)
class PackedMask:
    """A mask of which each pixel takes a bit: the masks of all photos are held at once."""

    bits: np.ndarray
    """(h, ceil(w / 8)) uint8, the first pixel in the highest bit; 1 where the photo counts."""
    width: int

    @classmethod
    def of(cls, mask: np.ndarray | None) -> PackedMask | None:
        """Pack an (h, w) mask."""
        if mask is None:
            return None
        return cls(np.packbits(np.asarray(mask, np.bool_), axis=-1), mask.shape[-1])

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the mask before it was packed."""
        return (*self.bits.shape[:-1], self.width)

    def unpacked(self) -> np.ndarray:
        """Return (h, w) bool."""
        return np.unpackbits(self.bits, axis=-1, count=self.width).view(np.bool_)


@kernel(fast=False)
def masked_points(begin, end, screen, cells, bits, width, scale_x, scale_y, out):  # type: ignore[no-untyped-def]
    """Tell which points with a cell lie in a masked pixel.

    ``bits`` and ``width`` are those of a :class:`PackedMask`; ``scale_x`` and ``scale_y`` convert
    pixels of ``screen`` to those of the mask.
    """
    height = bits.shape[0]
    for p in range(begin, end):
        out[p] = False
        if cells[p] < 0:
            continue
        column = min(int(screen[p, 0] * scale_x), width - 1)
        row = min(int(screen[p, 1] * scale_y), height - 1)
        out[p] = not (bits[row, column >> 3] & (128 >> (column & 7)))


def checked_masks(
    masks: Sequence[np.ndarray | PackedMask | None] | None, cameras: Sequence[Camera], mode: str
) -> tuple[PackedMask | None, ...]:
    """Validate and pack masks: one or ``None`` per camera, ``None`` also where nothing is masked.

    Raises
    ------
    UsageError
        The numbers of masks and cameras differ, a mask is not an image, or the mode is unknown.
    """
    if mode not in ("ignore", "background"):
        raise UsageError(f"The mask mode is {mode!r}.", 'Use "ignore" or "background".')
    if masks is None:
        return (None,) * len(cameras)
    if len(masks) != len(cameras):
        raise UsageError(
            f"There are {len(cameras)} cameras and {len(masks)} masks.", "Give one mask a camera."
        )
    out: list[PackedMask | None] = []
    for camera, mask in zip(cameras, masks, strict=True):
        if mask is None:
            out.append(None)
            continue
        if len(mask.shape) != 2 or 0 in mask.shape:
            raise UsageError(
                f"The mask of {camera.name} has the shape {mask.shape}.",
                "Use an image of one channel.",
            )
        packed = mask if isinstance(mask, PackedMask) else PackedMask.of(mask)
        assert packed is not None
        out.append(None if packed.unpacked().all() else packed)
    return tuple(out)

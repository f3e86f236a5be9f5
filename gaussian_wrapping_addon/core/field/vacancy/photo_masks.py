# SPDX-License-Identifier: GPL-3.0-or-later
"""Photo masks in the vacancy field: masked points are unseen, or known to be empty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from ...dataset.camera import Camera
from ...errors import UsageError
from ...kernels.compiled import kernel

MaskMode = Literal["ignore", "background"]
"""As in training: masked pixels are ignored, or show that the space before them is empty."""


@kernel(fast=False)
def masked_points(begin, end, screen, cells, mask, scale_x, scale_y, out):  # type: ignore[no-untyped-def]
    """Tell which points with a cell lie in a masked pixel.

    ``scale_x`` and ``scale_y`` convert pixels of ``screen`` to those of the mask.
    """
    height, width = mask.shape
    for p in range(begin, end):
        out[p] = False
        if cells[p] < 0:
            continue
        column = min(int(screen[p, 0] * scale_x), width - 1)
        row = min(int(screen[p, 1] * scale_y), height - 1)
        out[p] = not mask[row, column]


def checked_masks(
    masks: Sequence[np.ndarray | None] | None, cameras: Sequence[Camera], mode: str
) -> tuple[np.ndarray | None, ...]:
    """Validate masks; return one or ``None`` per camera, ``None`` also if nothing is masked.

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
    out: list[np.ndarray | None] = []
    for camera, mask in zip(cameras, masks, strict=True):
        if mask is None:
            out.append(None)
            continue
        if mask.ndim != 2 or mask.size == 0:
            raise UsageError(
                f"The mask of {camera.name} has the shape {mask.shape}.",
                "Use an image of one channel.",
            )
        kept = np.ascontiguousarray(mask, np.bool_)
        out.append(None if kept.all() else kept)
    return tuple(out)

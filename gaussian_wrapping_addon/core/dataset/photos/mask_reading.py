# SPDX-License-Identifier: GPL-3.0-or-later
"""How mask files are to be understood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .photo_file import MASK_THRESHOLD


@dataclass(frozen=True)
class MaskReading:
    """Choices for the mask files of an input; alpha channels are left as they are."""

    invert: bool = False
    """White is left out, not kept."""
    grow_px: int = 0
    """Border added to what is kept, or taken away where negative, pixels of the photo (along rows,
    columns and diagonals alike: two quick passes)."""

    def kept(self, grey: np.ndarray) -> np.ndarray:
        """Return (h, w) bool, true where the photo counts, of a mask file's (h, w) uint8."""
        kept = grey >= MASK_THRESHOLD
        if self.invert:
            kept = ~kept
        if not self.grow_px:
            return kept
        from scipy.ndimage import maximum_filter, minimum_filter

        grown = maximum_filter if self.grow_px > 0 else minimum_filter
        return np.asarray(grown(kept, 2 * abs(self.grow_px) + 1, mode="nearest"))


AS_WRITTEN = MaskReading()

# SPDX-License-Identifier: GPL-3.0-or-later
"""Convert images to floats; check that images to compare have the same size."""

from __future__ import annotations

import numpy as np

from ..errors import UsageError


def as_unit_floats(image: np.ndarray, dtype: type = np.float32) -> np.ndarray:
    """Return (h, w, 3) colours in [0, 1]: uint8 is divided by 255, floats are unchanged."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3:
        raise UsageError(f"An image has the shape {image.shape}.", "Give (height, width, 3).")
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image, dtype) * dtype(1.0 / 255.0)
    return np.ascontiguousarray(image, dtype)


def check_sizes(
    image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None, *, may_be_empty: bool = False
) -> None:
    """Raise ``UsageError`` if the shapes differ, or if the mask must not be empty but is."""
    if image.shape != photo.shape or (mask is not None and mask.shape != image.shape[:2]):
        raise UsageError(
            f"Image {image.shape}, photo {photo.shape} and mask differ in size.",
            "Compare images of one camera.",
        )
    if not may_be_empty and (image.size == 0 or (mask is not None and not mask.any())):
        raise UsageError("The mask leaves no pixel to measure.", "Check the mask.")

# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks from shares: floaters go, holes stay, thin spots close, borders grow by what is asked."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image
from scipy import ndimage

from gaussian_wrapping_addon.core.masks.segmentation import GROWN_SHARE, cleaned, encoded


def disc(size: int, radius: float, at: tuple[float, float] | None = None) -> np.ndarray:
    y, x = np.mgrid[:size, :size]
    cx, cy = at or (size / 2, size / 2)
    return (x - cx) ** 2 + (y - cy) ** 2 <= radius**2


def test_floaters_go_and_the_object_stays_as_it_is() -> None:
    object_ = disc(200, 60)
    share = np.where(object_ | disc(200, 4, (20, 20)), 0.9, 0.2).astype(np.float32)
    assert (cleaned(share, (200, 200)) == object_).all()


def test_large_holes_stay_and_thin_spots_close() -> None:
    hole, spot = disc(200, 15), disc(200, 1, (130, 100))
    share = np.where(disc(200, 60) & ~hole & ~spot, 1.0, 0.0).astype(np.float32)
    assert (cleaned(share, (200, 200)) == (disc(200, 60) & ~hole)).all()


def test_a_hole_that_is_half_full_closes() -> None:
    full = disc(200, 60)
    for filled, stays in ((0.1, True), (0.29, True), (0.31, False), (0.45, False)):
        hole = disc(200, 15)
        share = np.where(hole, filled, np.where(full, 1.0, 0.0)).astype(np.float32)
        assert (cleaned(share, (200, 200)) == (full & ~hole if stays else full)).all()


def test_the_border_grows_by_the_share_of_the_long_side() -> None:
    share = disc(400, 90).astype(np.float32)
    radius = round(GROWN_SHARE * 2000)
    exact = cleaned(share, (2000, 2000))
    grown = cleaned(share, (2000, 2000), GROWN_SHARE)
    distance = ndimage.distance_transform_edt(~exact)
    assert (grown == (distance <= radius)).all()


def test_nothing_stays_nothing() -> None:
    empty = np.zeros((30, 40), np.float32)
    assert not cleaned(empty, (80, 60), GROWN_SHARE).any()
    assert cleaned(empty + 1, (80, 60), GROWN_SHARE).all()


def test_encoded_masks_are_black_and_white() -> None:
    mask = disc(50, 20)
    with Image.open(io.BytesIO(encoded(mask))) as image:
        assert image.format == "PNG"
        assert (np.asarray(image) == np.where(mask, 255, 0)).all()

# SPDX-License-Identifier: GPL-3.0-or-later
"""Footprint regulariser: its value, and its gradient on the scales."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.render.types import VisibleGradients
from gaussian_wrapping_addon.core.training.losses import add_footprint_regulariser, footprint_shares


def no_gradients(ids: list[int]) -> VisibleGradients:
    count = len(ids)
    zeros = lambda *shape: np.zeros((count, *shape), np.float32)  # noqa: E731
    return VisibleGradients(
        np.array(ids, np.int32), zeros(3), zeros(3), zeros(4), zeros(), zeros(1, 3), zeros(4)
    )


def test_price_is_the_mean_number_of_boxes_over_a_pixel() -> None:
    boxes = np.array([[0, 0, 10, 10], [0, 0, 5, 10], [90, 90, 99, 99]], np.float32)
    gradients = no_gradients([0, 1])  # the third is not seen
    shares = footprint_shares(boxes[gradients.ids], (10, 10))
    mean = add_footprint_regulariser(gradients, np.zeros((3, 3), np.float32), shares, 0.5)
    assert mean == pytest.approx(1.5)


def test_what_lies_outside_of_the_image_costs_nothing() -> None:
    boxes = np.array([[-20, -20, 10, 10], [30, 0, 40, 10]], np.float32)
    assert footprint_shares(boxes, (20, 10)) == pytest.approx([0.5, 0.0])


def test_gradient_is_that_of_an_area_that_grows_with_the_scales() -> None:
    """Of a disc towards the camera the box is k s1 times k s2: both axes shrink it evenly."""
    scales = np.array([[0.2, 0.2, 1e-3], [0.3, 0.01, 0.01]], np.float32)
    shares = np.array([0.16, 0.06], np.float32)
    gradients = no_gradients([0, 1])
    gradients.log_scales[...] = 0.25
    add_footprint_regulariser(gradients, np.log(scales), shares, 0.1)
    added = gradients.log_scales - 0.25
    # d area / d log s over both axes of a disc together is twice the area.
    assert added[0, :2] == pytest.approx([0.016, 0.016], rel=1e-3)
    assert added[0, 2] < 1e-5
    assert added[1, 0] == pytest.approx(0.1 * 2 * 0.06, rel=0.01)
    assert (added >= 0).all()

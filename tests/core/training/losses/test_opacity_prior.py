# SPDX-License-Identifier: GPL-3.0-or-later
"""Opacity prior: its value, its gradient, and what it leaves alone."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.render.types import VisibleGradients
from gaussian_wrapping_addon.core.training.losses import FAINT, SURE, add_opacity_prior

SHARES = np.array([1.0, 0.5, 0.12], np.float32)
"""Of the image in the footprints of the first three Gaussians; the fourth is not seen."""


def seen(by_opacity: list[float]) -> VisibleGradients:
    count = len(by_opacity)
    zeros = lambda *shape: np.zeros((count, *shape), np.float32)  # noqa: E731
    opacity = np.array(by_opacity, np.float32)
    ids = np.arange(count, dtype=np.int32)
    return VisibleGradients(ids, zeros(3), zeros(3), zeros(4), opacity, zeros(1, 3), zeros(4))


def logits(opacities: list[float]) -> np.ndarray:
    opacity = np.array(opacities)
    return np.log(opacity / (1.0 - opacity)).astype(np.float32)


def prior(raw: np.ndarray) -> float:
    return add_opacity_prior(seen([1.0, 1.0, 1.0]), raw, SHARES, 0.0)


@pytest.mark.parametrize("opacities", [[0.3, 0.45, 0.6], [0.9, 0.21, 0.99], [0.05, 0.7, 0.5]])
def test_gradient_is_that_of_the_value(opacities: list[float]) -> None:
    raw, step = logits([*opacities, 0.8]), 0.02
    gradients = seen([0.25, -0.25, 0.125])
    add_opacity_prior(gradients, raw, SHARES, 0.3)
    added = gradients.opacity_logits - np.array([0.25, -0.25, 0.125])
    for k in range(3):
        change = np.zeros(4, np.float32)
        change[k] = step
        slope = (prior(raw + change) - prior(raw - change)) / (2.0 * step)
        assert added[k] == pytest.approx(-0.3 * slope, rel=0.02, abs=1e-5)


def test_what_is_opaque_enough_gains_by_more_opacity() -> None:
    gradients = seen([1e-9, 1e-9, 1e-9])
    opacity = np.array([0.5, 0.6, 0.97])
    add_opacity_prior(gradients, logits([*opacity, 0.5]), SHARES, 0.1)
    expected = -0.4 * SHARES * opacity * (1.0 - opacity)
    assert gradients.opacity_logits == pytest.approx(expected, rel=1e-4)
    assert FAINT < SURE <= 0.5


def test_faint_gaussians_are_left_to_the_photos() -> None:
    gradients = seen([0.5, -0.5, 0.5])
    value = add_opacity_prior(gradients, logits([0.02, 0.1, FAINT, 0.9]), SHARES, 1.0)
    assert gradients.opacity_logits == pytest.approx([0.5, -0.5, 0.5], abs=1e-6)
    assert value == pytest.approx(0.0, abs=1e-6)


def test_gaussians_that_no_pixel_asks_about_stay_so() -> None:
    """The optimizer leaves rows alone whose opacity has no gradient."""
    gradients = seen([0.0, 0.5, 0.0])
    add_opacity_prior(gradients, logits([0.9, 0.9, 0.9, 0.9]), SHARES, 1.0)
    assert gradients.opacity_logits[0] == gradients.opacity_logits[2] == 0.0
    assert gradients.opacity_logits[1] < 0.5

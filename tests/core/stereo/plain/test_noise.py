# SPDX-License-Identifier: GPL-3.0-or-later
"""How noisy photos are, and what filters leave of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from gaussian_wrapping_addon.core.stereo.plain.noise import (
    LEAST_PIXELS,
    noise_level,
    smoothed_noise,
    smoothed_step_noise,
)

SHAPE = (240, 320)


def noisy(noise: float, seed: int = 0) -> np.ndarray:
    """Return noise on a ramp of shading."""
    row, column = np.indices(SHAPE)
    shading = 90.0 + 0.2 * row + 30.0 * np.sin(column / 80.0)
    return (shading + noise * np.random.default_rng(seed).normal(size=SHAPE)).astype(np.float32)


WHOLE = np.ones(SHAPE, bool)


@pytest.mark.parametrize("noise", [0.5, 1.5, 6.0])
def test_noise_of_shaded_photos_is_found(noise: float) -> None:
    color = np.stack([noisy(noise, seed) for seed in range(3)], -1)
    assert noise_level(color, WHOLE) == pytest.approx(noise, rel=0.03)


def test_texture_beside_plain_pixels_is_no_noise() -> None:
    image, plain = noisy(1.0), WHOLE.copy()
    image[:, :160] += 40.0 * np.random.default_rng(1).normal(size=(240, 160))
    plain[:, :161] = False
    assert noise_level(image[..., None], plain) == pytest.approx(1.0, rel=0.03)


@pytest.mark.parametrize("level", [0.0, 255.0])
def test_black_and_saturated_parts_tell_nothing(level: float) -> None:
    image = np.rint(noisy(3.0))
    image[:, 100:] = level
    assert noise_level(image[..., None], WHOLE) == pytest.approx(3.0, rel=0.06)


def test_photos_without_plain_pixels_tell_nothing() -> None:
    few = np.zeros(SHAPE, bool)
    few[: LEAST_PIXELS // 10, :9] = True
    assert noise_level(noisy(2.0)[..., None], few) == 0.0
    assert noise_level(noisy(0.0)[..., None], WHOLE) < 0.05


@pytest.mark.parametrize("sigma_px", [0.7, 1.4, 2.0])
def test_filters_leave_as_much_as_is_said(sigma_px: float) -> None:
    smooth = ndimage.gaussian_filter(noisy(5.0) - noisy(0.0), sigma_px, truncate=6.0)
    # The formulas are of continuous filters: samples of a narrow one differ by some per cent.
    assert smoothed_noise(5.0, sigma_px) == pytest.approx(smooth.std(), rel=0.05)
    step = np.diff(smooth, axis=1).std()
    assert smoothed_step_noise(5.0, sigma_px) == pytest.approx(step, rel=0.06)

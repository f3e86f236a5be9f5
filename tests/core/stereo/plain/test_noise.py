# SPDX-License-Identifier: GPL-3.0-or-later
"""How noisy photos are, and what filters leave of it."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from gaussian_wrapping_addon.core.stereo.plane_fitting import (
    BLOCK,
    noise_levels,
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
    color = np.stack([noisy(noise, 0), noisy(noise, 1), noisy(2.0 * noise, 2)], -1)
    assert noise_levels(color, WHOLE) == pytest.approx([noise, noise, 2.0 * noise], rel=0.03)


@pytest.mark.parametrize(
    ("processed", "tolerance"),
    [
        (lambda clean, noise: as_jpeg(clean + noise, 95), 0.15),
        (lambda clean, noise: as_jpeg(clean + noise, 90), 0.35),
        (lambda clean, noise: made_smaller(clean, noise), 0.1),
    ],
    ids=["jpeg_95", "jpeg_90", "lanczos"],
)
def test_noise_of_resized_and_compressed_photos_is_that_of_their_texture(
    processed, tolerance: float
) -> None:
    """Single pixels show three quarters of it after resizing, a quarter after JPEG."""
    clean = noisy(0.0)
    with_noise = processed(clean, 2.0 * np.random.default_rng(0).normal(size=SHAPE))
    without = processed(clean, np.zeros(SHAPE))
    band = [ndimage.gaussian_filter(with_noise - without, sigma) for sigma in (0.7, 5.0)]
    left = (band[0] - band[1])[8:-8, 8:-8].std()
    said = smoothed_noise(noise_levels(with_noise[..., None], WHOLE)[0], 0.7)
    assert said == pytest.approx(left, rel=tolerance)


def as_jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    into = io.BytesIO()
    levels = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    Image.fromarray(levels).save(into, "JPEG", quality=quality)
    return np.asarray(Image.open(into), np.float32)


def made_smaller(clean: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the image made from one of twice the size, whose noise is four times as much."""
    large = (
        np.kron(clean, np.ones((2, 2)))
        + 2.0 * np.random.default_rng(1).normal(size=(2 * SHAPE[0], 2 * SHAPE[1])) * noise.std()
    )
    levels = Image.fromarray(large.astype(np.float32))
    return np.asarray(levels.resize(SHAPE[::-1], Image.Resampling.LANCZOS), np.float32)


def test_texture_beside_plain_pixels_is_no_noise() -> None:
    image, plain = noisy(1.0), WHOLE.copy()
    image[:, :160] += 40.0 * np.random.default_rng(1).normal(size=(240, 160))
    plain[:, :161] = False
    assert noise_levels(image[..., None], plain)[0] == pytest.approx(1.0, rel=0.03)


@pytest.mark.parametrize("level", [0.0, 255.0])
def test_black_and_saturated_parts_tell_nothing(level: float) -> None:
    image = np.rint(noisy(3.0))
    image[:, 100:] = level
    assert noise_levels(image[..., None], WHOLE)[0] == pytest.approx(3.0, rel=0.06)


def test_photos_without_plain_pixels_tell_nothing() -> None:
    few = np.zeros(SHAPE, bool)
    few[:BLOCK, : 3 * BLOCK] = True
    assert noise_levels(noisy(2.0)[..., None], few)[0] == 0.0
    assert noise_levels(noisy(0.0)[..., None], WHOLE)[0] < 0.05


@pytest.mark.parametrize("sigma_px", [0.7, 1.4, 2.0])
def test_filters_leave_as_much_as_is_said(sigma_px: float) -> None:
    smooth = ndimage.gaussian_filter(noisy(5.0) - noisy(0.0), sigma_px, truncate=6.0)
    # The formulas are of continuous filters: samples of a narrow one differ by some per cent.
    assert smoothed_noise(5.0, sigma_px) == pytest.approx(smooth.std(), rel=0.05)
    step = np.diff(smooth, axis=1).std()
    assert smoothed_step_noise(5.0, sigma_px) == pytest.approx(step, rel=0.06)

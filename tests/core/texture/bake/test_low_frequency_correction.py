# SPDX-License-Identifier: GPL-3.0-or-later
"""Low-frequency corrections are recovered; photos without gradients are left unchanged."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.texture.bake import (
    GRID,
    MAX_LOG_CORRECTION,
    solve_low_frequency_correction,
)

PHOTOS, POINTS = 8, 6000


def samples(strength: float, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points at random places of photos, each photo with a gradient of its own."""
    random = np.random.default_rng(3)
    albedo = random.uniform(60.0, 150.0, (POINTS, 1, 3))
    image_positions = random.random((POINTS, PHOTOS, 2)).astype(np.float32)
    slopes = random.normal(size=(PHOTOS, 2))
    slopes -= slopes.mean(axis=0)
    logs = strength * ((image_positions - 0.5) * slopes).sum(axis=2)
    colors = albedo * np.exp(logs + noise * random.normal(size=logs.shape))[..., None]
    valid = random.random((POINTS, PHOTOS)) < 0.4
    return np.rint(colors.clip(0, 255)).astype(np.uint8), valid, image_positions


def corrected_spread(
    colors: np.ndarray, valid: np.ndarray, image_positions: np.ndarray, corrections: np.ndarray
) -> float:
    """Spread of the log colours of a point over the photos that see it."""
    node = np.rint(image_positions * [GRID[1] - 1, GRID[0] - 1]).astype(int)
    factor = corrections[np.arange(PHOTOS)[None], node[..., 1], node[..., 0]]
    logs = np.where(valid[..., None], np.log(np.maximum(colors * factor, 1.0)), np.nan)
    several = valid.sum(axis=1) >= 3
    return float(np.nanstd(logs[several], axis=1).mean())


def test_gradients_within_photos_are_evened() -> None:
    colors, valid, image_positions = samples(0.2)
    corrections, spread = solve_low_frequency_correction(
        colors, valid, image_positions, np.ones((PHOTOS, 3))
    )
    assert corrections.shape == (PHOTOS, *GRID, 3)
    assert spread > 0.03
    none = np.ones_like(corrections)
    before = corrected_spread(colors, valid, image_positions, none)
    assert corrected_spread(colors, valid, image_positions, corrections) < 0.3 * before


def test_a_moving_thing_is_no_brightness() -> None:
    colors, valid, image_positions = samples(0.0)
    passer = ((image_positions[:, 0] - 0.5) ** 2).sum(axis=1) < 0.02
    colors[passer, 0] = 250
    valid[passer, 0] = True
    corrections, _ = solve_low_frequency_correction(
        colors, valid, image_positions, np.ones((PHOTOS, 3))
    )
    assert np.abs(np.log(corrections)).max() <= MAX_LOG_CORRECTION
    outside = corrections[0, 0] if corrections.shape[1] > 1 else corrections[0]
    assert np.abs(np.log(outside)).max() < 0.05


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_even_photos_are_left_alone(noise: float) -> None:
    colors, valid, image_positions = samples(0.0, noise)
    corrections, spread = solve_low_frequency_correction(
        colors, valid, image_positions, np.ones((PHOTOS, 3))
    )
    assert (corrections == 1.0).all()
    assert spread < 0.008


def test_points_that_one_photo_sees_say_nothing() -> None:
    colors, valid, image_positions = samples(0.3)
    valid[:] = False
    valid[:, 0] = True
    corrections, spread = solve_low_frequency_correction(
        colors, valid, image_positions, np.ones((PHOTOS, 3))
    )
    assert (corrections == 1.0).all()
    assert spread == 0.0

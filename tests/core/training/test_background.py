# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks as background: compositing, its gradients, points inside masks."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.parallel import ArrayStore
from gaussian_wrapping_addon.core.training.background import (
    background_gradient,
    composited,
    draw_background,
    inside_masks,
)
from tests.core.render.scenes import look_at


def images(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    alpha = random.uniform(size=(14, 17))
    color = random.uniform(size=(14, 17, 3)) * alpha[..., None]
    photo = random.integers(0, 256, (14, 17, 3), np.uint8)
    mask = np.zeros((14, 17), bool)
    mask[3:11, 4:15] = True
    return color, alpha, photo, mask, draw_background(random).astype(np.float64)


def test_render_and_photo_stand_over_the_same_colour() -> None:
    color, alpha, photo, mask, background = images()
    image, target = composited(color, alpha, photo, mask, background)
    np.testing.assert_allclose(image, color + (1 - alpha[..., None]) * background, rtol=1e-14)
    assert (target[~mask] == background).all()
    np.testing.assert_allclose(target[mask], photo[mask] / 255.0, rtol=1e-14)
    _, whole = composited(color, alpha, photo, None, background)
    np.testing.assert_allclose(whole, photo / 255.0, rtol=1e-14)
    stored = composited(color, alpha, photo / 255.0, mask, background, store=ArrayStore())
    assert np.array_equal(stored[0], image)
    np.testing.assert_allclose(stored[1], target, rtol=1e-14)


def test_gradients_are_central_differences_of_a_loss() -> None:
    color, alpha, photo, mask, background = images(1)

    def value() -> float:
        image, target = composited(color, alpha, photo, mask, background)
        return float(np.sin(3 * image - target).sum())

    image, target = composited(color, alpha, photo, mask, background)
    by_image = 3 * np.cos(3 * image - target)
    by_alpha = background_gradient(by_image, background)
    for array, by_array in ((color, by_image), (alpha, by_alpha)):
        flat, found = array.reshape(-1), by_array.reshape(-1)
        for at in range(0, flat.size, 7):
            kept = flat[at]
            flat[at] = kept + 1e-5
            up = value()
            flat[at] = kept - 1e-5
            slope = (up - value()) / 2e-5
            flat[at] = kept
            assert found[at] == pytest.approx(slope, rel=1e-6, abs=1e-6)


def test_emptiness_where_masked_out_costs_nothing_whatever_the_colour() -> None:
    _, _, photo, mask, _ = images(2)
    truth = np.where(mask[..., None], photo / 255.0, 0.0)
    random = np.random.default_rng(0)
    for _ in range(3):
        background = draw_background(random)
        empty = composited(truth, mask.astype(float), photo, mask, background)
        assert np.abs(empty[0] - empty[1]).max() < 1e-12
        filled = composited(truth, np.ones(mask.shape), photo, mask, background)
        assert np.abs(filled[0] - filled[1]).mean() > 0.01


def test_points_inside_of_masks() -> None:
    cameras = [
        look_at(eye, width=40, height=30, focal=50.0, name=f"{i}.png")
        for i, eye in enumerate([(4.0, 0.0, 0.3), (0.0, 4.0, 0.3), (-4.0, 0.0, 0.3)])
    ]
    mask = np.zeros((30, 40), bool)
    mask[8:22, 13:27] = True
    masks = [mask] * 3
    points = np.array(
        [
            [0.0, 0.0, 0.0],  # in all masks
            [0.0, 1.0, 0.0],  # beside the masks of two, inside that of the third
            [0.0, 0.0, 50.0],  # in no image
            [np.nan, 0.0, 0.0],
        ]
    )
    assert inside_masks(points, cameras, masks).tolist() == [True, False, False, False]
    open_masks = [None, masks[1], None]
    assert inside_masks(points, cameras, open_masks).tolist() == [True, True, False, False]
    assert inside_masks(np.zeros((0, 3)), cameras, masks).shape == (0,)
    assert not inside_masks(points, [], []).any()

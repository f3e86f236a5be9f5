# SPDX-License-Identifier: GPL-3.0-or-later
"""Sampled pixels: distinct, inside the mask, stratified, more of them on texture."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.training.multi_view import choose_pixels, grey_image

HEIGHT, WIDTH = 60, 80


def half_textured() -> np.ndarray:
    """Return grey that is noise in its right half and constant in the left one."""
    grey = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    grey[:, 40:] = np.random.default_rng(0).uniform(size=(HEIGHT, 40))
    return grey


def choose(
    grey: np.ndarray,
    count: int,
    *,
    depth: np.ndarray | None = None,
    mask: np.ndarray | None = None,
    seed: int = 0,
    threads: int = 1,
) -> np.ndarray:
    depth = np.ones(grey.shape, np.float32) if depth is None else depth
    return choose_pixels(grey, depth, mask, count, np.random.default_rng(seed), threads=threads)


def test_half_of_them_follow_the_texture() -> None:
    pixels = choose(half_textured(), 400)
    assert len(np.unique(pixels)) == len(pixels)
    assert 300 < len(pixels) <= 400
    row, column = np.divmod(pixels, WIDTH)
    assert row.min() >= 2
    assert column.min() >= 2
    assert row.max() < HEIGHT - 2
    assert column.max() < WIDTH - 2
    assert 0.18 < (column < 38).mean() < 0.32


def test_strata_spread_them_out() -> None:
    grey = np.full((64, 64), 0.5, np.float32)
    row, column = np.divmod(choose(grey, 225), 64)
    counts = np.histogram2d(row, column, bins=[[8, 24, 40, 56]] * 2)[0]
    assert np.abs(counts - 16).max() <= 4  # independent draws would scatter by 4, often by 8


def test_only_pixels_with_depth_inside_the_mask() -> None:
    random = np.random.default_rng(1)
    depth = np.where(random.uniform(size=(HEIGHT, WIDTH)) < 0.5, 1.0, 0.0).astype(np.float32)
    depth[random.uniform(size=depth.shape) < 0.1] = np.nan
    mask = random.uniform(size=depth.shape) < 0.5
    pixels = choose(half_textured(), 200, depth=depth, mask=mask)
    assert len(pixels) > 100
    assert (depth.ravel()[pixels] > 0).all()
    assert mask.ravel()[pixels].all()


def test_all_of_them_where_as_many_are_asked_for() -> None:
    grey = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    assert len(choose(grey, 20_000)) == (HEIGHT - 4) * (WIDTH - 4)


def test_none() -> None:
    grey = half_textured()
    assert len(choose(grey, 50, depth=np.zeros_like(grey))) == 0
    assert len(choose(grey[:4, :4], 50)) == 0
    assert len(choose(np.full_like(grey, np.nan), 50)) == 0


def test_same_numbers_same_pixels() -> None:
    grey = half_textured()
    assert np.array_equal(choose(grey, 300), choose(grey, 300, threads=3))
    assert not np.array_equal(choose(grey, 300), choose(grey, 300, seed=1))
    states = []
    for depth in (np.ones_like(grey), np.zeros_like(grey)):
        random = np.random.default_rng(4)
        choose_pixels(grey, depth, None, 100, random, threads=1)
        states.append(random.random())
    assert states[0] == states[1]


def test_grey_of_bytes_and_floats() -> None:
    photo = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    wanted = photo @ [0.299, 0.587, 0.114] / 255
    assert grey_image(photo, "grey", threads=1) == pytest.approx(wanted, abs=1e-6)
    assert grey_image(photo / 255.0, "grey", threads=2) == pytest.approx(wanted, abs=1e-6)

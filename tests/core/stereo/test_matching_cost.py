# SPDX-License-Identifier: GPL-3.0-or-later
"""Cost of true and of moved planes in photos of a plane with a pattern."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.stereo.matching import (
    AT_X,
    AT_Y,
    SAMPLES,
    SHADING_COST,
    WEIGHT,
    WEIGHTED_GREY,
    WINDOW,
    WORST_COST,
    fill_window,
    view_cost,
)
from tests.core.stereo.textured_plane import level_of, plane_photos, true_planes

PIXELS = [(20, 32), (16, 26), (30, 36), (24, 30)]
"""Rows and columns whose windows all photos show."""

NEAR, ALIKE = np.ones(SAMPLES, np.float32), np.ones(256, np.float32)


def costs(
    other: np.ndarray,
    pixels: list[tuple[int, int]] = PIXELS,
    *,
    depth: float = 1.0,
    geometric: float = 0.0,
    brightness: tuple[float, float] = (1.0, 0.0),
    first: np.ndarray | None = None,
) -> np.ndarray:
    """Return the cost of planes at ``depth`` times the true one, in the second photo."""
    given, photos = plane_photos()
    first = photos[0] if first is None else first
    level = level_of([first, other, photos[2]], list(given))
    for view, camera in enumerate(given):
        level.planes_of(view)[:] = true_planes(camera)
    maps, back_maps, sizes, bases = level._joined[0]
    table = np.empty((6, SAMPLES), np.float32)
    table[AT_X], table[AT_Y] = WINDOW.T
    found = []
    for row, column in pixels:
        mean, variance = fill_window.py_func(first, row, column, NEAR, ALIKE, table)
        plane = (true_planes(given[0])[row, column] / depth).astype(np.float32)
        found.append(
            view_cost.py_func(
                0, np.float32(column), np.float32(row), *plane, maps, back_maps, level._quads,
                sizes, bases, level._stride, np.tile(np.float32(brightness), (2, 1)),
                level.inverse_depths(), np.float32(geometric), table, np.empty(SAMPLES, np.int32),
                np.float32(mean), np.float32(variance),
            )
        )  # fmt: skip
    return np.array(found)


def test_true_planes_cost_nothing_and_moved_ones_much_more() -> None:
    _, photos = plane_photos()
    assert costs(photos[1]).max() < 0.05
    for depth in (0.94, 1.06):
        assert costs(photos[1], depth=depth).min() > 0.07
    assert costs(photos[1], depth=0.75).min() > 0.5


def test_gain_and_offset_of_the_other_photo_do_not_matter() -> None:
    _, photos = plane_photos()
    darker = np.round(0.6 * photos[1].astype(float) + 30).astype(np.uint8)
    assert np.abs(costs(darker) - costs(photos[1])).max() < 0.02
    negative = 255 - photos[1]
    assert costs(negative).min() == WORST_COST


def test_a_photo_of_one_grey_costs_1_for_all_planes() -> None:
    flat = np.full_like(plane_photos()[1][1], 90)
    for depth in (0.9, 1.0, 1.1):
        assert costs(flat, depth=depth) == pytest.approx(1.0, abs=1e-3)


def test_a_plain_window_costs_by_how_much_its_brightness_differs() -> None:
    tolerance = 10.0
    plain = np.full_like(plane_photos()[1][0], 90)
    for level, gain, added in ((90, 1.0, 0.0), (91, 1.0, 0.1), (100, 1.0, 1.0), (80, 1.125, 0.0)):
        other = np.full_like(plain, level)
        found = costs(other, first=plain, brightness=(gain, 1.0 / tolerance))
        expected = min(1.0 + added * float(SHADING_COST), float(WORST_COST))
        assert found == pytest.approx(expected, abs=2e-3)


def test_brightness_hardly_counts_where_there_is_texture() -> None:
    _, photos = plane_photos()
    assert costs(photos[1], brightness=(1.2, 1.0)).max() < 0.15


def test_windows_that_leave_the_photo_cost_most() -> None:
    _, photos = plane_photos()
    assert (costs(photos[1], [(0, 0), (47, 63), (24, 1)]) == WORST_COST).all()


def test_depths_that_do_not_lead_back_cost_more() -> None:
    _, photos = plane_photos()
    plain = costs(photos[1])
    assert costs(photos[1], geometric=0.5) == pytest.approx(plain, abs=0.1)
    moved, checked = (costs(photos[1], depth=1.03, geometric=g) for g in (0.0, 0.5))
    assert (checked - moved).min() > 0.1


def test_the_window_is_weighted_and_clamped_at_the_border() -> None:
    random = np.random.default_rng(0)
    grey = random.integers(0, 256, (20, 30)).astype(np.uint8)
    near = random.uniform(0.1, 1, SAMPLES).astype(np.float32)
    alike = np.exp(-np.arange(256) / 40).astype(np.float32)
    table = np.empty((6, SAMPLES), np.float32)
    for row, column in ((10, 15), (0, 29)):
        mean, variance = fill_window.py_func(grey, row, column, near, alike, table)
        rows = np.clip(row + WINDOW[:, 1], 0, 19)
        columns = np.clip(column + WINDOW[:, 0], 0, 29)
        levels = grey[rows, columns].astype(float)
        weight = near * alike[np.abs(levels - grey[row, column]).astype(int)]
        weight = weight / weight.sum()
        assert table[WEIGHT] == pytest.approx(weight, rel=1e-4)
        assert mean == pytest.approx(weight @ levels, rel=1e-4)
        assert variance == pytest.approx(weight @ (levels - weight @ levels) ** 2, rel=1e-3)
        assert table[WEIGHTED_GREY] == pytest.approx(weight * (levels - mean), abs=1e-3)

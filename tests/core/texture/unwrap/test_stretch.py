# SPDX-License-Identifier: GPL-3.0-or-later
"""Texture stretch against maps whose stretch is known."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.texture.unwrap.charts import texture_stretch

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def uvs_of(points: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    return (points[:, :2] * scale)[FACES].astype(np.float32)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("away", [0.0, 100.0])
def test_an_even_map_has_none(size: float, away: float) -> None:
    stretch = texture_stretch((SQUARE + away) * size, FACES, uvs_of(SQUARE, (0.25, 0.25)))
    assert abs(stretch.mean - 1.0) < 1e-6
    assert abs(stretch.p95 - 1.0) < 1e-6
    assert stretch.collapsed_share == 0.0


def test_a_map_twice_as_wide_as_high() -> None:
    # Relative to the mean scale a step moves by sqrt(2) and by 1 / sqrt(2).
    stretch = texture_stretch(SQUARE, FACES, uvs_of(SQUARE, (0.2, 0.4)))
    assert abs(stretch.mean - np.sqrt((2.0 + 0.5) / 2)) < 1e-6


def test_it_is_weighted_by_area() -> None:
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    uvs = np.array([[[0, 0], [0.3, 0], [0, 0.3]], [[0, 0], [0.01, 0], [0, 0.01]]], np.float32)
    stretch = texture_stretch(vertices, faces, uvs)
    scale = np.sqrt(10.0 / 0.0901)
    assert abs(stretch.mean - (0.9 * 10 + 0.1 * 100) / scale) < 1e-5
    assert abs(stretch.p95 - 100 / scale) < 1e-5


def test_collapsed_faces_are_counted_and_not_measured() -> None:
    uvs = uvs_of(SQUARE, (0.25, 0.25))
    uvs[1] = uvs[0, 0]
    stretch = texture_stretch(SQUARE, FACES, uvs)
    assert abs(stretch.mean - 1.0) < 1e-6
    assert stretch.collapsed_share == 0.5

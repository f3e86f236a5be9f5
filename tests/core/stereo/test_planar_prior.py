# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes of triangles between samples of a plane; which points a photo shows."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.stereo.depth_maps import (
    plane_normals,
    points_in_view,
    triangle_planes,
)
from tests.core.stereo.textured_plane import NORMAL, cameras, true_planes

CAMERA = cameras(1)[0]
PLANES = true_planes(CAMERA)


def sampled(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    pixels = random.uniform((12, 10), (52, 38), (count, 2))
    middle = PLANES[24, 32]
    return pixels, middle[0] + middle[1] * (pixels[:, 0] - 32) + middle[2] * (pixels[:, 1] - 24)


def test_the_plane_of_its_points_is_reproduced_and_nothing_beside_them() -> None:
    pixels, inverse = sampled()
    found = triangle_planes(pixels, inverse, CAMERA)
    there = found[..., 0] > 0
    assert found.dtype == np.float32
    assert there[16:32, 20:44].all()
    assert found[there] == pytest.approx(PLANES[there], rel=1e-5)
    row, column = np.nonzero(there)
    assert column.min() >= pixels[:, 0].min()
    assert column.max() <= pixels[:, 0].max()
    assert row.min() >= pixels[:, 1].min()
    assert row.max() <= pixels[:, 1].max()
    assert not found[~there].any()


def test_triangles_across_an_edge_are_dropped() -> None:
    random = np.random.default_rng(1)
    pixels = random.uniform((2, 2), (62, 46), (400, 2))
    inverse = np.where(pixels[:, 0] < 32, 1.0, 0.1)  # near on the left, far on the right
    found = triangle_planes(pixels, inverse, CAMERA)[4:44, 4:60]
    there = found[..., 0] > 0
    assert np.isin(np.round(found[there][:, 0], 3), (1.0, 0.1)).mean() > 0.99
    assert there.mean() > 0.8
    assert not there[:, 27:29].all()


def test_few_points_and_points_on_a_line_give_nothing() -> None:
    pixels, inverse = sampled()
    assert not triangle_planes(pixels[:3], inverse[:3], CAMERA).any()
    assert not triangle_planes(pixels[:0], inverse[:0], CAMERA).any()
    line = np.stack([np.arange(10.0), np.full(10, 7.0)], 1)
    assert not triangle_planes(line, np.ones(10), CAMERA).any()
    same = np.tile(pixels[:1], (10, 1))
    assert not triangle_planes(same, np.ones(10), CAMERA).any()


def test_normals_are_those_of_the_plane() -> None:
    normals = plane_normals(PLANES, CAMERA) @ CAMERA.rotation
    assert normals == pytest.approx(np.broadcast_to(-NORMAL, normals.shape), abs=1e-9)


def test_points_behind_others_are_hidden() -> None:
    ray = (CAMERA.rays()[20, 30] + [0.001, 0.001, 0]) @ CAMERA.rotation
    points = CAMERA.center + np.array([2.0, 2.1, 3.0])[:, None] * ray
    beside = CAMERA.center + 3.0 * CAMERA.rays()[40, 50] @ CAMERA.rotation
    away = CAMERA.center - ray
    pixels, inverse = points_in_view(CAMERA, np.concatenate([points, [beside, away]]))
    assert sorted(1 / inverse) == pytest.approx([2.0, 2.1, 3.0])
    assert pixels[np.argmax(np.abs(pixels[:, 0] - 30))] == pytest.approx([50, 40], abs=1e-6)


def test_points_behind_known_depths_are_hidden() -> None:
    pixels = np.array([[30.0, 20.0], [40.0, 20.0], [50.0, 20.0]])
    depth = np.array([0.9, 1.0, 1.1]) / PLANES[20, [30, 40, 50], 0]
    rays = CAMERA.rays()[20, [30, 40, 50]]
    points = CAMERA.center + depth[:, None] * rays @ CAMERA.rotation
    shown, inverse = points_in_view(CAMERA, points, PLANES[..., 0])
    assert shown == pytest.approx(pixels[:2], abs=1e-6)
    assert inverse == pytest.approx(1 / depth[:2])


def test_a_photo_may_show_no_point() -> None:
    for known in (None, PLANES[..., 0]):
        pixels, inverse = points_in_view(CAMERA, np.array([[0.0, 0.0, 99.0]]), known)
        assert pixels.shape == (0, 2)
        assert inverse.shape == (0,)

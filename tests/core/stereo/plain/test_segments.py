# SPDX-License-Identifier: GPL-3.0-or-later
"""Which pixels are plain, and what is known around them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gaussian_wrapping_addon.core.stereo.plane_fitting import (
    INSIDE_WEIGHT,
    SPARSE_WEIGHT,
    plain_pixels,
    segments_of,
)
from tests.core.stereo.plain.plain_room import (
    SKY,
    WALL,
    cameras,
    depth_maps,
    near,
    noisy_maps,
    sparse_points,
    traced,
)


def test_wall_and_sky_are_plain_and_texture_is_not() -> None:
    for camera, found in zip(cameras(), depth_maps(), strict=True):
        part = traced(camera)[1]
        plain, _ = plain_pixels(found)
        for number in (WALL, SKY):
            assert plain[(part == number) & ~near(part != number, 3)].all()
        textured = (part != WALL) & (part != SKY)
        assert plain[textured].mean() < 0.5


@pytest.mark.parametrize("noise", [1.5, 3.0, 5.0])
def test_noise_neither_breaks_the_wall_nor_makes_texture_plain(noise: float) -> None:
    for camera, found in zip(cameras(), noisy_maps(noise), strict=True):
        part = traced(camera)[1]
        plain, _ = plain_pixels(found)
        inner = (part == WALL) & ~near(part != WALL, 7)
        assert plain[inner].mean() > 0.98
        textured = (part != WALL) & (part != SKY)
        assert plain[textured].mean() < 0.5


def test_masks_are_left_out() -> None:
    mask = np.zeros(depth_maps()[0].depth.shape, bool)
    mask[:, :80] = True
    plain, _ = plain_pixels(dataclasses.replace(depth_maps()[0], mask=mask))
    assert not plain[:, 80:].any()
    assert plain[:, :80].any()


def test_large_segments_are_wall_and_sky_with_depths_around_the_wall() -> None:
    for view, camera in enumerate(cameras()):
        depth, part, _ = traced(camera)
        found = [s for s in segments_of(depth_maps()[view : view + 1], sparse_points()) if s.large]
        inside = {int(np.median(part[s.rows, s.columns])): s for s in found}
        assert {WALL, SKY} <= set(inside)
        wall = inside[WALL]
        column, row = np.rint(wall.places).astype(int).T
        exact = np.abs(wall.inverse_depths * depth[row, column] - 1.0) < 0.05
        assert exact.mean() > 0.98
        assert wall.unknown > 0.5
        assert set(np.unique(wall.weights)) <= {INSIDE_WEIGHT, 1.0, SPARSE_WEIGHT}


def test_extent_is_the_covariance_of_the_pixels() -> None:
    segment = segments_of(depth_maps()[:1], sparse_points())[0]
    assert np.allclose(segment.extent, np.cov(np.stack([segment.columns, segment.rows])))

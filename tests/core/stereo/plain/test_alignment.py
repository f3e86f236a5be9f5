# SPDX-License-Identifier: GPL-3.0-or-later
"""Faint texture places a plane, and tells planes that are no surface."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gaussian_wrapping_addon.core.stereo.plain.alignment import Aligner, Part
from gaussian_wrapping_addon.core.stereo.plain.evidence import packed
from gaussian_wrapping_addon.core.stereo.plain.segments import plain_pixels
from tests.core.stereo.plain.plain_room import (
    WALL,
    WALL_Y,
    cameras,
    depth_maps,
    near,
    traced,
)
from tests.core.stereo.plain.test_planes import wall_plane


def aligner_of(maps) -> Aligner:
    photos = packed(maps, np.random.default_rng(0))
    plain = np.stack([plain_pixels(found) for found in maps])
    return Aligner(photos, plain, np.random.default_rng(0))


def wall_parts() -> list[Part]:
    parts = []
    for view, camera in enumerate(cameras()):
        part = traced(camera)[1]
        row, column = np.nonzero((part == WALL) & ~near(part != WALL, 4))
        parts.append(Part(view, np.stack([column, row], 1).astype(float)))
    return parts


@pytest.mark.parametrize("away", [0.06, -0.06])
def test_a_plane_is_moved_to_where_the_texture_matches(away: float) -> None:
    turn = np.array([0.0, np.cos(0.008), np.sin(0.008)])
    start = wall_plane().moved(turn, float(turn @ [0.0, WALL_Y + away, 1.2]))
    found = aligner_of(depth_maps()).aligned(start, wall_parts())
    assert found is not None
    corners = np.array([[-1.5, WALL_Y, 0.3], [1.5, WALL_Y, 0.3], [1.5, WALL_Y, 2.0]])
    before = np.abs(corners @ start.normal - start.offset).max()
    after = np.abs(corners @ found.normal - found.offset).max()
    assert after < 0.55 * before


def test_a_plane_far_from_the_surface_is_none() -> None:
    start = wall_plane().moved(np.array([0.0, 1.0, 0.0]), 0.6 * WALL_Y)
    assert aligner_of(depth_maps()).aligned(start, wall_parts()) is None


def test_without_texture_a_plane_stays() -> None:
    maps = []
    for found in depth_maps():
        color = found.color.copy()
        color[traced(found.camera)[1] == WALL] = (140, 136, 130)
        maps.append(dataclasses.replace(found, color=color))
    start = wall_plane(WALL_Y + 0.05)
    assert aligner_of(maps).aligned(start, wall_parts()) is start


def test_small_parts_do_not_move_a_plane() -> None:
    parts = [Part(part.view, part.pixels[:50]) for part in wall_parts()]
    start = wall_plane(WALL_Y + 0.05)
    assert aligner_of(depth_maps()).aligned(start, parts) is start

# SPDX-License-Identifier: GPL-3.0-or-later
"""Tile lists by area: all Gaussians that reach any point of a tile."""

from __future__ import annotations

import dataclasses

import numpy as np

from gaussian_wrapping_addon.core.render.area_lists import list_areas
from gaussian_wrapping_addon.core.render.depth_query import query_view
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.types import RenderOptions
from tests.core.render.query_scenes import scene


def test_area_lists_hold_every_gaussian_that_reaches_a_tile() -> None:
    gaussians, camera = scene("thin", seed=1)
    view = query_view(RawArrays.from_gaussians(gaussians), camera, RenderOptions(threads=1))
    lists = view.lists
    random = np.random.default_rng(5)
    q = view.screen.params.astype(np.float64)
    missing = reached = 0
    for tile in range(lists.tiles_x * lists.tiles_y):
        listed = set(lists.gaussian_ids[lists.start[tile] : lists.start[tile + 1]].tolist())
        corner = np.array([tile % lists.tiles_x, tile // lists.tiles_x]) * 16
        places = corner + random.uniform(0.0, 16.0, (1500, 2))
        dx, dy = (places[:, i, None] - q[:, i] for i in range(2))  # (p, n)
        num = q[:, 2] * dx * dx + q[:, 3] * dx * dy + q[:, 4] * dy * dy
        den = 1.0 + 2.0 * (q[:, 5] * dx + q[:, 6] * dy)
        den = den + q[:, 7] * dx * dx + q[:, 8] * dx * dy + q[:, 9] * dy * dy
        alpha = q[:, 11] * np.exp(-0.5 * num / den)
        hit = set(np.flatnonzero((alpha >= 1.0 / 255.0).any(0)).tolist())
        missing += len(hit - listed)
        reached += len(listed & hit)
    assert missing == 0
    # Nor does it list much that reaches nothing.
    assert reached > 0.85 * len(lists.gaussian_ids)
    other = list_areas(view.screen, camera.width, camera.height, 3)
    for field in dataclasses.fields(lists):
        assert np.array_equal(getattr(lists, field.name), getattr(other, field.name)), field.name

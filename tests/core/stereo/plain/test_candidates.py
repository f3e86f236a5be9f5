# SPDX-License-Identifier: GPL-3.0-or-later
"""What the known depths of one segment propose, and what they cannot tell."""

from __future__ import annotations

import dataclasses

import numpy as np

from gaussian_wrapping_addon.core.stereo.plane_fitting import (
    LEAST_SPREAD,
    LEAST_WEIGHT,
    Segment,
    proposed_planes,
    segments_of,
    spreads,
)
from tests.core.stereo.plain.plain_room import (
    WALL,
    WALL_Y,
    cameras,
    depth_maps,
    sparse_points,
    traced,
)


def wall_segment(view: int) -> Segment:
    part = traced(cameras()[view])[1]
    found = [s for s in segments_of(depth_maps()[view : view + 1], sparse_points()) if s.large]
    return next(s for s in found if np.median(part[s.rows, s.columns]) == WALL)


def with_places(segment: Segment, chosen: np.ndarray) -> Segment:
    return dataclasses.replace(
        segment,
        places=segment.places[chosen],
        inverse_depths=segment.inverse_depths[chosen],
        weights=segment.weights[chosen],
    )


def test_the_wall_is_proposed() -> None:
    for view, camera in enumerate(cameras()):
        found = list(proposed_planes(wall_segment(view), camera, np.random.default_rng(0)))
        best = min(found, key=lambda p: 1 - abs(p.normal[1]))
        assert abs(best.normal[1]) > 0.9995
        assert abs(abs(best.offset) - WALL_Y) < 0.03
        assert best.views == {0}


def test_an_edge_alone_proposes_nothing() -> None:
    """Depths along the foot of the wall fit every plane through it."""
    for view, camera in enumerate(cameras()):
        segment = wall_segment(view)
        column, row = np.rint(segment.places).astype(int).T
        points = traced(camera)[2][row, column]
        foot = (np.abs(points[:, 1] - WALL_Y) < 0.15) & (points[:, 2] < 0.15)
        assert segment.weights[foot].sum() > LEAST_WEIGHT
        edge = with_places(segment, foot)
        assert not list(proposed_planes(edge, camera, np.random.default_rng(0)))


def test_too_few_known_depths_propose_nothing() -> None:
    segment = wall_segment(0)
    few = with_places(segment, np.arange(len(segment.places)) < 10)
    assert not list(proposed_planes(few, cameras()[0], np.random.default_rng(0)))


def test_spread_is_one_for_all_pixels_and_none_for_a_line() -> None:
    segment = wall_segment(0)
    every = dataclasses.replace(
        segment, places=segment.pixels, inverse_depths=np.ones(len(segment.pixels)),
        weights=np.ones(len(segment.pixels)),
    )  # fmt: skip
    line = segment.rows == np.median(segment.rows)
    found = spreads(np.stack([np.ones(len(segment.rows), bool), line]), every)
    assert abs(found[0] - 1.0) < 1e-3
    assert found[1] < 1e-3 < LEAST_SPREAD

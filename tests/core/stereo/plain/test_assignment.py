# SPDX-License-Identifier: GPL-3.0-or-later
"""Which planes a segment gets."""

from __future__ import annotations

import dataclasses

import numpy as np

from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.stereo.plane_evidence import Aligner, packed
from gaussian_wrapping_addon.core.stereo.plane_filling import (
    Assignment,
    PlaneSet,
    assigned,
    continued,
    lies_far,
)
from gaussian_wrapping_addon.core.stereo.plane_fitting import Segment, segments_of
from tests.core.stereo.plain.plain_room import (
    SKY,
    WALL,
    cameras,
    depth_maps,
    sparse_points,
    traced,
)
from tests.core.stereo.plain.test_candidates import wall_segment
from tests.core.stereo.plain.test_planes import wall_plane


def known(*, with_texture: bool = False) -> PlaneSet:
    """Return the floor extended, the wall, and a plane parallel to the wall in the air."""
    floor = wall_plane().moved(np.array([0.0, 0.0, 1.0]), 0.0)
    planes = [floor, wall_plane(), wall_plane(2.0)]
    photos = packed(depth_maps(), np.random.default_rng(0))
    if not with_texture:
        return PlaneSet(planes, photos)
    segments = segments_of(depth_maps(), sparse_points())
    aligner = Aligner(photos, segments, np.random.default_rng(0), Progress())
    return PlaneSet(planes, photos, aligner)


def test_the_wall_gets_the_wall() -> None:
    planes = known()
    for view in range(len(cameras())):
        segment = dataclasses.replace(wall_segment(view), view=view)
        for first in (True, False):
            found = assigned(segment, planes, first=first)
            assert found is not None
            assert 1 in found.planes
            inverse = found.inverse_depths(planes.on_planes(segment, found))
            depth, part, _ = traced(cameras()[view])
            wall = part[segment.rows, segment.columns] == WALL
            error = np.abs(inverse * depth[segment.rows, segment.columns] - 1.0)
            assert (error[wall] < 1e-6).mean() > 0.95


def test_the_sky_gets_nothing() -> None:
    planes = known()
    for segment in segments_of(depth_maps(), sparse_points()):
        part = traced(cameras()[segment.view])[1][segment.rows, segment.columns]
        if segment.large and np.median(part) == SKY:
            assert assigned(segment, planes, first=False) is None


def test_without_planes_there_is_nothing_to_assign() -> None:
    assert assigned(wall_segment(0), PlaneSet([], known().photos), first=True) is None


def test_two_planes_meet_where_one_is_nearer() -> None:
    each = np.array([[0.5, 0.4], [0.3, 0.4]])
    near, far = Assignment((3, 5), nearer=True), Assignment((3, 5))
    assert near.inverse_depths(each).tolist() == [0.5, 0.4]
    assert far.inverse_depths(each).tolist() == [0.4, 0.3]
    assert near.owners(each).tolist() == [0, 1]
    assert far.owners(each).tolist() == [1, 0]


def halves_of(segment: Segment) -> list[Segment]:
    """Return a segment's pixels to the left and to the right of its middle."""
    middle = int(np.median(segment.columns))
    return [
        dataclasses.replace(segment, rows=segment.rows[half], columns=segment.columns[half])
        for half in (segment.columns < middle - 2, segment.columns > middle + 2)
    ]


def sky_segment(view: int) -> Segment:
    part = traced(cameras()[view])[1]
    return next(
        s
        for s in segments_of(depth_maps(), sparse_points())
        if s.view == view and s.large and np.median(part[s.rows, s.columns]) == SKY
    )


def test_segments_of_like_colour_nearby_are_continued_and_others_are_not() -> None:
    halves = halves_of(dataclasses.replace(wall_segment(3), view=3))
    found = continued([*halves, sky_segment(3)], [Assignment((1,)), None, None], known())
    assert found == [Assignment((1,)), Assignment((1,)), None]


def test_what_is_far_is_continued() -> None:
    far = Assignment(())
    halves = halves_of(sky_segment(3))
    assert continued(halves, [far, None], known(with_texture=True)) == [far, far]


def test_the_sky_lies_far_and_the_wall_does_not() -> None:
    photos = packed(depth_maps(), np.random.default_rng(0))
    far = {SKY: [], WALL: []}
    for segment in segments_of(depth_maps(), sparse_points()):
        part = int(np.median(traced(cameras()[segment.view])[1][segment.rows, segment.columns]))
        if segment.large and part in far:
            far[part].append(lies_far(segment, photos))
    assert sum(far[SKY]) >= 0.7 * len(far[SKY]) > 0
    assert not any(far[WALL])
    assert far[WALL]
    assert Assignment(()).far
    assert not Assignment((0,)).far

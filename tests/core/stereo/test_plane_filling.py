# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes through plain parts: assigned to segments, depths filled."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.stereo.plane_evidence import Aligner, packed
from gaussian_wrapping_addon.core.stereo.plane_filling import (
    FILLED_CONFIDENCE,
    KEPT_SHARE,
    Assignment,
    PlaneSet,
    assigned,
    continued,
    fill_plain_parts,
    lies_far,
)
from gaussian_wrapping_addon.core.stereo.plane_fitting import Segment, segments_of
from tests.core.stereo.ball_scene import ball_maps, ball_scene, true_depth
from tests.core.stereo.plain_room import (
    FLOOR,
    PICTURE,
    SKY,
    WALL,
    cameras,
    depth_map,
    depth_maps,
    near,
    sparse_points,
    traced,
)
from tests.core.stereo.test_plane_fitting import wall_plane, wall_segment

# -- Which planes a segment gets ------------------------------------------------------------------


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


# -- Plain parts lie on the planes that their borders, other photos and faint texture agree on ----


def assert_wall_is_filled(filled) -> None:
    for camera, found in zip(cameras(), filled, strict=True):
        depth, part, _ = traced(camera)
        wall = part == WALL
        known = found.confidence > 0
        error = np.abs(found.depth[wall & known] / depth[wall & known] - 1.0)
        assert known[wall].mean() > 0.9
        assert error.max() < KEPT_SHARE
        assert np.abs(found.normal[wall & known] - [0.0, -1.0, 0.0]).max() < 0.02
        assert not known[(part == SKY) & ~near(part != SKY, 3)].any()


def test_the_wall_gets_its_plane_and_the_sky_none() -> None:
    filled = fill_plain_parts(depth_maps(), sparse_points(), Progress())
    assert_wall_is_filled(filled)
    for camera, before, after in zip(cameras(), depth_maps(), filled, strict=True):
        part = traced(camera)[1]
        textured = ((part == FLOOR) | (part == PICTURE)) & (before.confidence > 0)
        assert np.array_equal(after.depth[textured], before.depth[textured])
        new = (after.confidence > 0) & (before.confidence == 0)
        assert (after.confidence[new] == np.float32(FILLED_CONFIDENCE)).all()
        assert (after.agreeing[new] > 0).all()


def test_borrowed_depths_on_the_wall_are_replaced() -> None:
    maps = []
    for camera, found in zip(cameras(), depth_maps(), strict=True):
        depth, part, _ = traced(camera)
        wrong = np.zeros(part.shape, bool)
        wrong[30:60, 60:75] = True  # confirmed by windows without texture, a tenth too near
        wrong &= part == WALL
        maps.append(
            dataclasses.replace(
                found,
                depth=np.where(wrong, 0.9 * depth, found.depth).astype(np.float32),
                confidence=np.where(wrong, 0.5, found.confidence).astype(np.float32),
            )
        )
    assert_wall_is_filled(fill_plain_parts(maps, sparse_points(), Progress()))


def test_pictures_that_hang_before_the_wall_do_not_draw_it_to_them() -> None:
    maps = []
    for camera, found in zip(cameras(), depth_maps(), strict=True):
        near_wall = np.where(traced(camera)[1] == PICTURE, 0.99, 1.0)  # about 4 cm before it
        depth = (near_wall * found.depth).astype(np.float32)
        maps.append(dataclasses.replace(found, depth=depth))
    assert_wall_is_filled(fill_plain_parts(maps, sparse_points(), Progress()))


def test_single_pixels_of_a_wall_do_not_outweigh_what_is_known_around_it() -> None:
    maps, random = [], np.random.default_rng(4)
    for camera, found in zip(cameras(), depth_maps(), strict=True):
        wall = traced(camera)[1] == WALL
        lone = np.zeros(wall.shape, bool)
        row, column = np.argwhere(wall & ~near(~wall, 6))[random.integers(300)]
        lone[row, column] = True
        depth = np.where(lone, random.uniform(0.99, 1.01) * traced(camera)[0], found.depth)
        known = np.where(wall, 0.5 * lone, found.confidence)
        changed = {"depth": depth.astype(np.float32), "confidence": known.astype(np.float32)}
        maps.append(dataclasses.replace(found, **changed))
    assert_wall_is_filled(fill_plain_parts(maps, sparse_points(), Progress()))


def test_photos_of_different_exposure_agree() -> None:
    gains = np.linspace(0.8, 1.1, len(cameras()))
    maps = [depth_map(camera, gain) for camera, gain in zip(cameras(), gains, strict=True)]
    assert_wall_is_filled(fill_plain_parts(maps, sparse_points(), Progress()))


def test_a_rod_before_the_wall_stays_and_the_wall_goes_on_beside_it() -> None:
    """Windows beside the rod see it and give the wall its depth there, for some pixels."""
    maps = []
    for camera, found in zip(cameras(), depth_maps(), strict=True):
        pixel = camera.project(np.array([[0.0, 1.5, 1.2]]))[0][0]
        column = round(pixel[0])
        color, depth, confidence = found.color.copy(), found.depth.copy(), found.confidence.copy()
        color[:, column : column + 2] = (40, 35, 30)
        depth[:, column - 4 : column + 6] = camera.to_camera(np.array([[0.0, 1.5, 1.2]]))[0, 2]
        confidence[:, column - 4 : column + 6] = 0.8
        maps.append(dataclasses.replace(found, color=color, depth=depth, confidence=confidence))
    filled = fill_plain_parts(maps, sparse_points(), Progress())
    for camera, before, after in zip(cameras(), maps, filled, strict=True):
        depth, part, _ = traced(camera)
        column = round(camera.project(np.array([[0.0, 1.5, 1.2]]))[0][0, 0])
        rod = np.zeros(part.shape, bool)
        rod[:, column : column + 2] = True
        assert np.array_equal(after.depth[rod], before.depth[rod])
        beside = np.zeros(part.shape, bool)
        beside[:, column - 4 : column - 1] = beside[:, column + 3 : column + 6] = True
        beside &= (part == WALL) & ~near(part != WALL, 4)
        assert beside.any()
        right = np.abs(after.depth[beside] / depth[beside] - 1.0) < KEPT_SHARE
        assert right.mean() > 0.9
        assert np.abs(before.depth[beside] / depth[beside] - 1.0).min() > KEPT_SHARE


def test_photos_see_freely_to_the_wall() -> None:
    for camera, found in zip(
        cameras(), fill_plain_parts(depth_maps(), sparse_points(), Progress()), strict=True
    ):
        depth, part, _ = traced(camera)
        wall = (part == WALL) & (found.free > 0)
        assert wall[(part == WALL) & ~near(part != WALL, 6)].mean() > 0.9
        assert np.abs(found.free[wall] / depth[wall] - 1.0).max() < KEPT_SHARE
        assert not found.free[(part == FLOOR) | (part == PICTURE)].any()
    assert depth_maps()[0].free is None


def test_what_windows_see_before_the_sky_is_left_out() -> None:
    """A mast rises into the sky; windows beside it give the sky its depth."""
    top = np.array([[0.0, 1.5, 1.2]])
    maps, masts = [], []
    for camera, found in zip(cameras(), depth_maps(), strict=True):
        column = round(camera.project(top)[0][0, 0])
        color, depth, confidence = found.color.copy(), found.depth.copy(), found.confidence.copy()
        color[:, column : column + 2] = (40, 35, 30)
        depth[:, column - 5 : column + 7] = camera.to_camera(top)[0, 2]
        confidence[:, column - 5 : column + 7] = 0.8
        maps.append(dataclasses.replace(found, color=color, depth=depth, confidence=confidence))
        masts.append(column)
    filled = fill_plain_parts(maps, sparse_points(), Progress())
    left, kept = [], []
    for camera, column, after in zip(cameras(), masts, filled, strict=True):
        sky = traced(camera)[1] == SKY
        sky &= ~near(~sky, 4)
        for offset in (-5, -4, 5, 6):
            left.append(after.confidence[sky[:, column + offset], column + offset] > 0)
        kept.append(after.confidence[sky[:, column], column] > 0)
    assert np.concatenate(left).mean() < 0.1
    assert np.concatenate(kept).mean() > 0.8  # an upright stripe is no straight mast in each photo


PANEL_Y, PANEL = 2.0, (-0.35, 0.35, 0.9, 1.5)
"""A panel before the wall: its distance, least and largest x, least and largest z."""


def test_two_photos_that_take_a_panel_for_the_wall_do_not_erase_it() -> None:
    """In two photos it has the colour of the wall, and its windows match nothing."""
    maps, shown = [], []
    for view, (camera, found) in enumerate(zip(cameras(), depth_maps(), strict=True)):
        rays = camera.rays() @ camera.rotation
        depth = (PANEL_Y - camera.center[1]) / rays[..., 1]
        x, _, z = np.moveaxis(camera.center + rays * depth[..., None], -1, 0)
        left, right, low, high = PANEL
        panel = (x > left) & (x < right) & (z > low) & (z < high)
        color, known = found.color.copy(), found.confidence.copy()
        alike = view in (2, 5)
        wall = color[(traced(camera)[1] == WALL) & ~near(panel, 2)]
        color[panel] = np.median(wall, axis=0) if alike else np.where(z > 1.2, 60, 90)[panel, None]
        known[panel] = 0.0 if alike else 0.8
        depths = np.where(panel, depth, found.depth).astype(np.float32)
        maps.append(dataclasses.replace(found, color=color, depth=depths, confidence=known))
        shown.append(panel)
    filled = fill_plain_parts(maps, sparse_points(), Progress())
    for view in (2, 5):  # or the test would show nothing
        assert np.abs(filled[view].depth / maps[view].depth - 1.0)[shown[view]].max() > 0.1
    for view in set(range(len(maps))) - {2, 5}:
        inner = shown[view] & ~near(~shown[view], 2)
        assert (filled[view].confidence[inner] > 0).mean() > 0.95


def test_masked_pixels_are_not_filled() -> None:
    masks = [np.arange(found.depth.shape[1]) > 70 for found in depth_maps()]
    maps = [
        dataclasses.replace(found, mask=np.broadcast_to(mask, found.depth.shape))
        for found, mask in zip(depth_maps(), masks, strict=True)
    ]
    for before, after in zip(
        maps, fill_plain_parts(maps, sparse_points(), Progress()), strict=True
    ):
        assert np.array_equal(after.depth[:, :70], before.depth[:, :70])
        assert np.array_equal(after.confidence[:, :70], before.confidence[:, :70])
        assert not after.free[:, :70].any()


def test_textured_photos_stay_as_they_are_but_for_what_nothing_confirms() -> None:
    scene, _ = ball_scene()
    filled = fill_plain_parts(ball_maps(), scene.points, Progress())
    changed, worse = [], []
    for before, after in zip(ball_maps(), filled, strict=True):
        confirmed = before.confidence > 0
        changed.append((before.depth != after.depth)[confirmed])
        depth = true_depth(before.camera)
        before_error, after_error = (np.abs(m.depth / depth - 1.0) for m in (before, after))
        worse.append((after_error > before_error)[~confirmed])
    assert np.concatenate(changed).mean() < 0.01
    assert np.concatenate(worse).mean() < 0.01


def test_the_result_is_the_same_each_time() -> None:
    first, second = (fill_plain_parts(depth_maps(), sparse_points(), Progress()) for _ in "ab")
    for one, other in zip(first, second, strict=True):
        assert np.array_equal(one.depth, other.depth)
        assert np.array_equal(one.confidence, other.confidence)


@pytest.mark.parametrize("count", [0, 1])
def test_single_photos_have_nobody_to_ask(count: int) -> None:
    maps = list(depth_maps()[:count])
    assert fill_plain_parts(maps, sparse_points(), Progress()) == maps


def test_it_can_be_cancelled() -> None:
    with pytest.raises(Cancelled):
        fill_plain_parts(depth_maps(), sparse_points(), Progress(is_cancelled=lambda: True))

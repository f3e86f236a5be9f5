# SPDX-License-Identifier: GPL-3.0-or-later
"""The automatic regions of synthetic scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.regions.scene_regions import automatic_region, whole_region
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from tests.core.field.field_scenes import make_arrays
from tests.synthetic import look_at


def scene_of(cameras: list[Camera], points: np.ndarray) -> Scene:
    views = tuple(View(camera, Path("photo.png")) for camera in cameras)
    return Scene(views, points, np.zeros((len(points), 3), np.uint8), Similarity())


def ring(count: int = 24, target: tuple[float, float, float] = (0.3, -0.2, -1.0)) -> list[Camera]:
    """Cameras around an object, 4.5 away, looking down a little."""
    focus = np.array(target)
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = focus + 4.5 * np.stack(
        [np.cos(angles) * 0.9, np.sin(angles) * 0.9, np.full(count, 0.44)], 1
    )
    return [look_at(eye, focus, f"{i}", 640, 480, 620.0) for i, eye in enumerate(eyes)]


def object_points(rng: np.random.Generator, focus: np.ndarray) -> np.ndarray:
    """A stick of 1.2 x 0.3 x 0.5, turned by 30 degrees, with smooth sides (few points)."""
    local = rng.uniform(-0.5, 0.5, (400, 3)) * [1.2, 0.3, 0.5]
    cosine, sine = np.cos(np.pi / 6), np.sin(np.pi / 6)
    return local @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1.0]]) + focus


def test_turntable_region_holds_the_object_and_not_the_room() -> None:
    rng = np.random.default_rng(0)
    focus = np.array([0.3, -0.2, -1.0])
    thing = object_points(rng, focus)
    table = np.c_[rng.uniform(-1.0, 1.0, (3000, 2)) + focus[:2], np.full(3000, focus[2] - 0.26)]
    wall = rng.normal(size=(3000, 3))
    wall *= 30 / np.linalg.norm(wall, axis=1)[:, None]
    stray = rng.uniform(-1e4, 1e4, (50, 3))
    region = automatic_region(scene_of(ring(), np.concatenate([thing, table, wall, stray])))
    assert region.contains(thing).all()
    assert not region.contains(wall).any()
    assert region.name == "auto"
    # The object with its close support: no larger than the table, and not much higher.
    assert region.volume < 2.6 * 2.6 * 1.2
    assert region.bounds[0][2] < focus[2] - 0.26
    normals = region.half_spaces[0]
    assert (np.abs(normals[:, 2]) > 1 - 1e-9).sum() == 2  # upright


def test_turned_object_without_a_table_gets_a_turned_box() -> None:
    focus = np.array([0.3, -0.2, -1.0])
    thing = object_points(np.random.default_rng(1), focus)
    region = automatic_region(scene_of(ring(), thing))
    assert region.contains(thing).mean() > 0.99
    assert region.volume < 1.2 * 0.3 * 0.5 * 3.5
    horizontal = region.half_spaces[0][np.abs(region.half_spaces[0][:, 2]) < 0.5]
    angle = np.rad2deg(np.arctan2(horizontal[0, 1], horizontal[0, 0])) % 90
    assert min(abs(angle - 30), abs(angle - 60)) <= 6


def test_outlying_cameras_and_points_change_nothing_much() -> None:
    rng = np.random.default_rng(2)
    thing = object_points(rng, np.array([0.3, -0.2, -1.0]))
    clean = automatic_region(scene_of(ring(), thing))
    lost = look_at(np.array([1e6, 0, 0]), np.array([1e6, 1, 0.5]), "lost", 640, 480, 620.0)
    bad = np.full((3, 3), np.nan)
    dirty = automatic_region(
        scene_of([*ring(), lost], np.concatenate([thing, rng.uniform(-1e6, 1e6, (40, 3)), bad]))
    )
    np.testing.assert_allclose(dirty.center, clean.center, atol=0.02)
    assert dirty.volume == pytest.approx(clean.volume, rel=0.1)


def test_forward_facing_scene_takes_the_well_seen_part() -> None:
    rng = np.random.default_rng(3)
    eyes = [np.array([x, -4.0, z]) for x in np.linspace(-1, 1, 5) for z in (-0.4, 0.4)]
    cameras = [
        look_at(e, e + np.array([0, 1.0, 0]), f"{i}", 640, 480, 600.0) for i, e in enumerate(eyes)
    ]
    wall = np.c_[rng.uniform(-6, 6, 4000), rng.normal(0.0, 0.05, 4000), rng.uniform(-4, 4, 4000)]
    region = automatic_region(scene_of(cameras, wall))
    assert region.contains(np.array([[0.0, 0.0, 0.0]])).all()
    low, high = region.bounds
    assert -3.5 < low[0] < -0.8
    assert 0.8 < high[0] < 3.5
    assert high[1] - low[1] < 1.5


ROOM = np.array([3.0, 2.0, 1.2])
"""Half of the size of a room around the origin."""


def room_points(rng: np.random.Generator, count: int = 4000) -> np.ndarray:
    """Return points on the walls, the floor and the ceiling."""
    points = rng.uniform(-1.0, 1.0, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = np.sign(points[np.arange(count), axis])
    return points * ROOM


def test_photos_from_inside_get_the_room_and_not_the_air_in_its_middle() -> None:
    rng = np.random.default_rng(5)
    angles = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    cameras = []
    for number, angle in enumerate(angles):
        eye = 0.5 * ROOM * [np.cos(angle), np.sin(angle), 0.0]
        aim = ROOM * [np.cos(2.0 * angle + 1.0), np.sin(2.0 * angle + 1.0), 0.0]
        cameras.append(look_at(eye, 1.5 * aim + [0.01, 0, 0], f"{number}", 640, 480, 400.0))
    walls = room_points(rng)
    through_window = rng.normal(size=(60, 3)) * 3.0 + [80.0, 0.0, 0.0]
    region = automatic_region(scene_of(cameras, np.concatenate([walls, through_window])))
    assert region.contains(walls).mean() > 0.95
    assert not region.contains(through_window).any()
    assert region.volume < 3.0 * 8.0 * ROOM.prod()


@pytest.mark.parametrize("meets", [False, True])
def test_photos_in_a_row_get_all_that_they_show(meets: bool) -> None:
    """Also where their middles meet: all photos are from one side."""
    rng = np.random.default_rng(6)
    cameras = []
    for k, x in enumerate(np.linspace(-0.6, 0.6, 7)):
        target = np.array([0.0 if meets else x, 4.5, 0.0])
        cameras.append(look_at(np.array([x, 0.0, 0.0]), target, f"{k}", 640, 480, 620.0))
    depth = rng.uniform(3.0, 6.0, 3000)
    shown = np.stack(
        [rng.uniform(-0.45, 0.45, 3000) * depth, depth, rng.uniform(-0.35, 0.35, 3000) * depth], 1
    )
    region = automatic_region(scene_of(cameras, shown))
    assert region.contains(shown).mean() > 0.95
    assert region.volume < 3.0 * np.ptp(shown, axis=0).prod()


@pytest.mark.parametrize("count", [0, 5])
def test_without_points_the_axes_decide(count: int) -> None:
    points = np.random.default_rng(4).normal(size=(count, 3)) * 0.1
    region = automatic_region(scene_of(ring(), points))
    assert region.contains(np.array([[0.3, -0.2, -1.0]])).all()
    assert 0.5 < region.diagonal < 6.0


def test_one_camera_is_enough_and_none_is_refused() -> None:
    assert automatic_region(scene_of(ring()[:1], np.zeros((0, 3)))).volume > 0
    with pytest.raises(MeshingError, match="camera"):
        automatic_region(scene_of([], np.zeros((0, 3))))


def test_whole_region_holds_what_two_photos_see() -> None:
    rng = np.random.default_rng(5)
    near = rng.uniform(-1.5, 1.5, (3000, 3)) + np.array([0.3, -0.2, -1.0])
    sky = rng.normal(size=(500, 3))
    sky *= 400 / np.linalg.norm(sky, axis=1)[:, None]
    arrays = make_arrays(np.concatenate([near, sky]), 0.02, 0.9)
    region = whole_region(scene_of(ring(), np.zeros((0, 3))), arrays)
    assert region.name == "all"
    assert region.contains(near).mean() > 0.97
    assert not region.contains(sky).any()
    with pytest.raises(MeshingError, match="two photos"):
        whole_region(scene_of(ring(), np.zeros((0, 3))), make_arrays(sky, 0.02, 0.9))

# SPDX-License-Identifier: GPL-3.0-or-later
"""Semi-global matching: planes of single photos, and what it gains for photos in a row."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from gaussian_wrapping_addon.core.stereo import depth_maps
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthMap, estimate_depth_maps
from gaussian_wrapping_addon.core.stereo.matching import coarser_planes, source_angles_deg
from gaussian_wrapping_addon.core.stereo.semi_global import MOST_HYPOTHESES, matched_planes
from tests.core.stereo.textured_plane import grey_photo, true_planes
from tests.core.training.small_scene import PhotosInMemory
from tests.synthetic import look_at

WIDTH, HEIGHT, FOCAL_PX = 128, 96, 140.0
NEAR, FAR = 6.0, 10.0
"""Distances of a square and of the wall behind it from the row of cameras."""
STEP = 0.15  # between neighbours
AHEAD = np.array([0.0, 0.0, 1.0])
COUNT = 7
WIDEST_PX = FOCAL_PX * STEP * (COUNT - 1)
"""Disparity over the whole row of what is 1 away."""


def cameras(turn_deg: float = 0.0, count: int = 3) -> list[Camera]:
    """Return cameras above the textured plane, 3 degrees apart; all but the first are turned."""
    found = []
    for i in range(count):
        place = np.array([0.2 * i, -2.0 + 0.05 * i, 3.5])
        camera = look_at(place, np.zeros(3), f"{i}.png", WIDTH, HEIGHT, 160.0)
        if i:
            roll = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
            camera = dataclasses.replace(camera, cam_from_world=roll @ camera.cam_from_world)
        found.append(camera)
    return found


@pytest.mark.parametrize(("turn_deg", "noise"), [(0.0, 0.0), (90.0, 0.0), (0.0, 4.0)])
def test_the_planes_of_a_photo_are_found(turn_deg: float, noise: float) -> None:
    given = cameras(turn_deg)
    random = np.random.default_rng(3)
    photos = [
        np.clip(grey_photo(camera) + noise * random.normal(size=(HEIGHT, WIDTH)), 0, 255)
        for camera in given
    ]
    greys = [np.round(photo).astype(np.uint8) for photo in photos]
    found = matched_planes(given[0], greys[0], given[1:], greys[1:], np.array([0.03, 0.5]))
    # In pixels of the farther source; what a turned one does not show is left out.
    inner = (slice(8, -8), slice(28, -28))
    error_px = 160.0 * 0.4 * np.abs(found - true_planes(given[0]))[inner]
    assert np.median(error_px[..., 0]) < 0.3
    assert (error_px[..., 0] > 1.0).mean() < 0.08
    assert (np.median(error_px[..., 1:], axis=(0, 1)) < 0.1).all()


def test_depths_stay_in_their_range_where_sources_show_nothing() -> None:
    given = cameras()
    away = np.diag([-1.0, 1.0, -1.0])
    behind = dataclasses.replace(given[1], cam_from_world=away @ given[1].cam_from_world)
    greys = [grey_photo(camera) for camera in given]
    depth_range = np.array([0.1, 0.5])
    found = matched_planes(given[0], greys[0], [behind], greys[1:2], depth_range)
    assert np.isfinite(found).all()
    assert (found[..., 0] >= np.float32(0.1)).all()
    assert (found[..., 0] <= np.float32(0.5)).all()


def row_scene() -> tuple[Scene, PhotosInMemory, np.ndarray]:
    """Return noisy photos, in a row, of a bright square before a dark wall with little texture.

    Also the (h, w) true depths of the middle photo.
    """
    random = np.random.default_rng(8)
    square, wall = (
        ndimage.gaussian_filter(random.normal(size=(900, 900)), sigma) for sigma in (2.0, 3.0)
    )
    square, wall = 170 + 30 * square / square.std(), 40 + 8 * wall / wall.std()

    def texture(levels: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        at = [450 + 60 * y, 450 + 60 * x]
        return ndimage.map_coordinates(levels, at, order=1, mode="wrap")

    views, photos, truth = [], [], np.zeros(0)
    for i in range(COUNT):
        place = np.array([STEP * (i - COUNT // 2), 0.0, 0.0])
        camera = look_at(place, place + AHEAD, f"{i}.png", WIDTH, HEIGHT, FOCAL_PX)
        rays = camera.rays() @ camera.rotation
        near, far = (place + distance * rays / rays[..., 2:] for distance in (NEAR, FAR))
        on_square = (np.abs(near[..., :2]) < 1.2).all(-1)
        level = np.where(
            on_square,
            texture(square, near[..., 0], near[..., 1]),
            texture(wall, far[..., 0], far[..., 1]),
        )
        level = level + 3.0 * random.normal(size=level.shape)
        photos.append(np.repeat(np.clip(np.round(level), 0, 255)[..., None], 3, 2).astype(np.uint8))
        views.append(View(camera, Path(camera.name)))
        if i == COUNT // 2:
            truth = np.where(on_square, NEAR, FAR)
    x, y = random.uniform(-1.0, 1.0, (2, 60))
    points = np.concatenate(
        [np.stack([x, y, np.full(60, NEAR)], 1), np.stack([3 * x, 2 * y, np.full(60, FAR)], 1)]
    )
    colors = np.full((len(points), 3), 128, np.uint8)
    scene = Scene(tuple(views), points, colors, Similarity())
    return scene, PhotosInMemory(scene, photos), truth


def middle_map(scene: Scene, photos: PhotosInMemory) -> DepthMap:
    maps = estimate_depth_maps(
        photos, range(COUNT), scene.points, Progress(), side_px=640, threads=2
    )
    return maps[COUNT // 2]


def wrong_share(found: DepthMap, truth: np.ndarray) -> float:
    """Return the share of the pixels that are off by more than one over the whole row."""
    return float((np.abs(WIDEST_PX / found.depth - WIDEST_PX / truth) > 1.0).mean())


@pytest.mark.parametrize("large", [False, True])
def test_a_plain_wall_beside_a_thing_keeps_its_depth(
    large: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, photos, truth = row_scene()
    if large:  # as if the costs of a photo took too much memory
        monkeypatch.setattr(depth_maps, "MOST_VOLUME_BYTES", MOST_HYPOTHESES * WIDTH * HEIGHT)
    found = middle_map(scene, photos)
    assert wrong_share(found, truth) < (0.13 if large else 0.1)
    confirmed = found.confidence > 0
    assert confirmed.mean() > 0.5
    monkeypatch.setattr(depth_maps, "GUIDED_ANGLE_DEG", 0.0)
    alone = middle_map(scene, photos)
    assert wrong_share(found, truth) < (0.85 if large else 0.65) * wrong_share(alone, truth)


def test_photos_from_the_same_place_tell_no_depth() -> None:
    scene, photos, truth = row_scene()
    middle = COUNT // 2
    views = (*scene.views, scene.views[middle], scene.views[middle])
    burst = dataclasses.replace(scene, views=views)
    taken = PhotosInMemory(burst, [*photos.photos, *[photos.photos[middle]] * 2])
    maps = estimate_depth_maps(
        taken, range(COUNT + 2), scene.points, Progress(), side_px=640, threads=2
    )
    assert wrong_share(maps[middle], truth) < 0.15


def test_photos_without_two_guided_sources_are_matched_as_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene, photos, _ = row_scene()
    given = [view.camera for view in scene.views]
    near = source_angles_deg(given, 3, np.array([0, 1, 2, 4, 5, 6]), scene.points).max()
    # The middle photo alone has all its sources within this angle.
    monkeypatch.setattr(depth_maps, "GUIDED_ANGLE_DEG", near * 1.01)
    found = middle_map(scene, photos)
    monkeypatch.setattr(depth_maps, "GUIDED_ANGLE_DEG", 0.0)
    np.testing.assert_array_equal(found.depth, middle_map(scene, photos).depth)


def test_the_angles_of_sources_are_those_of_rays_to_the_same_points() -> None:
    scene, _, _ = row_scene()
    given = [view.camera for view in scene.views]
    wall = scene.points[scene.points[:, 2] == FAR]
    found = source_angles_deg(given, 0, np.arange(COUNT), wall)
    true = np.degrees(np.arctan(STEP * np.arange(COUNT) / FAR))
    np.testing.assert_allclose(found, true, rtol=0.1, atol=1e-3)
    assert (source_angles_deg(given, 0, np.arange(COUNT), wall[:0]) == 0.0).all()


def test_planes_of_half_the_size_are_those_of_the_resized_camera() -> None:
    camera = cameras()[0]
    half = camera.resized(WIDTH // 2, HEIGHT // 2)
    known = true_planes(camera)
    known[:10] = 0.0
    found = coarser_planes(known.astype(np.float32), (HEIGHT // 2, WIDTH // 2))
    assert not found[:5].any()
    np.testing.assert_allclose(found[5:], true_planes(half)[5:], rtol=1e-4, atol=1e-6)

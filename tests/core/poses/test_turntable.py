# SPDX-License-Identifier: GPL-3.0-or-later
"""A still camera before a turning object: recognised, and masks of what turns."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.scenes.geometry import RayScene
from gaussian_wrapping_addon.core.poses.checks import (
    MIN_GROUP,
    PairMotion,
    are_turning,
    pair_motion,
    standing_groups,
)
from gaussian_wrapping_addon.core.poses.turntable import (
    masks_of_turning,
    steady_colors,
    whole_parts,
    without_holes,
)
from tests.core.poses.turntable_photos import Turntable, turntable

SIZE = (640, 480)


def spread(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([20, 20], [620, 460], (count, 2))


def test_background_that_stays_and_an_object_that_moves() -> None:
    background, thing = spread(30), spread(25, 1)
    points = np.concatenate([background, thing])
    others = np.concatenate([background + 0.4, thing + np.array([40, 3])])
    found = pair_motion(3, 7, points, others, SIZE)
    assert found == PairMotion(3, 7, True, 25)
    nothing = np.zeros((0, 2))
    assert pair_motion(0, 1, nothing, nothing, SIZE) == PairMotion(0, 1, False, 0)


@pytest.mark.parametrize(
    ("low", "high", "count", "others"),
    [
        pytest.param((20, 20), (620, 460), 0, 200, id="a moving camera"),
        pytest.param((540, 440), (630, 470), 60, 100, id="a date in the corner"),
        pytest.param((10, 430), (630, 475), 200, 400, id="a bonnet along the lower edge"),
        pytest.param((20, 20), (620, 460), 40, 900, id="a display over a moving picture"),
    ],
)
def test_what_is_no_background(low: tuple, high: tuple, count: int, others: int) -> None:
    """Some points stand still, between them or beside them everything moves."""
    still = np.random.default_rng(0).uniform(low, high, (count, 2))
    world = spread(others, 1)
    moved = np.concatenate([still, world + np.array([20.0, 9.0])])
    points = np.concatenate([still, world])
    assert not pair_motion(0, 1, points, moved, SIZE).is_still


def test_what_moves_must_move_as_one() -> None:
    assert are_turning([30, 14, 12, 60])
    assert not are_turning([3, 0, 0, 40])
    assert not are_turning([])


@pytest.mark.parametrize(
    ("count", "is_still", "moved", "groups"),
    [
        pytest.param(5, lambda a, b: False, 0, [], id="nothing stands still"),
        pytest.param(12, lambda a, b: True, 40, [range(12)], id="a turntable"),
        pytest.param(12, lambda a, b: True, 3, [], id="a camera that waits"),
        pytest.param(40, lambda a, b: b < MIN_GROUP - 1, 40, [], id="a pause on a walk"),
        # A slow orbit: neighbours hardly move, photos farther apart do.
        pytest.param(30, lambda a, b: b - a == 1, 40, [], id="slow steps"),
        pytest.param(21, lambda a, b: b < 10, 40, [], id="somebody walks by"),
        pytest.param(
            24, lambda a, b: b < 20 and a // 10 == b // 10, 40, [range(10), range(10, 20)],
            id="two places and strays",
        ),
    ],
)  # fmt: skip
def test_standing_groups(count: int, is_still: Callable, moved: int, groups: list[range]) -> None:
    pairs = itertools.combinations(range(count), 2)
    motions = [PairMotion(a, b, is_still(a, b), moved) for a, b in pairs]
    assert standing_groups(count, motions) == [list(group) for group in groups]


COUNT, WIDTH, HEIGHT = 24, 240, 180


@pytest.fixture(scope="module")
def made() -> Turntable:
    return turntable(COUNT, WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def silhouettes(made: Turntable) -> list[np.ndarray]:
    rays = RayScene(made.mesh.vertices, made.mesh.faces)
    shapes = []
    for camera in made.cameras:
        y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, x * 0 + 1], -1)
        directions = (local @ camera.rotation).reshape(-1, 3)
        origins = np.broadcast_to(camera.center, directions.shape)
        shapes.append((rays.first_hits(origins, directions)[1] >= 0).reshape(HEIGHT, WIDTH))
    return shapes


def overlap(mask: np.ndarray, true: np.ndarray) -> float:
    return float((mask & true).sum() / (mask | true).sum())


def masks(photos: list[np.ndarray], threads: int = 2) -> list[np.ndarray]:
    return masks_of_turning(len(photos), photos.__getitem__, lambda share: None, threads=threads)


def test_masks_are_the_silhouettes(made: Turntable, silhouettes: list[np.ndarray]) -> None:
    found = [overlap(m, s) for m, s in zip(masks(made.photos), silhouettes, strict=True)]
    assert np.median(found) > 0.95
    assert min(found) > 0.9
    # What is cut away leaves holes in the mesh; what is left over, the other photos carve off.
    lost = [(s & ~m).sum() / s.sum() for m, s in zip(masks(made.photos), silhouettes, strict=True)]
    assert np.median(lost) < 0.01


def test_exposure_that_changes_is_no_motion(made: Turntable, silhouettes: list[np.ndarray]) -> None:
    random = np.random.default_rng(3)
    gains = random.uniform(0.75, 1.2, (COUNT, 3))
    photos = [
        np.rint((photo * gain).clip(0, 255)).astype(np.uint8)
        for photo, gain in zip(made.photos, gains, strict=True)
    ]
    found = [overlap(m, s) for m, s in zip(masks(photos), silhouettes, strict=True)]
    assert np.median(found) > 0.9


def test_threads_do_not_change_masks(made: Turntable) -> None:
    one, three = masks(made.photos[:10], 1), masks(made.photos[:10], 3)
    assert all(np.array_equal(a, b) for a, b in zip(one, three, strict=True))


def test_nothing_turns_in_equal_photos() -> None:
    photo = np.random.default_rng(0).integers(0, 255, (30, 40, 3)).astype(np.uint8)
    assert not any(mask.any() for mask in masks([photo] * 9))


def test_the_background_is_what_most_photos_agree_on() -> None:
    """Where the object covers a pixel in most photos a median would show the object."""
    photos = np.random.default_rng(0).integers(0, 255, (20, 4, 5, 3)).astype(np.uint8)
    photos[[1, 6, 11, 13, 17, 19]] = 77
    photos[6] += 3
    colors, support = steady_colors(photos, 1)
    assert np.abs(colors - 77.5).max() < 1.0
    assert (support >= 6).all()


def test_specks_go_and_gaps_close() -> None:
    differs = np.zeros((100, 120), bool)
    differs[20:80, 30:90] = True
    differs[45, 35:85] = False  # a gap of a pixel
    differs[5:7, 100:102] = True  # a speck
    wanted = np.zeros_like(differs)
    wanted[20:80, 30:90] = True
    assert np.array_equal(whole_parts(differs), wanted)


def test_holes_stay_where_the_object_is_seen_in_other_photos() -> None:
    mask = np.zeros((100, 120), bool)
    mask[20:80, 30:90] = True
    whole = mask.copy()
    mask[40:60, 50:70] = False  # through a handle, or the middle of a plain pot
    mask[70, 80] = False
    assert np.array_equal(without_holes(mask, np.zeros_like(mask)), whole)
    kept = without_holes(mask, np.ones_like(mask))
    assert not kept[40:60, 50:70].any()
    assert kept[70, 80]


def test_a_handle_is_open() -> None:
    """A plain pot looks the same in all photos but for its handle, which turns around it."""
    random = np.random.default_rng(0)
    wall = random.integers(60, 200, (120, 160, 3)).astype(float)
    y, x = np.mgrid[:120, :160]
    photos, shapes = [], []
    for k in range(24):
        at = 80 + 55 * np.cos(2 * np.pi * k / 24)
        ring = (np.hypot(x - at, y - 60) < 24) & (np.hypot(x - at, y - 60) > 14)
        pot = (abs(x - 80) < 30) & (abs(y - 60) < 40)
        photo = wall.copy()
        photo[ring] = (30, 60, 220)
        photo[pot] = (150, 90, 60)
        photos.append((photo + random.normal(size=photo.shape)).clip(0, 255).astype(np.uint8))
        shapes.append((ring & ~pot, (np.hypot(x - at, y - 60) < 10) & ~pot))
    for mask, (ring, inside) in list(zip(masks(photos), shapes, strict=True))[::6]:
        assert not ring.any() or mask[ring].mean() > 0.95
        assert not inside.any() or mask[inside].mean() < 0.1

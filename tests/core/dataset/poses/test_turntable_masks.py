# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks of what turns, against true silhouettes of a rendered turntable."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.scenes.geometry import RayScene
from gaussian_wrapping_addon.core.poses.turntable import (
    masks_of_turning,
    steady_colors,
    whole_parts,
    without_holes,
)
from tests.core.dataset.poses.turntable_photos import Turntable, turntable

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

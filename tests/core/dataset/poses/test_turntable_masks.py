# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks of what turns, against true silhouettes of a rendered turntable."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.scenes.visibility import RayScene
from benchmarks.turntable.photos import Turntable, turntable
from gaussian_wrapping_addon.core.dataset.poses.turntable_masks import (
    masks_of_turning,
    steady_colors,
    whole_parts,
)

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


def test_specks_go_and_holes_fill() -> None:
    differs = np.zeros((100, 120), bool)
    differs[20:80, 30:90] = True
    differs[40:60, 50:70] = False  # a hole
    differs[45, 35:85] = False  # a gap of a pixel
    differs[5:7, 100:102] = True  # a speck
    found = whole_parts(differs)
    wanted = np.zeros_like(found)
    wanted[20:80, 30:90] = True
    assert np.array_equal(found, wanted)

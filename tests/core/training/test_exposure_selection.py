# SPDX-License-Identifier: GPL-3.0-or-later
"""Selection of exposures on colours with known gains, occlusion and noise."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from gaussian_wrapping_addon.core.training.exposure import SRGB_PEDESTAL
from gaussian_wrapping_addon.core.training.exposure_selection import (
    NEEDED_SPREAD,
    PARTS,
    exposure_evidence,
    sample_points,
    select_exposure,
    solve_log_gains,
    split_spatially,
)
from tests.core.render.scenes import look_at
from tests.core.training.small_scene import PhotosInMemory, ring_cameras

PHOTOS = 16


def drawn_gains(largest: float) -> np.ndarray:
    """Return evenly spread log gains in random order: robust spread 0.7 of the largest."""
    random = np.random.default_rng(2)
    steps = np.linspace(-largest, largest, PHOTOS)
    gains = random.permutation(steps)[:, None] + random.normal(0, 0.1 * largest, (PHOTOS, 3))
    return gains - np.median(gains, axis=0)


def seen_colors(
    log_gains: np.ndarray, *, occluded: float = 0.2, noise: float = 0.02, count: int = 800
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return colours, what is seen, the points' own colours and places."""
    random = np.random.default_rng(7)
    photos = len(log_gains)
    own = random.uniform(0.1, 0.7, (count, 3))
    places = random.uniform(-1, 1, (count, 3))
    logs = np.log(own + SRGB_PEDESTAL)[:, None] + log_gains
    logs += noise * random.normal(size=logs.shape)
    colors = np.exp(logs) - SRGB_PEDESTAL
    hidden = random.uniform(size=(count, photos)) < occluded
    # What covers points is one thing of one colour: such errors do not average out.
    colors[hidden] = random.uniform(0.5, 0.9, (count, photos, 3))[hidden]
    seen = random.uniform(size=(count, photos)) < 0.5
    valid = np.repeat(seen[..., None], 3, axis=2) & (colors > 0.01) & (colors < 0.99)
    return colors, valid, own, places


def decide(colors, valid, own, places):
    found = solve_log_gains(colors, valid, own)
    parts = [solve_log_gains(colors[p], valid[p], own[p]) for p in split_spatially(places)]
    return exposure_evidence(found, parts, range(colors.shape[1]), colors.shape[1], len(places))


@pytest.mark.parametrize("with_reference", [True, False])
def test_known_gains_are_found_beside_occlusions(with_reference: bool) -> None:
    gains = drawn_gains(0.1)
    colors, valid, own, _ = seen_colors(gains)
    found = solve_log_gains(colors, valid, own if with_reference else None)
    error = found.values - np.median(found.values, axis=0) - gains
    assert np.abs(error).max() < 0.015
    assert np.sqrt((error**2).mean()) < 0.006


def test_exact_colours_give_exact_gains() -> None:
    gains = drawn_gains(0.1)
    colors, valid, own, _ = seen_colors(gains, occluded=0.0, noise=0.0, count=2000)
    found = solve_log_gains(colors, valid, own)
    # Held at one by as much as five points of some thousand.
    assert np.abs(found.values - gains).max() < 0.003


@pytest.mark.parametrize(
    ("largest", "needed"), [(0.0, False), (0.015, False), (0.08, True), (0.25, True)]
)
def test_decision_beside_occlusions(largest: float, needed: bool) -> None:
    found = decide(*seen_colors(drawn_gains(largest), occluded=0.3))
    assert found.known
    assert found.needed == needed
    assert (found.spread > 1.5 * NEEDED_SPREAD) if needed else (found.spread < NEEDED_SPREAD / 1.5)
    assert "parts (limit 2.5 %" in found.evidence


def test_two_altered_photos_of_sixteen_are_noticed() -> None:
    gains = np.zeros((PHOTOS, 3))
    gains[3], gains[11] = 0.2, -0.25
    found = decide(*seen_colors(gains))
    assert found.spread < NEEDED_SPREAD
    assert found.outliers == 2
    assert found.needed
    assert found.log_gains[3] == pytest.approx([0.2] * 3, abs=0.02)
    one = np.zeros((PHOTOS, 3))
    one[3] = 0.2
    assert not decide(*seen_colors(one)).needed


def test_shading_of_one_part_is_no_exposure() -> None:
    colors, valid, own, places = seen_colors(np.zeros((PHOTOS, 3)), occluded=0.1)
    corner = (places[:, 0] > 0.0) & (places[:, 1] > 0.0)
    shading = 0.3 * np.sin(np.arange(PHOTOS) * 2 * np.pi / PHOTOS)
    colors[corner] *= np.exp(shading)[None, :, None]
    found = decide(colors, valid & (colors < 0.99), own, places)
    assert not found.needed
    assert found.spread < NEEDED_SPREAD / 1.5


def test_too_little_is_not_known() -> None:
    colors, valid, own, places = seen_colors(drawn_gains(0.2))
    blind = decide(colors, np.zeros_like(valid), own, places)
    assert not blind.known
    assert not blind.needed
    assert not blind.log_gains.any()
    assert blind.evidence.startswith("Unknown")
    one = decide(colors[:, :1], valid[:, :1], own, places)
    assert not one.known
    few = valid.copy()
    few[:, 4:] = False  # twelve of sixteen photos see nothing
    assert not decide(colors, few, own, places).known


def test_parts_are_halves_by_place() -> None:
    places = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    parts = split_spatially(places)
    assert [len(part) for part in parts] == [125] * PARTS
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(1000))
    assert len(split_spatially(places[:100])) == 1


def sphere_color(places: np.ndarray) -> np.ndarray:
    return 0.4 + 0.25 * np.sin(2.0 * places + [0.0, 1.0, 2.0])


@functools.lru_cache(maxsize=1)
def sphere() -> tuple[tuple, list[np.ndarray], np.ndarray]:
    """Return cameras, exact photos of a painted sphere before grey, and points on it."""
    cameras, photos = tuple(ring_cameras(12, 96)), []
    for camera in cameras:
        rays = camera.rays() @ camera.rotation  # (h, w, 3)
        a = (rays**2).sum(-1)
        b = rays @ camera.center
        root = b * b - a * (camera.center @ camera.center - 1.0)
        t = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        color = sphere_color(camera.center + t[..., None] * rays)
        photos.append(np.where(root[..., None] > 0, color, 0.5))
    points = np.random.default_rng(4).normal(size=(1500, 3))
    return cameras, photos, points / np.linalg.norm(points, axis=1, keepdims=True)


def altered_scene(log_light: np.ndarray) -> tuple[Scene, PhotosInMemory]:
    cameras, photos, points = sphere()
    changed = []
    for photo, light in zip(photos, log_light, strict=True):
        value = (photo + SRGB_PEDESTAL) * np.exp(light / 2.4) - SRGB_PEDESTAL
        changed.append(np.round(255 * np.clip(value, 0, 1)).astype(np.uint8))
    colors = np.round(255 * sphere_color(points)).astype(np.uint8)
    views = tuple(View(c, Path(c.name)) for c in cameras)
    scene = Scene(views, points, colors, Similarity())
    return scene, PhotosInMemory(scene, changed)


def test_photos_of_a_sphere() -> None:
    plain = select_exposure(*altered_scene(np.zeros((12, 3))), range(1, 12))
    assert plain.known
    assert not plain.needed
    light = np.random.default_rng(1).uniform(-0.4, 0.4, (12, 1)) * np.ones(3)
    altered = select_exposure(*altered_scene(light), range(1, 12))
    assert altered.needed
    assert not altered.log_gains[0].any()  # held out: not looked at
    truth = light[1:] / 2.4
    assert np.abs(altered.log_gains[1:] - (truth - np.median(truth))).max() < 0.05


def test_black_photos_one_photo_and_no_points() -> None:
    scene, photos = altered_scene(np.zeros((12, 3)))
    black = PhotosInMemory(scene, [np.zeros_like(p) for p in photos.photos])
    assert not select_exposure(scene, black, range(12)).known
    assert not select_exposure(scene, photos, [4]).known
    empty = Scene(scene.views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), Similarity())
    found = select_exposure(empty, photos, range(12))
    assert not found.known
    assert "0 sparse points" in found.evidence


def test_cameras_that_see_nothing_and_masks() -> None:
    scene, photos = altered_scene(np.zeros((12, 3)))
    away = look_at((4.0, 0, 0), (8.0, 0, 0), width=96, height=96, focal=144.0, name="away.png")
    views = (*scene.views[:11], View(away, Path("away.png")))
    turned = Scene(views, scene.points, scene.point_colors, Similarity())
    masks = [None, np.zeros((96, 96), bool)] + [None] * 10
    masked = PhotosInMemory(turned, photos.photos, masks)
    _, valid = sample_points(scene.points, masked, range(12))
    assert valid[:, 0].any()
    assert not valid[:, [1, 11]].any()
    found = select_exposure(turned, masked, range(12))
    assert found.photos == 10
    assert not found.needed


def test_points_behind_others_are_left_out() -> None:
    scene, photos = altered_scene(np.zeros((12, 3)))
    _, valid = sample_points(scene.points, photos, range(4))
    for view, camera in enumerate(scene.cameras[:4]):
        # The far side of the sphere, more than its middle away from the camera.
        depth = camera.project(scene.points)[1]
        middle = camera.project(np.zeros((1, 3)))[1][0]
        assert valid[depth < middle - 0.5, view].any()
        assert not valid[depth > middle + 0.5, view].any()

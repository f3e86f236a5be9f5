# SPDX-License-Identifier: GPL-3.0-or-later
"""Confirmed depths on disk, and what they weigh."""

from __future__ import annotations

import dataclasses
import tracemalloc
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.stereo.depth_maps import (
    FILE_NAME,
    PLANE_SHARE,
    PLANE_STEP_PX,
    DepthMap,
    load_priors,
    planar_pixels,
    priors_of,
    save_priors,
)
from tests.core.stereo.ball_scene import ball_scene, exact_map, surface_points

VIEW = 5


def exact_prior():
    _, photos = ball_scene()
    return photos.camera(VIEW), exact_map(photos.camera(VIEW))


def test_what_is_saved_is_loaded_bit_for_bit(tmp_path: Path) -> None:
    camera, found = exact_prior()
    priors = priors_of([VIEW], [dataclasses.replace(found, free=2.0 * found.depth)])
    save_priors(tmp_path, priors, "key")
    loaded = load_priors(tmp_path, {VIEW: camera}, "key")
    assert loaded is not None
    assert list(loaded) == [VIEW]
    assert np.array_equal(loaded[VIEW].depth, priors[VIEW].depth)
    assert np.array_equal(loaded[VIEW].confidence, priors[VIEW].confidence)
    assert np.array_equal(loaded[VIEW].known, np.where(found.confidence > 0, found.depth, 0))
    assert np.array_equal(loaded[VIEW].free, 2.0 * found.depth)
    assert loaded[VIEW].camera == camera


def test_without_parts_that_have_no_texture_nothing_is_known_to_be_free() -> None:
    _, found = exact_prior()
    assert not priors_of([VIEW], [found])[VIEW].free.any()


def test_other_keys_views_and_sizes_are_not_loaded(tmp_path: Path) -> None:
    camera, found = exact_prior()
    assert load_priors(tmp_path, {VIEW: camera}, "key") is None
    save_priors(tmp_path, priors_of([VIEW], [found]), "key")
    assert load_priors(tmp_path, {VIEW: camera}, "other") is None
    assert load_priors(tmp_path, {VIEW + 1: camera}, "key") is None
    half = camera.resized(camera.width // 2, camera.height // 2)
    assert load_priors(tmp_path, {VIEW: half}, "key") is None


def test_a_damaged_file_is_not_loaded(tmp_path: Path) -> None:
    camera, found = exact_prior()
    priors = priors_of([VIEW], [found])
    save_priors(tmp_path, priors, "key")
    whole = (tmp_path / FILE_NAME).read_bytes()
    for content in (b"", b"nothing", whole[: len(whole) // 2]):
        (tmp_path / FILE_NAME).write_bytes(content)
        assert load_priors(tmp_path, {VIEW: camera}, "key") is None
    for place in np.random.default_rng(0).integers(0, len(whole), 60).tolist():
        changed = bytearray(whole)
        changed[place] ^= 1
        (tmp_path / FILE_NAME).write_bytes(changed)
        loaded = load_priors(tmp_path, {VIEW: camera}, "key")
        # Some bytes of an archive, such as times, say nothing about its content.
        assert loaded is None or np.array_equal(loaded[VIEW].depth, priors[VIEW].depth)


def test_a_file_that_unpacks_to_more_than_the_photos_have_is_not_loaded(tmp_path: Path) -> None:
    camera, _ = exact_prior()
    layers = ("depth", "confidence", "known", "free")
    huge = {f"{layer}.{VIEW}": np.zeros((4000, 4000), np.float32) for layer in layers}
    np.savez_compressed(tmp_path / FILE_NAME, key=np.array("key"), **huge)
    tracemalloc.start()
    assert load_priors(tmp_path, {VIEW: camera}, "key") is None
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


def plane_map(tilt: float = 0.3) -> tuple[DepthMap, np.ndarray]:
    """Return a confirmed map of a tilted plane in every pixel, and the plane's normal."""
    _, found = exact_prior()
    camera = found.camera
    normal = np.array([tilt, -0.2, -1.0])
    normal /= np.linalg.norm(normal)
    rays = camera.rays()
    depth = (4.0 * normal[2]) / (rays @ normal)
    normals = np.broadcast_to(normal @ camera.rotation, found.normal.shape)
    changed = dataclasses.replace(
        found, depth=depth.astype(np.float32), normal=normals.astype(np.float32)
    )
    return changed, normal


def test_all_pixels_of_a_plane_count_but_those_near_the_border() -> None:
    found, _ = plane_map()
    inner = np.zeros(found.depth.shape, bool)
    inner[PLANE_STEP_PX:-PLANE_STEP_PX, PLANE_STEP_PX:-PLANE_STEP_PX] = True
    assert np.array_equal(planar_pixels(found), inner)
    prior = priors_of([VIEW], [found])[VIEW]
    assert np.array_equal(prior.confidence, np.where(inner, found.confidence, 0))
    assert np.array_equal(prior.depth, np.where(inner, found.depth, 0))


def test_steps_noise_and_unconfirmed_neighbours_do_not_count() -> None:
    found, _ = plane_map()
    half = found.depth.shape[1] // 2
    step = found.depth.copy()
    step[:, half:] *= np.float32(1.0 + 2.0 * PLANE_SHARE)
    planar = planar_pixels(dataclasses.replace(found, depth=step))
    assert not planar[:, half - PLANE_STEP_PX : half + PLANE_STEP_PX].any()
    assert planar[8:-8, 8 : half - PLANE_STEP_PX].all()
    noise = np.random.default_rng(0).normal(0.0, 2.0 * PLANE_SHARE, step.shape)
    noisy = (found.depth * (1.0 + noise)).astype(np.float32)
    assert planar_pixels(dataclasses.replace(found, depth=noisy)).mean() < 0.01
    holes = found.confidence.copy()
    holes[20, 30] = 0.0
    planar = planar_pixels(dataclasses.replace(found, confidence=holes))
    assert not planar[20, 30]
    assert not planar[20 + PLANE_STEP_PX, 30]
    assert planar[21 + PLANE_STEP_PX, 30]


def test_the_ball_does_not_count_and_the_floor_does() -> None:
    """Exact depths of a ball deviate from its tangent planes within five pixels."""
    _, found = exact_prior()
    points = surface_points(found.camera)
    on_ball = np.abs(np.linalg.norm(points, axis=-1) - 1.0) < 1e-3
    on_floor = (np.abs(points[..., 2] + 1.0) < 1e-3) & ~on_ball
    planar = planar_pixels(found)
    assert planar[on_ball].mean() < 0.05
    assert planar[on_floor].mean() > 0.5

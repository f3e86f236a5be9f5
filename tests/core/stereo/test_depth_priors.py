# SPDX-License-Identifier: GPL-3.0-or-later
"""Confirmed depths on disk, and what they weigh."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.stereo.depth_priors import (
    FILE_NAME,
    PLAIN_VARIANCE,
    load_priors,
    priors_of,
    save_priors,
)
from tests.core.stereo.ball_scene import ball_scene, exact_map

VIEW = 5


def exact_prior():
    _, photos = ball_scene()
    return photos.camera(VIEW), exact_map(photos.camera(VIEW))


def test_what_is_saved_is_loaded_bit_for_bit(tmp_path: Path) -> None:
    camera, found = exact_prior()
    priors = priors_of([VIEW], [found])
    save_priors(tmp_path, priors, "key")
    loaded = load_priors(tmp_path, {VIEW: camera}, "key")
    assert loaded is not None
    assert list(loaded) == [VIEW]
    assert np.array_equal(loaded[VIEW].depth, priors[VIEW].depth)
    assert np.array_equal(loaded[VIEW].confidence, priors[VIEW].confidence)
    assert loaded[VIEW].camera == camera


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
    save_priors(tmp_path, priors_of([VIEW], [found]), "key")
    whole = (tmp_path / FILE_NAME).read_bytes()
    for content in (b"", b"nothing", whole[: len(whole) // 2]):
        (tmp_path / FILE_NAME).write_bytes(content)
        assert load_priors(tmp_path, {VIEW: camera}, "key") is None


def test_texture_takes_weight_and_unconfirmed_depths_are_zero() -> None:
    _, found = exact_prior()
    plain = np.zeros(found.depth.shape, np.float32)
    confidence = np.full(found.depth.shape, 0.8, np.float32)
    confidence[0] = 0.0
    for variance, share in ((plain, 1.0), (plain + PLAIN_VARIANCE, 0.5)):
        changed = dataclasses.replace(found, variance=variance, confidence=confidence)
        prior = priors_of([VIEW], [changed])[VIEW]
        np.testing.assert_allclose(prior.confidence, share * confidence, rtol=1e-6)
        assert (prior.depth[0] == 0).all()
        assert np.array_equal(prior.depth[1:], found.depth[1:])

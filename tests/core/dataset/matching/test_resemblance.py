# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos that share features resemble each other."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.poses.matching import resemblances

PHOTOS, EACH, STEP = 30, 200, 40


def _walk() -> list[np.ndarray]:
    """Return descriptors of photos of which neighbours share features, four fifths of them."""
    chance = np.random.default_rng(5)
    world = chance.gamma(0.4, 60.0, (STEP * PHOTOS + EACH, 128))
    photos = []
    for number in range(PHOTOS):
        seen = world[number * STEP : number * STEP + EACH]
        noisy = seen + chance.normal(0.0, 12.0, seen.shape)
        photos.append(noisy.clip(0, 255).astype(np.uint8)[chance.permutation(EACH)])
    return photos


def test_the_most_alike_share_most_features() -> None:
    photos = _walk()
    alike = resemblances(PHOTOS, lambda k: photos[k], seed=0)
    assert alike.shape == (PHOTOS, PHOTOS)
    np.testing.assert_allclose(np.diag(alike), 1.0, atol=1e-5)
    np.fill_diagonal(alike, -2.0)
    assert (np.abs(alike.argmax(1) - np.arange(PHOTOS)) == 1).all()
    far = np.abs(np.arange(PHOTOS)[:, None] - np.arange(PHOTOS)) >= 5  # nothing in common
    for number in range(PHOTOS):
        beside = [k for k in (number - 1, number + 1) if 0 <= k < PHOTOS]
        assert alike[number, beside].min() > alike[number, far[number]].max()


def test_the_same_seed_gives_the_same() -> None:
    photos = _walk()
    first = resemblances(PHOTOS, lambda k: photos[k], seed=4)
    np.testing.assert_array_equal(first, resemblances(PHOTOS, lambda k: photos[k], seed=4))


def test_photos_without_features_resemble_none() -> None:
    photos = _walk()
    photos[3] = np.zeros((0, 128), np.uint8)
    alike = resemblances(PHOTOS, lambda k: photos[k], seed=0)
    assert not alike[3].any()
    assert np.isfinite(alike).all()
    empty = [np.zeros((0, 128), np.uint8)] * 4
    assert not resemblances(4, lambda k: empty[k], seed=0).any()

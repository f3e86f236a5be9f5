# SPDX-License-Identifier: GPL-3.0-or-later
"""Noise of the photos whose depths are measured, and what is counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.zoo.depths import known_and_right, wrong
from benchmarks.zoo.noisy_photos import NoisyPhotos
from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from tests.core.dataset.photos.test_photo_store import make_scene
from tests.core.stereo.plain.plain_room import cameras, depth_map


def test_noise_is_added_once_at_full_size(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, count=2, width=300, height=200)
    clean, noisy = PhotoStore(scene, 300), NoisyPhotos(scene, 300, 3.0)
    inner = (slice(40, 160), slice(40, 260), slice(0, 2))  # nothing there is clipped at 0 or 255
    change = (noisy.photo(0).astype(float) - clean.photo(0))[inner]
    assert change.std() == pytest.approx(np.hypot(3.0, 0.29), rel=0.03)
    assert abs(change.mean()) < 0.05
    half = noisy.photo(0, 2).astype(float) - clean.photo(0, 2)
    assert half[20:80, 20:130, :2].std() == pytest.approx(1.5, rel=0.1)
    again = NoisyPhotos(scene, 300, 3.0)
    np.testing.assert_array_equal(again.photo(0), noisy.photo(0))
    assert (noisy.photo(1).astype(float) - clean.photo(1))[inner].std() > 2.0
    assert not np.array_equal(noisy.photo(1)[inner], noisy.photo(0)[inner])
    np.testing.assert_array_equal(NoisyPhotos(scene, 300, 0.0).photo(0), clean.photo(0))


def test_photos_are_compressed(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, count=1, width=300, height=200)
    clean = PhotoStore(scene, 300).photo(0).astype(float)
    good, bad = (NoisyPhotos(scene, 300, 0.0, quality).photo(0) for quality in (95, 20))
    assert 0.0 < np.abs(good - clean).mean() < np.abs(bad - clean).mean()
    assert good.dtype == np.uint8
    assert good.shape == clean.shape


def test_known_right_and_wrong_pixels_are_counted() -> None:
    found = depth_map(cameras()[0])
    known = found.confidence > 0
    shares = np.zeros(found.depth.shape)
    row, column = np.nonzero(known)
    quarter = len(row) // 4
    for part, share in enumerate((0.0, 0.005, 0.02, 0.05)):
        some = slice(part * quarter, (part + 1) * quarter)
        shares[row[some], column[some]] = share
    truth = found.depth / (1.0 + shares)
    expected = (round(100 * known.mean()), 25, 50)
    assert known_and_right([found], [truth]) == pytest.approx(expected, abs=1)
    assert wrong([found], [truth]) == pytest.approx(25.0, abs=0.2)

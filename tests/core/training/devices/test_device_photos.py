# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos kept on a device: the bytes they take, whose they are, and windows of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.training.backend import Window, counts_of
from gaussian_wrapping_addon.core.training.cpu_backend import CpuBackend
from gaussian_wrapping_addon.core.training.device_backend import DevicePhotos
from tests.core.training.small_scene import PhotosInMemory, sphere_scene

HOST = torch.device("cpu")
SIDE = 32
PHOTO_BYTES = 3 * SIDE * SIDE
MASK_BYTES = SIDE * SIDE


class Source(PhotosInMemory):
    """Photos that count how often each one is read."""

    def __init__(self, *, masks: bool = False) -> None:
        scene, photos = sphere_scene(views=9, size_px=SIDE)
        mask = np.zeros((SIDE, SIDE), bool)
        mask[3:20, 5:] = True
        super().__init__(scene, photos.photos, [mask] * 9 if masks else None)
        self.read: list[tuple[int, int]] = []

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        self.read.append((index, divisor))
        return super().photo(index, divisor)


@pytest.mark.parametrize("masks", [False, True])
@pytest.mark.parametrize("window", [None, Window(6, 8, 17, 14)])
@pytest.mark.parametrize("divisor", [1, 2])
def test_shows_what_the_processor_shows(window: Window | None, masks: bool, divisor: int) -> None:
    if window is not None and divisor == 2:
        window = Window(2, 3, 12, 13)
    source = Source(masks=masks)
    wanted = CpuBackend(1).shown(source, 4, divisor, window)
    kept = DevicePhotos(HOST, 1 << 20)
    for _ in range(2):
        found = kept.shown(source, 4, divisor, window)
        assert found.photo.is_contiguous()
        assert np.array_equal(found.photo.numpy(), wanted.photo)
        assert (found.mask is None) == (wanted.mask is None) == (not masks)
        if masks:
            assert found.mask.is_contiguous()
            assert np.array_equal(found.mask.numpy(), wanted.mask)
        assert (found.pixels, found.windows) == (wanted.pixels, wanted.windows)


def test_windows_are_of_the_one_photo_that_is_kept() -> None:
    source, kept = Source(), DevicePhotos(HOST, 1 << 20)
    for window in (Window(0, 0, 20, 20), Window(12, 12, 20, 20), None):
        kept.shown(source, 1, 1, window)
    kept.shown(source, 1, 2, None)
    assert source.read == [(1, 1), (1, 2)]
    assert kept.bytes_held == PHOTO_BYTES + PHOTO_BYTES // 4


def test_the_photos_not_used_for_longest_go_first() -> None:
    source, kept = Source(masks=True), DevicePhotos(HOST, 3 * (PHOTO_BYTES + MASK_BYTES))
    for view in (0, 1, 2, 0, 3, 0, 2, 1):
        kept.shown(source, view, 1, None)
        assert kept.bytes_held <= kept.limit_bytes
    # 3 takes the place of 1, as 0 was used after it.
    assert [view for view, _ in source.read] == [0, 1, 2, 3, 1]
    assert kept.bytes_held == 3 * (PHOTO_BYTES + MASK_BYTES)


def test_the_photo_in_use_is_kept_whatever_its_size() -> None:
    source, kept = Source(), DevicePhotos(HOST, 10)
    for view in (0, 0, 1, 1, 0):
        assert np.array_equal(kept.shown(source, view, 1, None).photo.numpy(), source.photos[view])
        assert kept.bytes_held == PHOTO_BYTES
    assert [view for view, _ in source.read] == [0, 1, 0]


def test_photos_of_another_source_are_others() -> None:
    first, second = Source(), Source()
    second.photos = [255 - photo for photo in second.photos]
    kept = DevicePhotos(HOST, 1 << 20)
    kept.shown(first, 0, 1, None)
    kept.shown(first, 1, 1, None)
    found = kept.shown(second, 0, 1, None)
    assert np.array_equal(found.photo.numpy(), second.photos[0])
    assert kept.bytes_held == PHOTO_BYTES


def test_dropped_photos_are_read_again() -> None:
    source, kept = Source(), DevicePhotos(HOST, 1 << 20)
    kept.shown(source, 0, 1, None)
    kept.clear()
    assert kept.bytes_held == 0
    kept.shown(source, 0, 1, None)
    assert len(source.read) == 2


def test_what_is_kept_is_a_copy() -> None:
    source, kept = Source(), DevicePhotos(HOST, 1 << 20)
    pixels = source.photo(0)
    source.photo = lambda index, divisor=1: pixels  # type: ignore[method-assign]
    found = kept.shown(source, 0, 1, None).photo
    before = pixels.copy()
    pixels[:] = 0
    assert np.array_equal(found.numpy(), before)


def test_windows_that_a_mask_leaves() -> None:
    mask = np.zeros((20, 30), bool)
    mask[4:8, 10:] = True
    assert counts_of(None, 20, 30) == (600, 10 * 20)
    assert counts_of(mask, 20, 30) == (80, 3 * 15)
    assert counts_of(mask[:10], 10, 30) == (80, 0), "no window of 11 pixels fits"
    assert counts_of(None, 10, 30) == (300, 0)

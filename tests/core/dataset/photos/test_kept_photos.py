# SPDX-License-Identifier: GPL-3.0-or-later
"""What stays in memory of photos that do not fit, and what makes room for what."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.photos.store import KeptPhotos


def array(size: int, value: int = 0) -> np.ndarray:
    return np.full(size, value, np.uint8)


def read(kept: KeptPhotos, index: int, divisor: int = 1, size: int = 10) -> bool:
    """Ask for a photo as a store does; tell whether it was there."""
    key = ("photo", index, divisor)
    found = kept.get(key)
    if found is None:
        kept.put(key, array(size, index))
        return False
    assert found[0] == index
    return True


def test_rounds_in_random_order_find_as_many_as_fit() -> None:
    kept, random = KeptPhotos(200), np.random.default_rng(0)
    for turn in range(6):
        found = sum(read(kept, index) for index in random.permutation(40).tolist())
        # Twenty stay; the one used last of the round before may be asked for first.
        assert turn == 0 or 20 <= found <= 21
        assert kept.bytes_kept <= 200


def test_another_size_of_a_photo_makes_room_once_it_is_asked_for() -> None:
    kept = KeptPhotos(100)
    for index in range(10):
        read(kept, index, 2)
    # Four times as large: each needs the room of four of the former size.
    for _ in range(2):
        for index in range(10):
            read(kept, index, 1, size=40)
            assert kept.bytes_kept <= 100
    assert kept.bytes_kept == 80
    assert sum(kept.peek(("photo", index, 1)) is not None for index in range(9)) == 2
    # Asked for again at the former size, which is not outdated any more.
    assert not read(kept, 0, 2)
    assert read(kept, 0, 2)


def test_small_arrays_take_the_place_of_much_larger_ones_but_not_of_like_ones() -> None:
    kept = KeptPhotos(100)
    for index in range(2):
        read(kept, index, size=50)
    read(kept, 2, size=30)
    assert kept.bytes_kept == 100  # 50 is not more than twice as much
    assert kept.peek(("photo", 0, 1)) is not None
    read(kept, 3, size=20)
    assert kept.peek(("photo", 0, 1)) is None  # used longest ago
    assert kept.peek(("photo", 1, 1)) is not None
    assert read(kept, 3, size=20)


def test_the_last_of_each_kind_is_kept_beyond_the_limit() -> None:
    kept = KeptPhotos(5)
    photo, mask = array(10, 1), array(7, 2)
    assert kept.put(("photo", 0, 1), photo)[1] == [(("photo", 0, 1), photo)]
    assert kept.put(("mask", 0, 1), mask)[1] == [(("mask", 0, 1), mask)]
    assert kept.get(("photo", 0, 1)) is photo
    assert kept.get(("mask", 0, 1)) is mask
    kept.put(("photo", 1, 1), photo)
    assert kept.get(("photo", 0, 1)) is None
    assert kept.bytes_kept == 0


def test_what_nobody_asked_for_takes_nothing_elses_place_and_goes_first() -> None:
    kept = KeptPhotos(100)
    kept.get(("photo", 0, 4))
    assert kept.put_aside(("photo", 0, 1), array(60))
    kept.put(("photo", 0, 4), array(10))
    assert not kept.put_aside(("photo", 1, 1), array(60))
    large = kept.peek(("photo", 0, 1))
    kept.get(("photo", 2, 1))
    assert kept.put(("photo", 2, 1), array(50))[1] == [(("photo", 0, 1), large)]
    assert kept.peek(("photo", 0, 4)) is not None


def test_two_that_made_the_same_photo_hold_one() -> None:
    kept = KeptPhotos(100)
    first, second = array(10), array(10)
    assert kept.put(("photo", 0, 1), first)[0] is first
    assert kept.put(("photo", 0, 1), second)[0] is first
    assert kept.bytes_kept == 10

# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory for photos follows the machine within bounds; the estimate says if it suffices."""

from __future__ import annotations

import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.photos.store import photo_budget_bytes, photo_memory

GIB = 2**30


@pytest.mark.parametrize(
    ("free", "budget"),
    [
        (0, limits.UNKNOWN_PHOTO_MEMORY_BYTES),
        (1, limits.MIN_PHOTO_MEMORY_BYTES),
        (8 * GIB, 2 * GIB),
        (1000 * GIB, limits.MAX_PHOTO_MEMORY_BYTES),
    ],
)
def test_the_budget_is_a_share_of_what_is_free(free: int, budget: int) -> None:
    assert photo_budget_bytes(free) == budget


def test_few_photos_are_in_memory_and_hundreds_are_read_on_demand() -> None:
    few = photo_memory(40, 640 * 480, masked=False, free_bytes=8 * GIB)
    assert few.fits
    assert few.used_bytes == few.all_bytes == 40 * 640 * 480 * 3 * 21 // 16
    assert few.sentence() == "in memory, 0.05 GB"
    many = photo_memory(400, 4000 * 3000, masked=True, free_bytes=8 * GIB)
    assert not many.fits
    assert many.all_bytes == 400 * 4000 * 3000 * 4 * 21 // 16
    assert many.used_bytes == many.budget_bytes == 2 * GIB
    assert many.sentence() == (
        "read on demand: 400 of 60.1 MB decoded are 23.47 GB, 2.00 GB of memory are for them"
    )


def test_the_figures_of_the_panel_stay_short_enough_for_a_row() -> None:
    most = photo_memory(10**4, 68_000.0, masked=True, free_bytes=1000 * GIB)
    assert most.fits
    assert len(most.sentence()) <= 18

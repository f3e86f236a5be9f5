# SPDX-License-Identifier: GPL-3.0-or-later
"""Contributor lists contain the intersections whose masks include a block; active blocks."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.render.tile_io import (
    CONTRIBUTORS_PADDING,
    active_blocks,
    list_contributors,
)

BEGIN, SPARE = 37, -5


@numba.njit
def _run(lanes, masks, begin, count, room, contributors, counts):  # type: ignore[no-untyped-def]
    if lanes == 16:
        list_contributors(16, masks, begin, count, room, contributors, counts)
    else:
        list_contributors(8, masks, begin, count, room, contributors, counts)


def _masks(kind: str, total: int, bits: int) -> np.ndarray:
    random = np.random.default_rng(total)
    if kind == "none":
        return np.zeros(total, np.uint32)
    if kind == "all":
        return np.full(total, (1 << bits) - 1, np.uint32)
    return random.integers(0, 1 << bits, total, dtype=np.uint32)


@pytest.mark.parametrize("lanes", [8, 16])
@pytest.mark.parametrize("kind", ["none", "all", "random"])
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 100])
def test_lists(lanes: int, kind: str, count: int) -> None:
    blocks, room = 256 // lanes, count + CONTRIBUTORS_PADDING
    # The masks end with the tile's last pair: nothing behind it may be read.
    masks: Any = _masks(kind, BEGIN + count, blocks)
    contributors = np.full(blocks * room + 8, SPARE, np.int32)
    counts = np.full(blocks, SPARE, np.int64)
    _run(lanes, masks, BEGIN, count, room, contributors, counts)
    for block in range(blocks):
        expected = BEGIN + np.flatnonzero((masks[BEGIN:] >> np.uint32(block)) & 1)
        assert counts[block] == len(expected)
        np.testing.assert_array_equal(contributors[block * room :][: len(expected)], expected)
    assert (contributors[blocks * room :] == SPARE).all()


@numba.njit
def _lit(lanes, m, plane):  # type: ignore[no-untyped-def]
    return active_blocks(16, m, plane) if lanes == 16 else active_blocks(8, m, plane)


@pytest.mark.parametrize("lanes", [8, 16])
def test_lit_blocks(lanes: int) -> None:
    random = np.random.default_rng(3)
    threshold = np.float32(limits.TRANSMITTANCE_MIN)
    below = np.nextafter(threshold, np.float32(0))
    for _ in range(20):
        light = np.full((256 // lanes, lanes), below, np.float32)
        chosen = random.uniform(size=len(light)) < 0.4
        light[chosen, random.integers(lanes, size=chosen.sum())] = threshold
        m = np.concatenate([np.ones(11, np.float32), light.ravel(), np.ones(16, np.float32)])
        assert _lit(lanes, m, 11) == sum(1 << int(block) for block in np.flatnonzero(chosen))

# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of UDIM tiles."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.mesh.textured_mesh import FIRST_UDIM, LAST_UDIM, udim_uvs


def test_uvs_move_to_the_tiles_of_their_atlases() -> None:
    uvs = np.random.default_rng(0).random((3, 3, 2)).astype(np.float32)
    moved = udim_uvs(uvs, np.array([0, 2, 1]), (FIRST_UDIM, 1013, LAST_UDIM))
    assert moved.dtype == np.float32
    assert np.array_equal(np.floor(moved).mean(1), [[0, 0], [9, 99], [2, 1]])
    assert np.abs(moved - np.floor(moved) - uvs).max() < 1e-5


def test_one_atlas_needs_no_index() -> None:
    uvs = np.full((2, 3, 2), 0.5, np.float32)
    assert np.array_equal(udim_uvs(uvs, None, (1002,)), uvs + np.float32([1, 0]))

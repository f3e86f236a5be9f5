# SPDX-License-Identifier: GPL-3.0-or-later
"""UDIM tiles: several textures side by side in one UV map. Needs numpy only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

TILE_COLUMNS, TILE_ROWS = 10, 100
FIRST_UDIM = 1001
"""UDIM tiles are 1001 + column + 10 row."""
LAST_UDIM = FIRST_UDIM + TILE_COLUMNS * TILE_ROWS - 1


def udim_uvs(
    corner_uvs: np.ndarray, face_atlas: np.ndarray | None, udims: Sequence[int]
) -> np.ndarray:
    """Return (f, 3, 2) float32 UVs in the UDIM tiles of their atlases, from UVs in [0, 1]."""
    number = np.asarray(udims, np.int64) - FIRST_UDIM
    of_faces = np.zeros(len(corner_uvs), np.int64) if face_atlas is None else face_atlas
    number = number[of_faces]
    shift = np.stack([number % TILE_COLUMNS, number // TILE_COLUMNS], axis=1)
    moved: np.ndarray = (corner_uvs + shift[:, None]).astype(np.float32)
    return moved

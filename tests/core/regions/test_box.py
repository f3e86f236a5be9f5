# SPDX-License-Identifier: GPL-3.0-or-later
"""Box detection from eight corners; visible edges of hulls."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.regions.box import (
    CUBE_CORNERS,
    CUBE_TRIANGLES,
    FLAT_SHARE,
    box_matrix,
    check_volume,
    hull_edges,
)


def random_rotation(random: np.random.Generator) -> np.ndarray:
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    return rotation * np.linalg.det(rotation)


def test_box_matrix_finds_boxes_only() -> None:
    random = np.random.default_rng(5)
    for _ in range(50):
        rotation = random_rotation(random)
        scale = 10 ** random.uniform(-1, 1, 3)
        box = (CUBE_CORNERS * scale) @ rotation.T + random.normal(size=3) * 100
        matrix = box_matrix(random.permutation(box))
        assert matrix is not None
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(scale.prod())
        found = CUBE_CORNERS @ matrix[:3, :3].T + matrix[:3, 3]
        distances = np.linalg.norm(found[:, None] - box[None], axis=2)
        limit = 1e-9 * np.linalg.norm(np.ptp(box, axis=0))
        assert max(distances.min(0).max(), distances.min(1).max()) <= limit
        sheared = box.copy()
        sheared[:, 0] += 0.1 * sheared[:, 2] - 0.1 * sheared[:, 2].mean()
        assert box_matrix(sheared) is None
    upright = box_matrix(CUBE_CORNERS * (1, 2, 3))
    assert upright == pytest.approx(np.diag([1, 2, 3, 1]))
    assert box_matrix(CUBE_CORNERS[:7]) is None
    assert box_matrix(np.repeat(CUBE_CORNERS[:2], 4, 0)) is None


def test_a_cube_has_twelve_edges() -> None:
    edges = hull_edges(CUBE_CORNERS, np.array(CUBE_TRIANGLES))
    expected = [
        (a, b) for a, b in itertools.combinations(range(8), 2)
        if np.abs(CUBE_CORNERS[a] - CUBE_CORNERS[b]).sum() == 2
    ]  # fmt: skip
    assert sorted(map(tuple, edges.tolist())) == expected


@pytest.mark.parametrize("offset", [0.0, 1e7])
def test_thin_is_not_flat(offset: float) -> None:
    check_volume(CUBE_CORNERS * (1, 1, 10 * FLAT_SHARE) + offset, "thin")
    with pytest.raises(MeshingError, match="flat"):
        check_volume(CUBE_CORNERS * (1, 1, 0.1 * FLAT_SHARE) + offset, "flat")
    with pytest.raises(MeshingError, match="'few' needs at least four"):
        check_volume(CUBE_CORNERS[:3], "few")
    with pytest.raises(MeshingError, match="not finite"):
        check_volume(np.where(CUBE_CORNERS > 0, np.inf, CUBE_CORNERS), "infinite")
    with pytest.raises(MeshingError, match="10001 corners"):
        check_volume(np.zeros((10_001, 3)), "many")

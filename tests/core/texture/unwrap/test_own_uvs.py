# SPDX-License-Identifier: GPL-3.0-or-later
"""UVs that a mesh has: tiles, edges of tiles, and what is refused or counted."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.limits import MAX_ATLASES
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import udim_uvs
from gaussian_wrapping_addon.core.texture.unwrap.unwrap import overlap_warning, own_uvs, uv_area

FACES = 24
TRIANGLE = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]])


def strip(count: int = FACES) -> SurfaceMesh:
    """Separate triangles of equal area."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    vertices = (corners + np.arange(count)[:, None, None] * [2.0, 0, 0]).reshape(-1, 3)
    return SurfaceMesh(vertices, np.arange(3 * count, dtype=np.int32).reshape(-1, 3))


def test_ordinary_uvs_are_kept_bit_by_bit() -> None:
    uvs = np.broadcast_to(TRIANGLE, (FACES, 3, 2)).astype(np.float32)
    own = own_uvs(strip(), uvs)
    assert own.udims == (1001,)
    assert own.warnings == ()
    assert own.unwrapped.face_atlas is None
    assert np.array_equal(own.unwrapped.corner_uvs, uvs)
    assert len(np.unique(own.unwrapped.charts)) == FACES
    assert uv_area(uvs) == pytest.approx(FACES * 0.32)


def test_tiles_are_numbered_by_column_and_row_and_lead_back() -> None:
    tiles = np.array([[0, 0], [9, 0], [0, 1], [3, 7]])[np.arange(FACES) % 4]
    uvs = (TRIANGLE + tiles[:, None]).astype(np.float32)
    own = own_uvs(strip(), uvs)
    assert own.udims == (1001, 1010, 1011, 1074)
    face_atlas = own.unwrapped.face_atlas
    assert face_atlas is not None
    assert face_atlas.tolist() == (np.arange(FACES) % 4).tolist()
    inside = own.unwrapped.corner_uvs
    assert inside.min() >= 0.0
    assert inside.max() <= 1.0
    assert np.abs(udim_uvs(inside, face_atlas, own.udims) - uvs).max() < 1e-6


def test_edges_of_tiles_belong_to_the_tile_of_their_face() -> None:
    """From 0 to 1, beyond it by rounding, and faces collapsed to a point of the far edge."""
    whole = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    uvs = np.stack([whole, whole + [0.0, 0.99995] * (whole == 9), whole - 5e-5, np.ones((3, 2)),
                    whole + 5e-5] + [whole] * 5)  # fmt: skip
    own = own_uvs(strip(len(uvs)), uvs)
    assert own.udims == (1001,)
    assert own.unwrapped.corner_uvs.min() == 0.0
    assert own.unwrapped.corner_uvs.max() == 1.0
    (warning,) = own.warnings
    assert warning.code == "uv-flat"
    assert warning.text.startswith("1 of 10 faces have no area in the UV map, 10 %")


@pytest.mark.parametrize(
    ("change", "words"),
    [(np.nan, r"Face 5 of the mesh has UVs that are not finite\."),
     (-1.0, "Face 5 of the mesh has UVs outside of the UDIM tiles"),
     (11.0, "outside of the UDIM tiles"), (0.5, "cross the edge of a tile")],
)  # fmt: skip
def test_uvs_that_cannot_be_used_are_refused_by_face(change: float, words: str) -> None:
    uvs = np.array(np.broadcast_to(TRIANGLE, (FACES, 3, 2)))
    uvs[5] += [change, 0.0]
    with pytest.raises(MeshingError, match=words) as caught:
        own_uvs(strip(), uvs)
    assert "--uvs new" in caught.value.hint


def test_repeated_textures_say_how_many_faces_do_so() -> None:
    with pytest.raises(MeshingError, match=f"as do {FACES} faces in all"):
        own_uvs(strip(), np.broadcast_to(3.0 * TRIANGLE, (FACES, 3, 2)))


def test_uvs_without_area_are_refused() -> None:
    uvs = np.array(np.broadcast_to(TRIANGLE, (FACES, 3, 2)))
    uvs[: FACES // 2 + 1] = 0.25
    with pytest.raises(MeshingError, match="54 % of the surface have no area"):
        own_uvs(strip(), uvs)


def test_too_many_tiles_are_refused() -> None:
    uvs = TRIANGLE + np.stack([np.arange(FACES) % 10, np.arange(FACES) // 10], axis=1)[:, None]
    with pytest.raises(MeshingError, match=f"{FACES} UDIM tiles; the limit is {MAX_ATLASES}"):
        own_uvs(strip(), uvs)


def test_overlaps_are_a_warning() -> None:
    assert overlap_warning(0, 9) is None
    warning = overlap_warning(3, 9)
    assert warning is not None
    assert warning.text.startswith("3 of 9 texels")

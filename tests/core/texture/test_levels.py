# SPDX-License-Identifier: GPL-3.0-or-later
"""Levels of detail: closed, of the faces asked for, coloured as the mesh they come from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.meshing.mesh_check import check_mesh
from gaussian_wrapping_addon.core.meshing.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture.atlas_raster import raster_atlas
from gaussian_wrapping_addon.core.texture.fill import grow
from gaussian_wrapping_addon.core.texture.levels import levels_of_detail
from gaussian_wrapping_addon.core.texture.texel_points import texel_points
from gaussian_wrapping_addon.core.texture.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.texture.unwrap import unwrap
from tests.core.texture.detail_scenes import bumpy_ball
from tests.core.texture.texture_scenes import waves

SIDE_PX = 512
THREADS = 2


def positions(mesh: SurfaceMesh, uvs: np.ndarray, size_px: int):
    raster = raster_atlas(uvs, size_px, THREADS)
    texels = np.flatnonzero(raster.inside.ravel())
    normals = np.zeros_like(mesh.vertices)
    return texels, texel_points(mesh, raster, texels, normals).points


def colors(points: np.ndarray) -> np.ndarray:
    """Of directions alone: levels lie above and below the ball that was painted."""
    return waves(points / np.linalg.norm(points, axis=1, keepdims=True))


@pytest.fixture(scope="module")
def painted(tmp_path_factory) -> TexturedMesh:
    mesh = bumpy_ball(20)
    uvs = unwrap(mesh, SIDE_PX, 4, tmp_path_factory.mktemp("unwrap"), Progress()).corner_uvs
    image = np.full((SIDE_PX, SIDE_PX, 3), 128, np.uint8)
    texels, points = positions(mesh, uvs, SIDE_PX)
    image.reshape(-1, 3)[texels] = np.rint(colors(points)).astype(np.uint8)
    # As the texture stage does: averages across chart borders are of the chart's own colours.
    empty = raster_atlas(uvs, SIDE_PX, THREADS).face < 0
    ring = np.where((image == 128).all(axis=2), -1, 0).astype(np.int16)
    grow(image, ring, np.where(empty, -1, 0).astype(np.int32), 1, inside=True)
    grow(image, ring, np.where(empty, -1, 0).astype(np.int32), 8, inside=False)
    return TexturedMesh(mesh, uvs, image)


def test_each_level_is_closed_a_quarter_and_looks_alike(
    painted: TexturedMesh, tmp_path: Path
) -> None:
    settings = TextureSettings(lods=2, ambient_occlusion="on")
    levels = levels_of_detail(painted, None, settings, tmp_path, Progress(), threads=THREADS)
    assert [len(level.mesh.faces) for level in levels] == [1200, 300]
    assert [level.albedo.shape[0] for level in levels] == [256, 128]
    assert list(tmp_path.iterdir()) == []
    for level in levels:
        check = check_mesh(level.mesh.vertices, level.mesh.faces, None)
        assert check.good
        texels, points = positions(level.mesh, level.corner_uvs, level.albedo.shape[0])
        # Rays along the normals lean: a colour is met beside the place where it is looked for.
        wrong = level.albedo.reshape(-1, 3)[texels] - colors(points)
        assert np.sqrt((wrong**2).mean()) < 2.5
        assert level.normal_map is not None
        assert level.normal_map.shape == level.albedo.shape
        assert level.occlusion is not None
        assert level.statistics["normal_map"]["dense_faces"] == len(painted.mesh.faces)


def test_the_dense_mesh_is_the_source_of_normals(painted: TexturedMesh, tmp_path: Path) -> None:
    dense = bumpy_ball(40)
    settings = TextureSettings(lods=1)
    (level,) = levels_of_detail(painted, dense, settings, tmp_path, Progress(), threads=THREADS)
    assert level.statistics["normal_map"]["dense_faces"] == len(dense.faces)
    assert level.occlusion is None


def test_levels_end_at_the_floor_and_maps_can_be_off(painted: TexturedMesh, tmp_path: Path) -> None:
    settings = TextureSettings(lods=8, normal_map="off")
    levels = levels_of_detail(painted, None, settings, tmp_path, Progress(), threads=THREADS)
    assert [len(level.mesh.faces) for level in levels] == [1200, 300]
    assert all(level.normal_map is None for level in levels)
    none = levels_of_detail(painted, None, TextureSettings(), tmp_path, Progress(), threads=THREADS)
    assert none == []

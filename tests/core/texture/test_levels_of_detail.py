# SPDX-License-Identifier: GPL-3.0-or-later
"""Levels of detail: closed, with the target number of faces, coloured like their source."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.evaluation.report.figures import collect_warnings
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.meshing.checks import validate_manifold
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture import levels_of_detail as levels_module
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas, texel_points
from gaussian_wrapping_addon.core.texture.fill import dilate
from gaussian_wrapping_addon.core.texture.levels_of_detail import chart_pyramid, levels_of_detail
from gaussian_wrapping_addon.core.texture.unwrap.unwrap import unwrap
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
    dilate(image, ring, np.where(empty, -1, 0).astype(np.int32), 1, inside=True)
    dilate(image, ring, np.where(empty, -1, 0).astype(np.int32), 8, inside=False)
    return TexturedMesh(mesh, uvs, image)


@pytest.mark.proof
def test_each_level_is_closed_a_quarter_and_looks_alike(
    painted: TexturedMesh, tmp_path: Path
) -> None:
    settings = TextureSettings(lods=2, ambient_occlusion="on")
    levels = levels_of_detail(painted, None, settings, tmp_path, Progress(), threads=THREADS)
    assert [len(level.mesh.faces) for level in levels] == [1200, 300]
    assert [level.albedo.shape[0] for level in levels] == [256, 128]
    assert list(tmp_path.iterdir()) == []
    for level in levels:
        check = validate_manifold(level.mesh.vertices, level.mesh.faces, None)
        assert check.good
        texels, points = positions(level.mesh, level.corner_uvs, level.albedo.shape[0])
        # Rays along the normals lean: a colour is met beside the place where it is looked for.
        wrong = level.albedo.reshape(-1, 3)[texels] - colors(points)
        assert np.sqrt((wrong**2).mean()) < 2.5
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


@pytest.mark.parametrize("level", [0, 3, 6])
def test_no_colour_of_another_chart_comes_in(level: int) -> None:
    """Charts of one colour each, a texel apart: what is looked up in one is its own colour."""
    side = 64
    mesh, uvs, image, palette = patches(side)
    pyramid = chart_pyramid(TexturedMesh(mesh, uvs, image), 6, THREADS)
    generator = np.random.default_rng(4)
    face = generator.integers(0, len(mesh.faces), 4000)
    weights = generator.dirichlet([1, 1, 1], 4000)
    uv = np.einsum("nc,ncx->nx", weights, uvs[face].astype(np.float64))
    found = pyramid.sample_level(uv, face, level)
    np.testing.assert_array_equal(found, palette[face // 2])


@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_ramp_is_the_same_ramp_in_each_level(level: int) -> None:
    side = 64
    mesh, uvs, image, _ = patches(side)
    row, column = np.indices((side, side))
    image = np.repeat((2 * column + row).astype(np.uint8)[..., None], 3, axis=2)
    pyramid = chart_pyramid(TexturedMesh(mesh, uvs, image), 2, THREADS)
    face = np.arange(len(mesh.faces)).repeat(50)
    middle = uvs.reshape(-1, 6, 2).mean(axis=1)[face // 2]
    corner = np.random.default_rng(6).integers(0, 3, len(face))
    shares = np.random.default_rng(7).uniform(0.0, 0.5, (len(face), 1))
    uv = middle + shares * (uvs[face, corner] - middle)  # its four texels are of its chart
    found = pyramid.sample_level(uv, face, level)[:, 0]
    wanted = 2 * (uv[:, 0] * side - 0.5) + (1 - uv[:, 1]) * side - 0.5
    assert np.abs(found - wanted).max() <= 0.5 + 1e-3


def test_a_level_is_averaged_within_its_chart() -> None:
    side = 64
    mesh, uvs, image, _ = patches(side)
    fine = np.indices((side, side)).sum(axis=0) % 2  # a chequer of texels: 0 and 200
    image = np.repeat((200 * fine).astype(np.uint8)[..., None], 3, axis=2)
    pyramid = chart_pyramid(TexturedMesh(mesh, uvs, image), 6, THREADS)
    whole = (pyramid.charts[1] >= 0) & (np.abs(pyramid.colors[1][..., 0] - 100.0) < 0.01)
    assert whole.sum() > 500
    assert {0, 100} >= {round(v) for v in np.unique(pyramid.colors[1][pyramid.charts[1] >= 0])} - {
        67, 133, 200,  # three texels, or one or two at a corner
    }  # fmt: skip


def patches(side: int) -> tuple[SurfaceMesh, np.ndarray, np.ndarray, np.ndarray]:
    """A square cut into 9 charts of two faces, a gutter of two texels around each."""
    palette = np.random.default_rng(1).integers(0, 256, (9, 3)).astype(np.uint8)
    vertices, faces, uvs = [], [], []
    image = np.zeros((side, side, 3), np.uint8)
    step = side // 3
    for number in range(9):
        x, y = number % 3, number // 3
        quad = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        vertices += [[2 * x + a, 2 * y + b, 0.0] for a, b in quad.tolist()]
        low = np.array([x, y]) * step + 1.0
        places = (low + quad * (step - 2)) / side
        for corners in ([0, 1, 2], [0, 2, 3]):
            faces.append([4 * number + k for k in corners])
            uvs.append(places[corners])
        rows = slice(side - (y + 1) * step, side - y * step)
        image[rows, x * step : (x + 1) * step] = palette[number]
    mesh = SurfaceMesh(np.array(vertices), np.array(faces, np.int32))
    return mesh, np.array(uvs, np.float32), image, palette


def test_levels_that_are_not_made_become_a_warning(
    painted: TexturedMesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def warnings(lods: int) -> list[str]:
        top = replace(painted, statistics={})
        settings = TextureSettings(lods=lods, normal_map="off")
        levels_of_detail(top, None, settings, tmp_path, Progress(), threads=THREADS)
        report = {"regions": {"auto": {"texture": top.statistics}}}
        assert all(w.hint for w in collect_warnings(report))
        return [w.text for w in collect_warnings(report)]

    assert warnings(2) == []
    (text,) = warnings(8)
    assert "2 of 8 levels" in text
    assert "75 faces" in text

    def stuck(vertices: np.ndarray, faces: np.ndarray, *_: object, **__: object) -> SurfaceMesh:
        return SurfaceMesh(vertices, faces)

    monkeypatch.setattr(levels_module, "decimate", stuck)
    (text,) = warnings(1)
    assert "0 of 1 levels" in text
    assert "tear" in text

    def refused(*_: object, **__: object) -> None:
        raise MeshingError("No face can go.")

    monkeypatch.setattr(levels_module, "decimate", refused)
    (text,) = warnings(1)
    assert text.endswith("No face can go.")

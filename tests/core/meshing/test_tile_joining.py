# SPDX-License-Identifier: GPL-3.0-or-later
"""Tiles joined one after another: the same surface as at once, in less memory."""

from __future__ import annotations

import dataclasses
import tracemalloc
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError
from gaussian_wrapping_addon.core.field.vacancy import VacancyResult
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.checks import mesh_statistics
from gaussian_wrapping_addon.core.meshing.primal_adaptive import (
    made_manifold,
    mesh_region,
    simplified,
    small_handles_closed,
)
from gaussian_wrapping_addon.core.meshing.surface_points import Field
from gaussian_wrapping_addon.core.meshing.tiles.store import load_surface, save_surface
from gaussian_wrapping_addon.core.meshing.tiles.tile import tile_faces
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.meshing.meshing_scenes import (
    Distance,
    ShapeField,
    assert_closed_manifold,
    cube,
    gaussians_on,
    some_cameras,
    sphere,
    torus,
)
from tests.core.meshing.test_tiles import SHAPES, points_on_sheet
from tests.core.meshing.tiled_meshing import LabelledTiles, labelled_tiles, mesh_in_tiles
from tests.proofs import first_then_proofs

SIGMA = 0.02
ALL_PARTS = MeshingSettings(points=1, min_component_share=0.0)


def labelled(
    distance: Distance, region: Region, tiles: int, points: int, *, spacing: str = "uniform"
) -> LabelledTiles:
    field = ShapeField(distance, SIGMA)
    return labelled_tiles(
        field, field, gaussians_on(distance, region, 800, SIGMA), some_cameras(), region,
        MeshingSettings(points=points, spacing=spacing), Progress(), tiles=tiles, seed=0,
        threads=1,
    )  # fmt: skip


class Blotches:
    """Vacancy that varies over a few spacings, with noise: edges of many faces everywhere."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def vacancy(self, points: np.ndarray) -> VacancyResult:
        waves = np.sin(points * [40.0, 37.0, 35.0]).prod(1)
        value = 0.5 + 0.5 * waves + 0.2 * self.rng.normal(size=len(points))
        return VacancyResult(
            np.clip(value, 0, 1).astype(np.float32), np.zeros(len(points), np.int32)
        )


@cache
def blotchy_tiles() -> LabelledTiles:
    _, tiling, gathered, plan = points_on_sheet(2000)
    field = [Field(Blotches(tile), None, 1) for tile in range(len(tiling))]
    parts = [
        tile_faces(field[tile], plan, gathered, tile, Progress()) for tile in range(len(tiling))
    ]
    return LabelledTiles(field[0], plan, gathered, parts)


def at_once(tiles: LabelledTiles, settings: MeshingSettings = ALL_PARTS) -> SurfaceMesh:
    """The same tiles joined with the whole dense surface in memory."""
    cloud, plan = tiles.gathered.cloud, tiles.plan
    vertices, faces, kind, figures = made_manifold(
        cloud.points, tiles.dense_faces(), cloud, plan.region, settings, Progress()
    )
    figures["dense_vertices"] = len(vertices)
    vertices, faces, kind = simplified(vertices, faces, kind, plan.target, plan.share, plan.region)
    vertices, faces, kind, handles = small_handles_closed(vertices, faces, kind)
    return SurfaceMesh(vertices, faces.astype(np.int32), figures | handles)


def corner_set(mesh: SurfaceMesh) -> set[tuple[Any, ...]]:
    """Faces as their corners' coordinates, the least first."""
    faces = []
    for corners in mesh.vertices[mesh.faces].tolist():
        least = corners.index(min(corners))
        faces.append(tuple(map(tuple, corners[least:] + corners[:least])))
    return set(faces)


@pytest.mark.parametrize("name", ["torus", "plate", "cut"])
def test_uniform_tiles_have_every_face_of_the_whole(name: str) -> None:
    tiles = labelled(*SHAPES[name], 5, 3000)
    assert corner_set(tiles.join(ALL_PARTS)) == corner_set(at_once(tiles))


def test_selection_is_that_of_the_whole_but_in_bands() -> None:
    tiles = labelled(torus(), cube(1.5), 4, 4000, spacing="adaptive")
    mesh, whole = tiles.join(ALL_PARTS), at_once(tiles)
    assert len(mesh.vertices) == len(whole.vertices)
    assert mesh.provenance["dense_vertices"] == whole.provenance["dense_vertices"]
    here, there = ({tuple(p) for p in m.vertices.tolist()} for m in (mesh, whole))
    assert len(here & there) > 0.75 * len(there)
    # Of the pieces of one surface each has its share of vertices.
    owner = [np.bincount(tiles.plan.tiling.owner(m.vertices), minlength=4) for m in (mesh, whole)]
    np.testing.assert_allclose(owner[0], owner[1], rtol=0.05)


def test_vertices_of_removed_parts_are_not_missed() -> None:
    """Parts that go hold more than half of the dense surface; what stays gets its vertices."""

    def distance(p: np.ndarray) -> np.ndarray:
        big = sphere(0.5)(p - [0.7, 0.0, 0.0])
        others = [sphere(0.35)(p - np.array(c)) for c in OTHERS]
        return np.asarray(np.minimum.reduce([big, *others]))

    settings = MeshingSettings(points=800, most_parts=1)
    field, region = ShapeField(distance, SIGMA), cube(1.4)
    arrays = gaussians_on(distance, region, 1500, SIGMA)
    mesh = mesh_in_tiles(
        field, field, arrays, some_cameras(), region, settings, Progress(), tiles=3, seed=0,
        threads=1,
    )  # fmt: skip
    whole = mesh_region(
        Field(field, field, 1), arrays, some_cameras(), region, settings, Progress(), seed=0
    )
    assert assert_closed_manifold(mesh).components == 1
    assert mesh.provenance["removed_solids"] == whole.provenance["removed_solids"] == 4
    assert mesh.provenance["removed_area_share"] == pytest.approx(
        whole.provenance["removed_area_share"], rel=0.02
    )
    assert len(mesh.vertices) == pytest.approx(len(whole.vertices), rel=0.03)


OTHERS = ((-0.6, 0.6, 0.0), (-0.6, -0.6, 0.0), (-0.6, 0.0, 0.8), (-0.6, 0.0, -0.8))


def peak_bytes(work: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.proof
def test_memory_is_that_of_the_simplified_mesh(tmp_path: Path) -> None:
    tiles = labelled(torus(), cube(1.5), 12, 4000, spacing="adaptive")
    # The simplified mesh is a fiftieth, so that the dense one decides where it is held.
    tiles = dataclasses.replace(tiles, plan=dataclasses.replace(tiles.plan, target=0, share=0.02))
    paths = [tmp_path / f"{tile}.npz" for tile in range(12)]
    for path, surface in zip(paths, tiles.surfaces(), strict=True):
        save_surface(path, surface)

    class Stored:
        def __getitem__(self, tile: int) -> Any:
            return load_surface(paths[tile])

    held: Any = Stored()
    mesh = tiles.join(ALL_PARTS, surfaces=held)  # compiles, too
    whole = at_once(tiles)
    assert_closed_manifold(mesh)
    assert len(mesh.vertices) == pytest.approx(len(whole.vertices), rel=0.1)
    streamed = peak_bytes(lambda: tiles.join(ALL_PARTS, surfaces=held))
    # Measured: 0.42; counts of costs and a tile with its neighbours are a large part of so small a
    # surface.
    assert streamed < 0.5 * peak_bytes(lambda: at_once(tiles))


def test_stored_surfaces_give_the_same_mesh_bit_for_bit(tmp_path: Path) -> None:
    tiles = labelled(*SHAPES["cut"], 3, 1500, spacing="adaptive")
    again = []
    for number, surface in enumerate(tiles.surfaces()):
        save_surface(tmp_path / f"{number}.npz", surface)
        again.append(load_surface(tmp_path / f"{number}.npz"))
    first, second = tiles.join(ALL_PARTS), tiles.join(ALL_PARTS, surfaces=again)
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)
    assert first.provenance == second.provenance


def test_labels_that_contradict_each_other_are_told() -> None:
    tiles = labelled(torus(), cube(1.5), 3, 1500)
    part = tiles.parts[1]
    solid = part.solid.copy()
    solid[len(solid) // 2] ^= True
    wrong = dataclasses.replace(part, solid=solid)
    tiles = dataclasses.replace(tiles, parts=[tiles.parts[0], wrong, tiles.parts[2]])
    with pytest.raises(MeshingError, match="do not agree"):
        tiles.join(ALL_PARTS)


@pytest.mark.parametrize("share", first_then_proofs([0.2, 1.0]))
def test_joined_at_once_or_not_labels_full_of_touching_parts_become_manifold(share: float) -> None:
    tiles = blotchy_tiles()
    tiles = dataclasses.replace(tiles, plan=dataclasses.replace(tiles.plan, share=share))
    mesh = tiles.join(ALL_PARTS)
    figures = assert_closed_manifold(mesh)
    assert mesh.provenance["split_vertices"] > 2_000
    assert mesh.provenance["degenerate_faces_left"] == 0
    if share == 1.0:
        whole = at_once(tiles)
        assert figures.components == mesh_statistics(whole).components
        assert mesh.provenance["split_vertices"] == whole.provenance["split_vertices"]
        assert figures.volume == pytest.approx(mesh_statistics(whole).volume, rel=5e-3)
        assert figures.area == pytest.approx(mesh_statistics(whole).area, rel=5e-3)
    else:
        assert figures.vertices < 0.5 * mesh.provenance["dense_vertices"]

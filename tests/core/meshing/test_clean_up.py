# SPDX-License-Identifier: GPL-3.0-or-later
"""Smoothing, decimation and small handles: what they lower and what they keep."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.mesh.components import compacted
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing import clean_up as clean_up_module
from gaussian_wrapping_addon.core.meshing.checks import ManifoldCheck, validate_manifold
from gaussian_wrapping_addon.core.meshing.clean_up import clean_up, smooth, without_small_handles
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.surface_points import Field
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.meshing.closed_shapes import Mesh, ball, joined, noisy, ring, slab, wire
from tests.core.meshing.meshing_scenes import (
    ShapeField,
    gaussians_on,
    settings,
    some_cameras,
    torus,
)

REGION = Region.box("cut", [-1.5, -1.5, -1.5], [1.5, 1.5, 0.2])
FIELD = ShapeField(torus(), 0.02)


@pytest.fixture(scope="module")
def mesh() -> SurfaceMesh:
    """A torus cut flat, so that a part of its surface is the region's boundary."""
    return mesh_region(
        Field(FIELD, FIELD, 1), gaussians_on(torus(), REGION, 800, 0.02), some_cameras(), REGION,
        settings(3000), Progress(), seed=0,
    )  # fmt: skip


def cleaned(mesh: SurfaceMesh, **changes: int) -> SurfaceMesh:
    return clean_up(mesh, REGION, MeshingSettings(**changes), FIELD, Progress()).mesh


@pytest.mark.parametrize(("steps", "share"), [(0, 0.3), (4, 0.0), (4, 0.3)])
def test_what_was_asked_for_is_done_and_told(mesh: SurfaceMesh, steps: int, share: float) -> None:
    target = round(share * len(mesh.faces))
    result = cleaned(mesh, smooth_steps=steps, target_faces=target)
    before, after = (validate_manifold(m.vertices, m.faces) for m in (mesh, result))
    assert before.good
    assert after.good, after.defects()
    assert [p.genus for p in after.parts] == [p.genus for p in before.parts] == [1]
    assert after.volume == pytest.approx(before.volume, rel=0.02)
    assert result.faces.dtype == np.int32
    if target:
        assert 0.98 * target <= len(result.faces) <= target
    told = result.provenance
    assert (told["smooth_steps"], told["target_faces"]) == (steps, target)
    assert told["faces_before_clean_up"] == len(mesh.faces)
    capped = np.abs(result.vertices[:, 2] - 0.2) < 1e-9
    assert told["vertices_on_region_boundary"] == capped.sum() > 0
    assert told["vertices_on_surface"] == (~capped).sum()
    assert REGION.contains(result.vertices, 1e-9).all()
    away = np.abs(FIELD.vacancy(result.vertices[~capped]).vacancy - 0.5)
    assert told["level_error_max"] == pytest.approx(away.max(), abs=1e-6)
    assert told["level_error_max"] > mesh.provenance["level_error_max"]


def test_the_dense_mesh_is_kept_where_faces_went(mesh: SurfaceMesh) -> None:
    def dense(**changes: int) -> SurfaceMesh | None:
        return clean_up(mesh, REGION, MeshingSettings(**changes), FIELD, Progress()).dense

    kept = dense(target_faces=500)
    assert kept is not None
    assert (kept.vertices == mesh.vertices).all()
    assert (kept.faces == mesh.faces).all()
    for changes in ({}, {"smooth_steps": 2}, {"target_faces": 10**6}):
        assert dense(**changes) is None
    # Smoothing comes first: the light mesh is to look like the smooth one.
    smooth = dense(target_faces=500, smooth_steps=2)
    assert smooth is not None
    assert (smooth.vertices == cleaned(mesh, smooth_steps=2).vertices).all()


def test_a_target_out_of_reach_is_said(mesh: SurfaceMesh) -> None:
    assert cleaned(mesh) is mesh, "nothing asked for is nothing done"
    many, few = (cleaned(mesh, target_faces=target) for target in (10**6, 4))
    np.testing.assert_array_equal(many.faces, mesh.faces)
    assert validate_manifold(few.vertices, few.faces).good
    assert len(few.faces) > 4
    for result, words in ((many, "1000000 requested"), (few, "4 requested")):
        assert any(words in note["text"] for note in result.provenance["notes"])


FLAT = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1e-3]])
"""Corners of a tetrahedron too coarse for the filter."""


def smoothed(mesh: Mesh, steps: int, region: Region | None = None) -> np.ndarray:
    return smooth(*mesh, steps, Progress(), region=region)


def test_noise_on_a_ball_goes_and_the_ball_stays() -> None:
    mesh = noisy(ball(4), 0.01)
    after = smoothed(mesh, 10)
    errors = [np.abs(np.linalg.norm(points, axis=1) - 1).std() for points in (mesh[0], after)]
    assert errors[1] < 0.4 * errors[0]
    assert np.linalg.norm(after, axis=1).mean() == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("steps", [1, 10, 40])
@pytest.mark.parametrize(
    "make", [lambda: noisy(ring(), 0.01), wire, lambda: slab((1, 1, 0.005), 0.1),
             lambda: joined(ball(2), (wire()[0] + 3, wire()[1])), lambda: ball(0),
             lambda: (FLAT, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))],
)  # fmt: skip
def test_every_part_keeps_its_volume_and_the_mesh_stays_good(
    make: Callable[[], Mesh], steps: int
) -> None:
    mesh = make()
    before, after = validate_manifold(*mesh), validate_manifold(smoothed(mesh, steps), mesh[1])
    assert after.good, after.defects()
    for first, second in zip(before.parts, after.parts, strict=True):
        assert second.genus == first.genus
        assert second.volume == pytest.approx(first.volume, rel=0.0101)


def test_caps_stay_in_their_planes_and_the_mesh_in_its_region() -> None:
    vertices, faces = slab((1, 1, 1), 0.15)
    region = Region.box("cut", [-1.5, -1.5, -1.5], [1.0, 1.0, 1.0])
    on_cap = np.abs(vertices - 1.0) < 1e-12  # (v, 3)
    free = ~on_cap.any(1)
    vertices = vertices.copy()
    vertices[free] += 0.01 * np.random.default_rng(0).normal(size=(free.sum(), 3))
    vertices[free] = np.minimum(vertices[free], 0.999)
    after = smoothed((vertices, faces), 8, region)
    assert (np.abs(after - 1.0)[on_cap] < 1e-12).all()
    assert region.contains(after, 1e-12).all()
    corner = on_cap.all(1)
    np.testing.assert_array_equal(after[corner], vertices[corner])
    assert (after[free] != vertices[free]).any(1).mean() > 0.9
    assert validate_manifold(after, faces).good


def test_a_boundary_stays_where_it_is() -> None:
    vertices, faces = noisy(ball(3), 0.01)
    faces = faces[(ball(3)[0][faces][:, :, 2] <= 0.0).all(1)]
    used, index = np.unique(faces, return_inverse=True)
    vertices, rim = vertices[used], np.abs(ball(3)[0][used][:, 2]) < 1e-9
    after = smoothed((vertices, index.reshape(-1, 3)), 5)
    np.testing.assert_array_equal(after[rim], vertices[rim])
    assert (after[~rim] != vertices[~rim]).any()


@pytest.mark.parametrize(("scale", "shift"), [(2.0**-10, 0.0), (2.0**13, 0.0), (1.0, 2.0**22)])
def test_neither_scale_nor_place_changes_the_result(scale: float, shift: float) -> None:
    vertices, faces = noisy(ring(60, 20), 0.01)
    vertices = np.round(vertices * 2**20) / 2**20
    here = smoothed((vertices, faces), 5)
    there = (smoothed((vertices * scale + shift, faces), 5) - shift) / scale
    assert np.abs(here - there).max() < 1e-7


def test_no_steps_and_no_faces_change_nothing_and_it_can_be_cancelled() -> None:
    mesh = ball(1)
    np.testing.assert_array_equal(smoothed(mesh, 0), mesh[0])
    assert len(smoothed((np.zeros((0, 3)), np.zeros((0, 3), int)), 3)) == 0
    with pytest.raises(Cancelled):
        smooth(*mesh, 3, Progress(is_cancelled=lambda: True))


QUADS = {
    (0, 1): [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)],
    (0, -1): [(0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)],
    (1, 1): [(0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0)],
    (1, -1): [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)],
    (2, 1): [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)],
    (2, -1): [(0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)],
}


def surface_of(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of filled cubes of side 1, two triangles a square."""
    padded = np.pad(cells, 1)
    quads = []
    for (axis, way), corners in QUADS.items():
        bare = padded & ~np.roll(padded, -way, axis)
        at = np.argwhere(bare) - 1
        quads.append(at[:, None] + np.array(corners))
    points = np.concatenate(quads)  # (q, 4, 3)
    vertices, index = np.unique(points.reshape(-1, 3), axis=0, return_inverse=True)
    index = index.reshape(-1, 4)
    # Not quite flat: a disc over three points of a line would have faces without area.
    noise = np.random.default_rng(0).uniform(-0.02, 0.02, vertices.shape)
    return vertices + noise, np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]])


def checked(vertices: np.ndarray, faces: np.ndarray) -> ManifoldCheck:
    vertices, faces, _ = compacted(vertices, faces)
    result = validate_manifold(vertices, faces)
    assert result.good, result.defects()
    return result


def block(size: tuple[int, int, int], room: int = 6) -> np.ndarray:
    cells = np.zeros((size[0], size[1], size[2] + room), np.bool_)
    cells[:, :, : size[2]] = True
    return cells


def with_arch(cells: np.ndarray, x: int, y: int, z: int) -> np.ndarray:
    """Two posts of one cube on top of something, and a beam over them."""
    result = cells.copy()
    result[x, y, z] = result[x + 2, y, z] = True
    result[x : x + 3, y, z + 1] = True
    return result


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e4])
def test_a_small_arch_becomes_a_bump(scale: float) -> None:
    vertices, faces = surface_of(with_arch(with_arch(block((16, 16, 4)), 6, 7, 4), 2, 2, 4))
    assert checked(vertices, faces).parts[0].genus == 2
    moved = scale * (vertices + 100.0)
    closed = without_small_handles(moved, faces, scale)
    assert (closed.closed, closed.left) == (2, 0)
    assert [part.genus for part in checked(moved, closed.faces).parts] == [0]
    assert len(closed.faces) < len(faces)
    # Far from the arches nothing has changed.
    far = vertices[faces].max((1, 2)) > 14
    rows = {tuple(face) for face in closed.faces.tolist()}
    assert all(tuple(face) in rows for face in faces[far].tolist())


def cells_of(shape: tuple[int, int, int], *boxes: tuple[slice | int, ...]) -> np.ndarray:
    """Fill boxes of cells, one after another; every second one is emptied again."""
    cells = np.zeros(shape, np.bool_)
    for number, box in enumerate(boxes):
        cells[box] = number % 2 == 0
    return cells


EVERYTHING = (slice(None),)
WIRE = cells_of((30, 3, 4), (slice(None), 1, 0))
HANDLES = {  # cells, length of an edge, handles closed, genus left
    # Neither lies in a small box: around the hole's other loop the whole plate would have to.
    "pinhole and opening of a plate": (
        cells_of((20, 20, 2), EVERYTHING, (4, 4)) & cells_of(
            (20, 20, 2), EVERYTHING, (slice(10, 16), slice(10, 16))), 1.0, 0, 2,
    ),
    "ring of thin wire": (
        cells_of((12, 12, 1), EVERYTHING, (slice(1, -1), slice(1, -1))), 1.0, 0, 1,
    ),
    # Closing it would cut off a ring that stands out: a thing of its own, not noise.
    "ring around a wire": (
        cells_of((9, 9, 20), (slice(3, 6), 4, slice(14)))
        | cells_of((9, 9, 20), (slice(2, 7), 4, slice(14, 19)), (slice(3, 6), 4, slice(15, 18))),
        1.2, 0, 1,
    ),
    "arch on a wire": (with_arch(WIRE, 13, 1, 1), 1.0, 1, 0),
    "tiny ring": (cells_of((12, 12, 3), (slice(4, 7), slice(4, 7), 0), (5, 5, 0)), 1.0, 1, 0),
}  # fmt: skip


@pytest.mark.parametrize("name", HANDLES)
def test_handles_of_things_stay_and_small_ones_go(name: str) -> None:
    cells, edge, count, genus = HANDLES[name]
    vertices, faces = surface_of(cells)
    closed = without_small_handles(vertices, faces, edge)
    assert closed.closed == count
    (part,) = checked(vertices, closed.faces).parts
    assert part.genus == genus
    if count == 0:
        np.testing.assert_array_equal(closed.faces, faces)
    if name == "arch on a wire":  # which is not cut
        assert 30.0 < part.volume < 37.0


def test_what_cannot_be_closed_is_left_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = surface_of(with_arch(block((16, 16, 4)), 6, 7, 4))
    monkeypatch.setattr(clean_up_module, "MAX_LOOP_EDGES", 3)
    closed = without_small_handles(vertices, faces, 1.0)
    assert (closed.closed, closed.left) == (0, 1)
    np.testing.assert_array_equal(closed.faces, faces)


def test_edges_that_the_mesh_has_elsewhere_are_not_used_again() -> None:
    """Many arches side by side share outlines; all that is closed stays a manifold."""
    cells = block((24, 24, 3))
    for x in range(2, 20, 5):
        for y in range(2, 22, 2):
            cells = with_arch(cells, x, y, 3)
    vertices, faces = surface_of(cells)
    before = checked(vertices, faces)
    closed = without_small_handles(vertices, faces, 1.0)
    after = checked(vertices, closed.faces)
    assert before.parts[0].genus == 40
    assert after.parts[0].genus == 40 - closed.closed
    assert closed.closed == 40

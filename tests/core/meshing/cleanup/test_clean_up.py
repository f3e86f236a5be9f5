# SPDX-License-Identifier: GPL-3.0-or-later
"""Smoothing and decimation of a region's mesh, as in the mesh stage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.checks import validate_manifold
from gaussian_wrapping_addon.core.meshing.clean_up import clean_up
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.surface_points import Field
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.settings import MeshingSettings
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


def test_off_means_untouched(mesh: SurfaceMesh) -> None:
    assert cleaned(mesh) is mesh


@pytest.mark.parametrize(("steps", "share"), [(0, 0.3), (4, 0.0), (4, 0.3)])
def test_what_was_asked_for_is_done_and_told(mesh: SurfaceMesh, steps: int, share: float) -> None:
    target = round(share * len(mesh.faces))
    result = cleaned(mesh, smooth_steps=steps, target_faces=target)
    before, after = (
        validate_manifold(mesh.vertices, mesh.faces),
        validate_manifold(result.vertices, result.faces),
    )
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
    assert dense() is None
    assert dense(smooth_steps=2) is None
    assert dense(target_faces=10**6) is None
    # Smoothing comes first: the light mesh is to look like the smooth one.
    smooth = dense(target_faces=500, smooth_steps=2)
    assert smooth is not None
    assert (smooth.vertices == cleaned(mesh, smooth_steps=2).vertices).all()


def test_more_faces_than_there_are_is_said(mesh: SurfaceMesh) -> None:
    result = cleaned(mesh, target_faces=10**6)
    np.testing.assert_array_equal(result.faces, mesh.faces)
    assert any("1000000 requested" in note["text"] for note in result.provenance["notes"])


def test_a_target_out_of_reach_is_said(mesh: SurfaceMesh) -> None:
    result = cleaned(mesh, target_faces=4)
    assert validate_manifold(result.vertices, result.faces).good
    assert len(result.faces) > 4
    assert any("4 requested" in note["text"] for note in result.provenance["notes"])


def test_colours_follow_their_vertices(mesh: SurfaceMesh) -> None:
    share = (mesh.vertices - mesh.vertices.min(0)) / np.ptp(mesh.vertices, axis=0)
    colored = replace(mesh, colors=np.round(255 * share).astype(np.uint8))
    result = cleaned(colored, target_faces=len(mesh.faces) // 2)
    expected = 255 * (result.vertices - mesh.vertices.min(0)) / np.ptp(mesh.vertices, axis=0)
    assert result.colors is not None
    assert np.median(np.abs(result.colors - expected)) < 3

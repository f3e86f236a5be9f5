# SPDX-License-Identifier: GPL-3.0-or-later
"""A mesh by pivots is estimated before it is made, and raises if memory is not sufficient."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.field.samples import DepthSamples
from gaussian_wrapping_addon.core.jobs.stages import meshing
from gaussian_wrapping_addon.core.meshing import pivot_meshing
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.meshing.meshing_scenes import (
    ShapeField,
    cube,
    gaussians_on,
    sphere,
)


def mesh_here(folder: Path):
    points = np.random.default_rng(0).normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    return meshing.mesh_by_pivots_in_stage(
        folder, ShapeField(sphere(), 0.05), gaussians_on(sphere(), cube(1.5), 800, 0.05),
        cube(1.5), MeshingSettings(method="pivots"), Progress(), seed=0, threads=1,
        depth_samples=DepthSamples(points, -points, np.full(500, 0.02)),
    )  # fmt: skip


def test_the_estimate_goes_with_the_mesh(tmp_path: Path) -> None:
    mesh, expected = mesh_here(tmp_path)
    assert expected["tetrahedra_low"] < mesh.provenance["tetrahedra"] < expected["tetrahedra_high"]
    assert expected["points_low"] < len(mesh.vertices) < expected["points_high"]
    assert expected["free_memory_bytes"] > 0
    assert expected["tiled"] is False


def test_too_little_memory_is_refused_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(meshing, "free_bytes", lambda *_: 1 << 20)
    monkeypatch.setattr(pivot_meshing, "mesh_by_pivots", lambda *_, **__: pytest.fail("began"))
    with pytest.raises(ResourceError, match="by pivots needs at least"):
        mesh_here(tmp_path)

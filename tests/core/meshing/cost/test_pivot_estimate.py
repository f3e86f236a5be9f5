# SPDX-License-Identifier: GPL-3.0-or-later
"""Pivot mesh estimates: ranges contain the measured values; too little memory is refused."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError, ResourceError
from gaussian_wrapping_addon.core.meshing.estimate import estimate_pivot_mesh
from gaussian_wrapping_addon.core.meshing.pivot_meshing import mesh_by_pivots
from gaussian_wrapping_addon.core.meshing.pivots import PIVOTS
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.meshing.meshing_scenes import (
    ShapeField,
    cube,
    gaussians_on,
    some_cameras,
    sphere,
    torus,
)
from tests.proofs import first_then_proofs

SIGMA = 0.05
HALF = Region.box("half", np.array([-0.1, -2, -2]), np.array([2, 2, 2]))


@pytest.mark.parametrize("pivots", PIVOTS)
@pytest.mark.parametrize("region", [cube(1.5), HALF], ids=["whole", "half"])
@pytest.mark.parametrize("shape", first_then_proofs([sphere, torus]))
@pytest.mark.parametrize("samples", first_then_proofs(["depth", "none"]))
def test_ranges_hold_the_mesh(shape, region: Region, pivots: int, samples: str) -> None:
    arrays = gaussians_on(shape(), cube(1.5), 4000, SIGMA)
    expected = estimate_pivot_mesh(arrays, region, pivots, 0, alone=samples == "none")
    settings = MeshingSettings(method="pivots", pivots=pivots, pivot_samples=samples)
    mesh = mesh_by_pivots(
        ShapeField(shape(), SIGMA), arrays, some_cameras(), region, settings, Progress(), seed=0
    )
    figures = mesh.provenance
    assert expected.gaussians == figures["gaussians_in_region"]
    assert expected.pivots_low == expected.pivots_high == figures["pivots"]
    assert expected.tetrahedra_low < figures["tetrahedra"] < expected.tetrahedra_high
    assert expected.points_low < len(mesh.vertices) < expected.points_high


def test_more_pivots_and_sightings_cost_more() -> None:
    arrays = gaussians_on(sphere(), cube(1.5), 4000, SIGMA)
    two, nine = (estimate_pivot_mesh(arrays, cube(1.5), k, 0, evaluation_s=1e-5) for k in (2, 9))
    assert nine.tetrahedra_high > 2 * two.tetrahedra_high
    assert nine.memory_low_bytes > two.memory_low_bytes
    assert nine.seconds_high > two.seconds_high
    seen = estimate_pivot_mesh(arrays, cube(1.5), 2, 10_000)
    assert seen.pivots_low == two.pivots_low + 10_000
    assert seen.pivots_high == two.pivots_high + 40_000
    alone = estimate_pivot_mesh(arrays, cube(1.5), 2, 10_000, alone=True)
    assert alone.pivots_low == alone.pivots_high < two.pivots_low, "no samples and no probes"
    many = estimate_pivot_mesh(arrays, cube(1.5), 2, 10**7)
    assert many.pivots_high <= two.pivots_high + 240_000, "as many as a job looks for"
    assert two.lines()[0].startswith("tetrahedra: ")


def test_too_little_memory_is_refused_with_what_would_fit() -> None:
    expected = estimate_pivot_mesh(
        gaussians_on(sphere(), cube(1.5), 4000, SIGMA), cube(1.5), 9, 9000
    )
    expected.refuse(0)  # unknown memory refuses nothing
    expected.refuse(expected.memory_low_bytes)
    with pytest.raises(ResourceError, match="Gaussians by pivots needs at least") as refused:
        expected.refuse(expected.memory_low_bytes - 1)
    assert "smaller region" in refused.value.hint


def test_a_region_without_gaussians_is_an_error() -> None:
    arrays = gaussians_on(sphere(), cube(1.5), 300, SIGMA)
    far = Region.box("far", np.full(3, 50.0), np.full(3, 51.0))
    with pytest.raises(MeshingError, match="'far'"):
        estimate_pivot_mesh(arrays, far, 2, 0)

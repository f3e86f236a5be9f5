# SPDX-License-Identifier: GPL-3.0-or-later
"""Primal adaptive meshing of real Gaussians, against the field by brute force."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from benchmarks.vacancy_scale import brute_force_vacancy
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.field.vector_field import VectorField
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.surface_points import Field
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from tests.core.field.field_scenes import cameras_around, shell_arrays, unit_sphere
from tests.core.meshing.meshing_scenes import assert_closed_manifold, cube, settings

SIGMA_N = 0.005
ALPHA = 0.9
CAMERAS = 24


def mesh_shell(region: Region, points: int, scale: float = 1.0) -> SurfaceMesh:
    arrays = shell_arrays(ALPHA, sigma_n=SIGMA_N, scale=scale)
    cameras = cameras_around(CAMERAS, 4.0 * scale)
    vacancy = VacancyField(arrays, cameras, threads=2, near_z=0.2 * scale)
    vectors = VectorField(arrays, threads=2)
    return mesh_region(
        Field(vacancy, vectors, 2), arrays, cameras, region, settings(points), Progress(), seed=0
    )


@functools.lru_cache(maxsize=1)
def whole_shell() -> SurfaceMesh:
    return mesh_shell(cube(1.3), 2000)


@functools.lru_cache(maxsize=1)
def true_radii() -> np.ndarray:
    """Radius of the isosurface along 16 rays from the origin: bisection of the brute force."""
    directions = unit_sphere(16)
    arrays = shell_arrays(ALPHA, sigma_n=SIGMA_N)
    low, high = np.full(16, 1.0), np.full(16, 1.02)
    for _ in range(8):
        middle = (low + high) / 2
        value, _ = brute_force_vacancy(
            arrays, cameras_around(CAMERAS), middle[:, None] * directions
        )
        low, high = np.where(value < 0.5, middle, low), np.where(value < 0.5, high, middle)
    return (low + high) / 2


def test_true_isosurface_lies_two_sigmas_outside_the_centres() -> None:
    radii = true_radii()
    assert radii.mean() == pytest.approx(1 + 2.09 * SIGMA_N, abs=0.1 * SIGMA_N)
    assert np.ptp(radii) < 0.2 * SIGMA_N


def test_shell_is_closed_of_genus_0_and_lies_on_the_isosurface() -> None:
    mesh = whole_shell()
    figures = assert_closed_manifold(mesh)
    assert (figures.components, figures.genus) == (1, 0)
    assert figures.vertices > 1500
    assert mesh.provenance["removed_solids"] == 0
    vertices = np.linalg.norm(mesh.vertices, axis=1)
    # The surface varies by less than 0.2 sigma from ray to ray, so the mean radius is the truth.
    assert np.abs(vertices - true_radii().mean()).max() < 0.1 * SIGMA_N
    centres = np.linalg.norm(mesh.vertices[mesh.faces].mean(1), axis=1)
    assert np.abs(centres - true_radii().mean()).max() < 0.01
    assert mesh.provenance["level_error_max"] <= 0.01 + 1e-6


def test_shell_a_thousand_times_smaller_gives_the_same_mesh() -> None:
    scale = 1e-3
    small = mesh_shell(cube(1.3 * scale), 2000, scale)
    assert assert_closed_manifold(small).genus == 0
    radii = np.linalg.norm(small.vertices, axis=1) / scale
    assert np.abs(radii - true_radii().mean()).max() < 0.1 * SIGMA_N
    assert len(small.vertices) == pytest.approx(len(whole_shell().vertices), rel=0.01)

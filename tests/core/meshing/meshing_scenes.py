# SPDX-License-Identifier: GPL-3.0-or-later
"""Fields of known shapes, and checks that every closed mesh must pass."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gaussian_wrapping_addon.core.field.vacancy import VacancyResult
from gaussian_wrapping_addon.core.field.vector_field import VectorFieldResult
from gaussian_wrapping_addon.core.gaussians.model import GaussianArrays
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.checks import MeshStatistics, mesh_statistics
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.field.field_scenes import camera_at, make_arrays

Distance = Callable[[np.ndarray], np.ndarray]


class ShapeField:
    """Vacancy and vectors of a shape given by its signed distance (positive = empty).

    Vacancy is a logistic function of the distance, as wide as ``sigma``; the vector field is the
    exact gradient of its logarithm.
    """

    def __init__(self, distance: Distance, sigma: float) -> None:
        self.distance = distance
        self.sigma = sigma
        self.cameras = [camera_at(np.array([0.0, -50.0, 20.0]))]
        self.asked = 0

    def vacancy(self, points: np.ndarray) -> VacancyResult:
        self.asked += len(points)
        depth = np.clip(self.distance(points) / self.sigma, -60, 60)
        value = (1.0 / (1.0 + np.exp(-depth))).astype(np.float32)
        return VacancyResult(value, np.zeros(len(points), np.int32))

    def is_empty(self, points: np.ndarray) -> np.ndarray:
        return self.vacancy(points).vacancy > 0.5

    def evaluate(self, points: np.ndarray) -> VectorFieldResult:
        vacancy = self.vacancy(points).vacancy.astype(np.float64)
        slope = gradient(self.distance, points, self.sigma)
        V = slope * ((1.0 - vacancy) / self.sigma)[:, None]
        outward = slope / np.maximum(np.linalg.norm(slope, axis=1), 1e-12)[:, None]
        count = len(points)
        return VectorFieldResult(V, np.full(count, self.sigma), np.zeros(count, np.int32), outward)


def gradient(distance: Distance, points: np.ndarray, sigma: float) -> np.ndarray:
    """Central differences of a distance, (n, 3)."""
    step = 1e-3 * sigma
    columns = [
        (distance(points + step * axis) - distance(points - step * axis)) / (2 * step)
        for axis in np.eye(3)
    ]
    return np.stack(columns, 1)


def gaussians_on(distance: Distance, region: Region, count: int, sigma: float) -> GaussianArrays:
    """Return small oriented Gaussians spread over the surface of a shape, a little beyond the
    region as well."""
    rng = np.random.default_rng(0)
    low, high = region.bounds
    pad = 0.05 * (high - low)
    points = rng.uniform(low - pad, high + pad, (12 * count, 3))
    for _ in range(10):
        normals = gradient(distance, points, sigma)
        length = np.maximum(np.linalg.norm(normals, axis=1), 1e-6)[:, None]
        points = points - distance(points)[:, None] * normals / length**2
    good = (np.abs(distance(points)) < 0.1 * sigma) & (region.distance(points) < pad.max())
    points = points[good][:count]
    normals = gradient(distance, points, sigma)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return make_arrays(points, sigma, 0.95, normals=0.95 * normals)


def sphere(radius: float = 1.0) -> Distance:
    return lambda p: np.linalg.norm(p, axis=1) - radius


def torus(big: float = 1.0, small: float = 0.35) -> Distance:
    return lambda p: np.hypot(np.hypot(p[:, 0], p[:, 1]) - big, p[:, 2]) - small


def rounded_box(half: tuple[float, float, float], rounding: float) -> Distance:
    def distance(p: np.ndarray) -> np.ndarray:
        q = np.abs(p) - (np.array(half) - rounding)
        outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
        return outside + np.minimum(q.max(1), 0.0) - rounding

    return distance


def cube(half: float, name: str = "cube") -> Region:
    return Region.box(name, np.full(3, -half), np.full(3, half))


def some_cameras() -> list[Camera]:
    return [camera_at(np.array([0.0, -5.0, 1.0]))]


def settings(points: int = 0, share: float = 0.01, spacing: str = "adaptive") -> MeshingSettings:
    return MeshingSettings(points=points, min_component_share=share, spacing=spacing)


def assert_closed_manifold(mesh: SurfaceMesh) -> MeshStatistics:
    """Check closure, manifoldness, orientation and area of a mesh; return its statistics."""
    figures = mesh_statistics(mesh)
    assert figures.closed
    assert figures.boundary_edges == 0
    assert figures.nonmanifold_edges == 0
    assert figures.nonmanifold_vertices == 0
    assert figures.inconsistent_edges == 0
    assert figures.degenerate_faces == 0
    assert figures.unused_vertices == 0
    assert figures.volume > 0
    assert np.isfinite(mesh.vertices).all()
    assert mesh.faces.dtype == np.int32
    return figures

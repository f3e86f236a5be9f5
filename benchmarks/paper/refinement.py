# SPDX-License-Identifier: GPL-3.0-or-later
"""The steps of primal adaptive meshing, each with what it makes and how far from 0.5 that lies."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gaussian_wrapping_addon.core.field.depth_samples import DepthSamples
from gaussian_wrapping_addon.core.field.isosurface_projection import project_to_isosurface
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.field.vector_field import VectorField
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.mesh.surface_sampling import sample_triangles
from gaussian_wrapping_addon.core.meshing.points.candidate_surface import candidate_surface
from gaussian_wrapping_addon.core.meshing.points.resolution import checked_request
from gaussian_wrapping_addon.core.meshing.points.surface_points import SurfaceSampler
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.tetrahedra.boundary_faces import (
    boundary_faces,
    tetrahedron_neighbours,
)
from gaussian_wrapping_addon.core.meshing.tetrahedra.classification import classify, on_one_sheet
from gaussian_wrapping_addon.core.meshing.tetrahedra.delaunay import bounding_points, delaunay
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import MeshingSettings

from .trainings import Trained

ROUNDS = (1, 2, 3, 5, 14)
"""Batches of evaluations after which the samples are looked at; the last is the mesher's limit."""


@dataclasses.dataclass(frozen=True)
class Step:
    """What one step of the mesher gives; scene frame."""

    name: str
    points: np.ndarray
    """(n, 3): vertices or samples."""
    residual: np.ndarray
    """(n,): ``|v - 0.5|`` there."""
    faces: np.ndarray | None = None
    """(f, 3), ``None`` for samples."""

    def figures(self) -> dict[str, float | int | str]:
        """Return number, median and 99 % quantile of the residual."""
        return {
            "step": self.name,
            "points": len(self.points),
            "faces": 0 if self.faces is None else len(self.faces),
            "median": float(np.median(self.residual)),
            "p99": float(np.quantile(self.residual, 0.99)),
            "within": float((self.residual <= 0.01).mean()),
        }


def steps_of(
    trained: Trained,
    field: VacancyField,
    settings: MeshingSettings,
    depth_samples: DepthSamples | None,
    *,
    threads: int,
) -> list[Step]:
    """Carry out the mesher's steps one after another and keep each.

    The samples that are followed through the projection are drawn evenly from the candidate
    surface, as many as the mesh is to have points; the mesher itself projects more and thins them,
    so its own points begin anew at the step "points, thinned". These and the faces between labels
    are of uniform spacing; the final mesh is as the settings say.
    """
    arrays, region = trained.gaussians.arrays(), trained.region
    vectors = VectorField(arrays, threads=threads)
    rng = np.random.default_rng(0)
    request = checked_request(0.0, settings.points, region)
    surface = candidate_surface(
        arrays, region, field.is_empty, 0.5 * request.edge_length, 0, Progress(), depth_samples
    )
    used, faces = np.unique(surface.faces, return_inverse=True)
    steps = [
        _step(field, "candidate surface", surface.vertices[used], faces.reshape(-1, 3)),
    ]
    samples, _ = sample_triangles(surface.vertices, surface.faces, settings.points, rng)
    steps.append(_step(field, "samples of it", samples))
    for rounds in ROUNDS:
        # The first batch is the evaluation of the start.
        moved = project_to_isosurface(samples, field, vectors, max_steps=rounds + 1)
        steps.append(_step(field, after(rounds), moved.points))
    sampler = SurfaceSampler(field, vectors, region, surface, threads)
    cloud = sampler.sample(request, rng, Progress())
    steps.append(_step(field, "points, thinned", cloud.points))
    points = np.concatenate([cloud.points, bounding_points(cloud.points, 0)])
    tetrahedra = delaunay(points, seed=0, progress=Progress())
    neighbours = tetrahedron_neighbours(tetrahedra)
    outer = (tetrahedra >= len(cloud.points)).any(1)
    labels = classify(
        points, tetrahedra, neighbours, outer,
        on_one_sheet(points, tetrahedra, cloud.normals, outer, cloud.radii),
        lambda where: field.vacancy(where).filled, rng, Progress(),
    )  # fmt: skip
    faces = boundary_faces(tetrahedra, neighbours, labels.inside)
    kept, local = np.unique(faces, return_inverse=True)
    steps.append(_step(field, "faces between labels", points[kept], local.reshape(-1, 3)))
    mesh = pam(trained, field, settings, depth_samples, threads=threads)
    steps.append(_step(field, "final mesh", mesh.vertices, mesh.faces))
    return steps


def pam(
    trained: Trained,
    field: VacancyField,
    settings: MeshingSettings,
    depth_samples: DepthSamples | None,
    *,
    threads: int,
) -> SurfaceMesh:
    """Return the mesh of primal adaptive meshing, as the program makes it."""
    arrays = trained.gaussians.arrays()
    return mesh_region(
        field, VectorField(arrays, threads=threads), arrays, trained.scene.cameras, trained.region,
        settings, Progress(), seed=0, threads=threads, depth_samples=depth_samples,
    )  # fmt: skip


def after(rounds: int) -> str:
    """Return the name of the step of so many rounds."""
    return f"after {rounds} round{'s' if rounds > 1 else ''} of projection"


def shown(steps: Sequence[Step], names: Sequence[str]) -> list[Step]:
    """Return the steps of some names, in that order."""
    by_name = {step.name: step for step in steps}
    return [by_name[name] for name in names]


def _step(
    field: VacancyField, name: str, points: np.ndarray, faces: np.ndarray | None = None
) -> Step:
    residual = np.abs(field.vacancy(points).filled - 0.5)
    return Step(name, points, residual, faces)

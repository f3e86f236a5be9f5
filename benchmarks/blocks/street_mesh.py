# SPDX-License-Identifier: GPL-3.0-or-later
"""The mesh of a street: the same region and edges, whatever the Gaussians come from."""

from __future__ import annotations

import numpy as np

from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.scene import Scene
from gaussian_wrapping_addon.core.dataset.view_split import training_views
from gaussian_wrapping_addon.core.field.depth_samples import sample_depth_maps
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.field.vector_field import VectorField
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.meshing.points.candidate_surface import halo_bounds
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.convex_region import Region
from gaussian_wrapping_addon.core.settings import MeshingSettings, TrainingSettings

from .street import HALF_WIDTH_M, PLOT_M, length_m

EDGE_M = 0.35
"""Edges of a uniform mesh: walls are flat, and the smallest things are 0.4 m wide."""
BELOW_M, ABOVE_M = 0.5, 8.0
"""The region reaches from so far below the ground to above the highest roof."""
MESHED_M, CAMERAS_M = 40.0, 10.0
"""How much of the street, in its middle, is meshed, where a border is; with the cameras that stand
no farther outside of it. All cameras look along the street: with all of them a mesh of all of it
takes time in proportion to the square of its length."""


def street_bounds(photos: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the region that is meshed, metres: the street and its houses."""
    beside, length = HALF_WIDTH_M + PLOT_M - 2.0, length_m(photos)
    reach = min(length, MESHED_M) / 2
    return (
        np.array([length / 2 - reach, -beside, -BELOW_M]),
        np.array([length / 2 + reach, beside, ABOVE_M]),
    )


def beside_region(centers: np.ndarray, photos: int) -> np.ndarray:
    """Tell which (n, 3) camera centres are those of the region, world frame, (n,) bool."""
    low, high = street_bounds(photos)
    return np.asarray(
        (centers[:, 0] >= low[0] - CAMERAS_M) & (centers[:, 0] <= high[0] + CAMERAS_M)
    )


def mesh_street(
    scene: Scene,
    gaussians: OrientedGaussians,
    settings: TrainingSettings,
    photos: int,
    seed: int,
    threads: int,
) -> SurfaceMesh:
    """Return the mesh of the street in the scene frame, as a job makes it of a region.

    Raises
    ------
    MeshingError
        There is no surface.
    """
    world = Region.box("street", *street_bounds(photos))
    region = world.transformed(scene.world_from_scene.inverse())
    store = PhotoStore(scene, settings.max_image_px)
    views = training_views(scene, store, settings.holdout_every)
    cameras = [scene.views[view].camera for view in views]
    centers = scene.world_from_scene.points(np.array([camera.center for camera in cameras]))
    cameras = [cameras[row] for row in np.flatnonzero(beside_region(centers, photos))]
    meshing, arrays = MeshingSettings(spacing="uniform"), gaussians.arrays()
    vacancy = VacancyField(
        arrays, cameras, threads=threads, unseen=meshing.unseen, region_bounds=halo_bounds(region)
    )
    samples = sample_depth_maps(
        gaussians, cameras, lambda points: region.contains(points, 0.0), Progress(),
        threads=threads,
    )  # fmt: skip
    return mesh_region(
        vacancy, VectorField(arrays, threads=threads), arrays, cameras, region, meshing,
        Progress(), seed=seed, threads=threads, depth_samples=samples,
        edge_length_scene=EDGE_M / scene.world_from_scene.scale,
    )  # fmt: skip

# SPDX-License-Identifier: GPL-3.0-or-later
"""A finished job's scene, Gaussians and region, as every method gets them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from gaussian_wrapping_addon.core.dataset.scene import Scene
from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene
from gaussian_wrapping_addon.core.gaussians.gaussian_file import load_gaussians
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.regions.automatic_region import automatic_region
from gaussian_wrapping_addon.core.regions.convex_region import Region
from gaussian_wrapping_addon.core.regions.region import read_region

from ..speed_error.score import mesh_scene, stage_folder


@dataclasses.dataclass(frozen=True)
class Trained:
    """What a mesh is made of; scene frame."""

    scene: Scene
    """With the views only whose cameras the job's meshes are made from."""
    gaussians: OrientedGaussians
    region: Region


def open_trained(scene_folder: Path, job: Path) -> Trained:
    """Read a finished job; the region is that of the scene's folder, else the automatic one."""
    scene = load_saved_scene(stage_folder(job, "cameras"))
    gaussians = load_gaussians(stage_folder(job, "train") / "gaussians.npz")
    path = scene_folder / "region.json"
    if path.is_file():
        region = read_region(path).transformed(scene.world_from_scene.inverse())
    else:
        region = automatic_region(scene)
    return Trained(mesh_scene(job, scene), gaussians, region)

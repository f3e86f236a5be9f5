# SPDX-License-Identifier: GPL-3.0-or-later
"""One comparison of blocks with one training: its settings, and each of its steps by itself."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.scene import Scene
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.gaussians.gaussian_file import load_gaussians, save_gaussians
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.mesh.mesh_file import save_mesh
from gaussian_wrapping_addon.core.processes.peak_memory import own_peak_bytes
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TrainingSettings, preset
from gaussian_wrapping_addon.core.training.blocks.block_plan import BlockPlan
from gaussian_wrapping_addon.core.training.blocks.block_settings import BlockSettings
from gaussian_wrapping_addon.core.training.blocks.coarse_training import (
    confirmed_depths,
    train_coarse,
)
from gaussian_wrapping_addon.core.training.blocks.join_blocks import join_blocks
from gaussian_wrapping_addon.core.training.blocks.plan_blocks import plan_blocks
from gaussian_wrapping_addon.core.training.blocks.plan_file import load_plan, save_plan
from gaussian_wrapping_addon.core.training.blocks.train_block import train_block
from gaussian_wrapping_addon.core.training.trainer import train

from .street_mesh import mesh_street

WHOLE, COARSE, JOINED, MESH = "whole", "coarse", "joined", "mesh-"
RESULT, FIGURES = "gaussians.npz", "figures.json"
PRESET = "standard"
TURNS = 6.0
"""Iterations for each photo, of the training and of the blocks."""
GAUSSIANS_PER_PHOTO = 200
"""Limit of the whole scene."""
MATCH_PX = 320
"""Long side at which photos are matched for the dense start: of both, as the coarse training is of
photos half the size and would match no larger ones."""


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Photos, settings, and the folder of the results."""

    folder: Path
    source: Path
    photos: int
    blocks: BlockSettings
    settings: TrainingSettings
    seed: int = 0

    @classmethod
    def of_street(
        cls,
        folder: Path,
        source: Path,
        photos: int,
        blocks: BlockSettings,
        *,
        turns: float = TURNS,
        **further: Any,
    ) -> Comparison:
        """Return the comparison of a street: iterations and Gaussians in proportion to photos.

        ``further`` are settings of the training instead of those of every comparison.
        """
        settings = dataclasses.replace(
            preset(PRESET).training,
            iterations=max(1, round(turns * photos)),
            max_gaussians=GAUSSIANS_PER_PHOTO * photos,
            match_px=MATCH_PX,
            refine_poses="off",  # cameras are exact
            preview_every_s=0.0,
        )
        settings = dataclasses.replace(settings, **further)
        return cls(folder, source, photos, blocks, settings)

    @property
    def block_names(self) -> list[str]:
        """Names of the steps that may run side by side."""
        return [f"block-{number}" for number in range(self.blocks.blocks)]

    def scene(self, name: str, threads: int) -> Scene:
        """Return the scene, read into the folder of a step."""
        folder = self.folder / name
        return load_scene(self.source, folder, Progress(), seed=self.seed, threads=threads)

    def plan(self) -> BlockPlan:
        """Return the plan of the blocks."""
        return load_plan(self.folder / "plan")

    def gaussians(self, name: str) -> OrientedGaussians:
        """Return the result of a step."""
        return load_gaussians(self.folder / name / RESULT)

    def figures_path(self, name: str) -> Path:
        """Return the file that is there once a step is done."""
        return self.folder / name / FIGURES

    def step(self, name: str, threads: int) -> None:
        """Run a step in this process."""
        folder = self.folder / name
        folder.mkdir(parents=True, exist_ok=True)
        begun_s, used_s = time.perf_counter(), time.process_time()
        if name.startswith(MESH):
            found = self._meshed(name, folder, threads)
        else:
            found = self._trained(name, folder, threads)
        found |= {
            "processor_s": round(time.process_time() - used_s, 2),
            "wall_s": round(time.perf_counter() - begun_s, 2),
            "peak_bytes": own_peak_bytes(),
            "threads": threads,
        }
        write_json(folder / FIGURES, found)

    def _meshed(self, name: str, folder: Path, threads: int) -> dict[str, Any]:
        scene = self.scene(name, threads)
        gaussians = self.gaussians(name.removeprefix(MESH))
        mesh = mesh_street(scene, gaussians, self.settings, self.photos, self.seed, threads)
        save_mesh(folder / "mesh.npz", mesh)
        return {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}

    def _trained(self, name: str, folder: Path, threads: int) -> dict[str, Any]:
        progress, scene = Progress(), self.scene(name, threads)
        known: dict[str, Any] = {"seed": self.seed, "threads": threads}
        photos = PhotoStore(scene, self.settings.max_image_px)
        if name == WHOLE:
            result = train(scene, photos, self.settings, folder, progress, **known)
            return _saved(folder, result.gaussians)
        coarse_settings = self.blocks.coarse(self.settings)
        coarse_photos = PhotoStore(scene, coarse_settings.max_image_px)
        if name == COARSE:
            begun_s = time.process_time()
            coarse = train_coarse(scene, coarse_photos, coarse_settings, folder, progress, **known)
            trained_s = time.process_time() - begun_s
            plan = plan_blocks(
                coarse, scene, photos, self.settings, self.blocks, progress, threads=threads
            )
            plans = self.folder / "plan"
            plans.mkdir(exist_ok=True)
            save_plan(plans, plan)
            return {
                **_saved(folder, coarse.gaussians),
                "photos": [len(block.views) for block in plan.blocks],
                "training_s": round(trained_s, 2),
            }
        plan = self.plan()
        index = 0 if name == JOINED else self.block_names.index(name)
        views = plan.views if name == JOINED else plan.blocks[index].views
        known["priors"] = confirmed_depths(
            plan.coarse, self.folder / COARSE, coarse_photos, coarse_settings, plan.views, views
        )
        if name != JOINED:
            result = train_block(
                plan, index, scene, photos, self.settings, folder, progress, **known
            )
            return _saved(folder, result.gaussians)
        parts = (self.gaussians(block) for block in self.block_names)
        result = join_blocks(
            plan, parts, scene, photos, self.settings, self.blocks, folder, progress, **known
        )
        return _saved(folder, result.gaussians)


def _saved(folder: Path, gaussians: OrientedGaussians) -> dict[str, Any]:
    save_gaussians(folder / RESULT, gaussians)
    return {"gaussians": len(gaussians)}

# SPDX-License-Identifier: GPL-3.0-or-later
"""Spheres in a row that cameras walk along: photos at either end show one end only."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.scene import PhotoSource, Scene, View
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training.block_plan import (
    BlockPlan,
    CoarseTraining,
    plan_blocks,
)
from gaussian_wrapping_addon.core.training.blocks import block_training, joint_training
from gaussian_wrapping_addon.core.training.model_selection import Decision, ModelSelection
from gaussian_wrapping_addon.core.training.state import TrainingResult
from gaussian_wrapping_addon.core.training.trainer import train
from tests.core.render.scenes import look_at
from tests.core.training.small_scene import PhotosInMemory, sphere_gaussians, surface_color

MIDDLES = (-4.0, -2.0, 0.0, 2.0, 4.0)
"""Of the spheres along x, scene units; their radius is 1."""

POINTS = 2000
"""Sparse points: Gaussians are small compared with the spheres from the start."""

SETTINGS = TrainingSettings(
    iterations=60, max_gaussians=900, max_image_px=48, sh_degree=1, densify_every=10,
    wrap_rounds=1, checkpoint_every_s=1e9, preview_every_s=0.0, dense_start="off",
    refine_poses="off", growth="on", full_size="on",
)  # fmt: skip


def row_gaussians(count: int = 100) -> OrientedGaussians:
    """Return flat Gaussians on the spheres, in their order."""
    one = sphere_gaussians(count)
    moved = [one.replaced(means=one.means + torch.tensor([x, 0.0, 0.0])) for x in MIDDLES]
    whole = moved[0]
    for other in moved[1:]:
        whole = whole.joined(other)
    return whole


@functools.lru_cache(maxsize=2)
def row_scene(views: int = 24, size_px: int = 48) -> tuple[Scene, PhotosInMemory]:
    """Return the scene with sparse points on the spheres, and its photos, from both sides."""
    truth, cameras = row_gaussians(), []
    for number, x in enumerate(np.linspace(-4.5, 4.5, views)):
        side = 4.0 if number % 2 else -4.0
        cameras.append(
            look_at(
                (x, side, 1.0 if number % 4 < 2 else -0.6),
                (x, 0.0, 0.0),
                width=size_px,
                height=size_px,
                focal=1.2 * size_px,
                name=f"{number:03d}.png",
            )
        )
    with torch.no_grad():
        images = [render(truth, c, RenderOptions(depth=False)).color.numpy() for c in cameras]
    photos = [np.round(255 * np.clip(image, 0, 1)).astype(np.uint8) for image in images]
    random = np.random.default_rng(0)
    directions = random.normal(size=(POINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    colors = np.round(255 * surface_color(directions)).astype(np.uint8)
    middles = np.array(MIDDLES)[np.arange(POINTS) % len(MIDDLES)]
    points = directions + np.stack([middles, 0 * middles, 0 * middles], 1)
    points += 0.02 * random.normal(size=points.shape)
    scene = Scene(
        tuple(View(c, Path(c.name)) for c in cameras), points, colors, Similarity(),
    )  # fmt: skip
    return scene, PhotosInMemory(scene, photos)


def known_coarse() -> CoarseTraining:
    """Return a coarse training that has found the spheres, a little off."""
    truth = row_gaussians()
    noise = torch.from_numpy(np.random.default_rng(1).normal(size=tuple(truth.sh.shape))).float()
    decided = ModelSelection((Decision.by_settings("multi_view", "on"),))
    return CoarseTraining(truth.replaced(sh=truth.sh + 0.2 * noise), decided, None, None, "key")


@functools.lru_cache(maxsize=2)
def two_blocks(blocks: int = 2) -> BlockPlan:
    """Return a plan of the row, divided along x."""
    scene, photos = row_scene()
    return plan_blocks(known_coarse(), scene, photos, divided(blocks), Progress(), threads=1)


def divided(blocks: int = 2, **changes: Any) -> TrainingSettings:
    """Return the settings of a training in so many blocks."""
    return dataclasses.replace(SETTINGS, blocks=blocks, **changes)


def train_block(
    plan: BlockPlan, index: int, scene: Scene, photos: PhotoSource, settings: TrainingSettings,
    folder: Path, progress: Progress, **more: Any,
) -> TrainingResult:  # fmt: skip
    """Train a block as a job does, without confirmed depths."""
    shorter, handover = block_training(plan, index, settings)
    return train(scene, photos, shorter, folder, progress, start=handover, **more)


def join_blocks(
    plan: BlockPlan, parts: list[OrientedGaussians], scene: Scene, photos: PhotoSource,
    settings: TrainingSettings, folder: Path, progress: Progress, **more: Any,
) -> TrainingResult:  # fmt: skip
    """Join blocks as a job does, without confirmed depths."""
    last, handover = joint_training(
        plan, parts, photos, settings, progress.span(0.0, 0.05), ViewRenderer(), threads=1
    )
    return train(scene, photos, last, folder, progress.span(0.05, 1.0), start=handover, **more)

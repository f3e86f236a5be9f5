# SPDX-License-Identifier: GPL-3.0-or-later
"""Train one block: its Gaussians move, those around it stand still (docs/method.md, section 16)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from ...dataset.photo_source import PhotoSource
from ...dataset.scene import Scene
from ...progress import Progress
from ...settings import TrainingSettings
from ...stereo.depth_priors import DepthPrior
from ..devices.backend import Backend
from ..result import TrainingResult
from ..rounds import Inside
from ..schedule import REFERENCE_ITERATIONS
from ..trainer import train
from .block_plan import BlockPlan


def train_block(
    plan: BlockPlan,
    index: int,
    scene: Scene,
    photos: PhotoSource,
    settings: TrainingSettings,
    folder: Path,
    progress: Progress,
    *,
    seed: int = 0,
    threads: int = 0,
    priors: Mapping[int, DepthPrior] | None = None,
    inside: Inside | None = None,
    backend: Backend | None = None,
) -> TrainingResult:
    """Train a block; an interrupted one goes on from its checkpoint, bit for bit.

    Parameters
    ----------
    plan : BlockPlan
    index : int
        Of the block.
    scene, photos
        As they were given to :func:`~.plan_blocks.plan_blocks`.
    settings : TrainingSettings
        Of the whole training.
    folder : Path
        Of this block alone: receives its checkpoints and pictures.
    progress, seed, threads, inside, backend
        As for :func:`~..trainer.train`.
    priors : mapping of int to DepthPrior, optional
        Confirmed depths of at least the block's views
        (:func:`~.coarse_training.confirmed_depths`).

    Returns
    -------
    TrainingResult
        With the Gaussians of the block, those in its margin included, and none that stood still.

    Raises
    ------
    IndexError
        The plan has no such block.
    Cancelled, UsageError, ParseError, WrapError
        As by :func:`~..trainer.train`.
    """
    if not 0 <= index < len(plan.blocks):
        raise IndexError(f"block {index} of {len(plan.blocks)}")
    block, known = plan.blocks[index], priors or {}
    shorter = block_settings(plan, index, settings)
    rows = torch.from_numpy(np.concatenate([block.still, block.trained]).astype(np.int64))
    handover = plan.handover(
        f"block {index}",
        gaussians=plan.coarse.gaussians.select(rows),
        frozen=len(block.still),
        iteration=min(round(plan.begin * shorter.iterations), shorter.iterations - 1),
        priors={view: known[view] for view in block.views if view in known},
        views=block.views,
    )
    return train(
        scene, photos, shorter, folder, progress,
        seed=seed, threads=threads, inside=inside, backend=backend, handover=handover,
    )  # fmt: skip


def block_settings(plan: BlockPlan, index: int, settings: TrainingSettings) -> TrainingSettings:
    """Return the settings of a block, for settings of the whole training.

    A photo has as many turns as in the whole, so the fewer photos, the fewer iterations; what
    happens at intervals happens as often, and rates, which grow where runs are short, are those of
    the whole.
    """
    block = plan.blocks[index]
    share = len(block.views) / len(plan.views)
    iterations = max(1, round(share * settings.iterations))
    shorter = REFERENCE_ITERATIONS / iterations
    power = settings.short_run_power
    if shorter > 1.0:
        whole = max(1.0, REFERENCE_ITERATIONS / settings.iterations)
        power *= math.log(whole) / math.log(shorter)
    return dataclasses.replace(
        decided(plan, settings),
        iterations=iterations,
        extra_iterations=0,
        max_gaussians=block.max_gaussians,
        densify_every=max(1, round(share * settings.densify_every)),
        short_run_power=power,
    )


def decided(plan: BlockPlan, settings: TrainingSettings) -> TrainingSettings:
    """Return settings that leave the model as the coarse training decided it."""
    wrapping = plan.coarse.model_selection.get("wrapping")
    return dataclasses.replace(
        settings,
        # No degree is tried beyond the highest one.
        sh_degree=plan.coarse.gaussians.sh_degree,
        harmonics="auto",
        full_size="on" if plan.full_size else "off",
        wrapping=settings.wrapping if wrapping is None else wrapping.chosen,
        refine_poses="off",
    )

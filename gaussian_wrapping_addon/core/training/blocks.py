# SPDX-License-Identifier: GPL-3.0-or-later
"""A training in blocks: one block around context that stands still, joining."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import math
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import torch

from ..errors import UsageError
from ..gaussians.model import OrientedGaussians
from ..parallel import default_threads
from ..progress import Progress
from ..render.types import Renderer
from ..render.view_renderer import ViewRenderer
from ..scene.scene import PhotoSource, Scene, held_out_views
from ..settings import TrainingSettings
from ..stereo.depth_maps import DepthPrior
from .backend import Backend
from .block_plan import BlockPlan, BlockSettings, Visibility
from .exposure import corrected_for_measuring
from .live_view import held_out_metrics
from .rounds import Inside
from .schedule import REFERENCE_ITERATIONS
from .state import CancellablePhotos, TrainingResult
from .trainer import train, with_backdrop

# -- Train one block: its Gaussians move, those around it stand still (docs/method.md, section 16)


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
        As they were given to :func:`~.block_plan.plan_blocks`.
    settings : TrainingSettings
        Of the whole training.
    folder : Path
        Of this block alone: receives its checkpoints and pictures.
    progress, seed, threads, inside, backend
        As for :func:`~.trainer.train`.
    priors : mapping of int to DepthPrior, optional
        Confirmed depths of at least the block's views
        (:func:`~.block_plan.confirmed_depths`).

    Returns
    -------
    TrainingResult
        With the Gaussians of the block, those in its margin included, and none that stood still.

    Raises
    ------
    IndexError
        The plan has no such block.
    Cancelled, UsageError, ParseError, WrapError
        As by :func:`~.trainer.train`.
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
    return dataclasses.replace(
        settings,
        sh_degree=plan.coarse.gaussians.sh_degree,
        harmonics="off",  # the degree does not rise again
        full_size="on" if plan.full_size else "off",
        refine_poses="off",
    )


# -- Join trained blocks along the borders of their cells, and train them together for a while ----


_logger = logging.getLogger(__name__)

POLISH_RATE = 0.3
"""Factor on the last learning rates: Adam begins anew here, and its first steps are as large as the
rates, whichever way the gradients point."""


def join_blocks(
    plan: BlockPlan,
    parts: Iterable[OrientedGaussians],
    scene: Scene,
    photos: PhotoSource,
    settings: TrainingSettings,
    blocks: BlockSettings,
    folder: Path,
    progress: Progress,
    *,
    seed: int = 0,
    threads: int = 0,
    priors: Mapping[int, DepthPrior] | None = None,
    backend: Backend | None = None,
) -> TrainingResult:
    """Join the Gaussians of all blocks, train them together, and measure the held-out photos.

    The last iterations are those of a training that is continued: on all photos, at the last
    rates, with no Gaussian added or removed. An interrupted one goes on from its checkpoint.

    Parameters
    ----------
    plan : BlockPlan
    parts : iterable of OrientedGaussians
        Of :func:`~.blocks.train_block`, in the order of the blocks; one at a time is held.
    scene, photos, settings
        As they were given to :func:`~.block_plan.plan_blocks`.
    blocks : BlockSettings
        How long they are trained together.
    folder : Path
        Receives checkpoints and pictures.
    progress, seed, threads, backend
        As for :func:`~.trainer.train`.
    priors : mapping of int to DepthPrior, optional
        Confirmed depths (:func:`~.block_plan.confirmed_depths`).

    Raises
    ------
    UsageError
        There is not one part for each block, or one is of another plan.
    Cancelled, ParseError, WrapError
        As by :func:`~.trainer.train`.
    """
    joined = joined_blocks(plan, parts)
    renderer = ViewRenderer() if backend is None else backend.renderer
    joined = within_limit(
        plan, joined, photos, settings.max_gaussians, progress.span(0.0, 0.05), renderer, threads
    )
    last = dataclasses.replace(
        decided(plan, settings),
        extra_iterations=round(blocks.polish_iterations * settings.iterations)
        + settings.extra_iterations,
    )
    if not last.extra_iterations:
        return _measured(
            plan,
            joined,
            scene,
            photos,
            last,
            progress.span(0.05, 1.0),
            renderer,
            threads,
            "cpu" if backend is None else backend.name,
        )
    handover = plan.handover(
        f"joined {_hash(joined)}", gaussians=joined, iteration=settings.iterations,
        rate_factor=POLISH_RATE, priors=priors or {},
    )  # fmt: skip
    return train(
        scene, photos, last, folder, progress.span(0.05, 1.0),
        seed=seed, threads=threads, backend=backend, handover=handover,
    )  # fmt: skip


def _measured(
    plan: BlockPlan,
    joined: OrientedGaussians,
    scene: Scene,
    photos: PhotoSource,
    settings: TrainingSettings,
    progress: Progress,
    renderer: Renderer,
    threads: int,
    device: str,
) -> TrainingResult:
    """Return joined Gaussians as the result of no iterations, without an optimizer's memory."""
    begun_s = time.monotonic()
    seen = CancellablePhotos(photos, progress)
    coarse, threads = plan.coarse, threads or default_threads()
    background = scene.mask_mode(settings.mask_mode) == "background"
    if coarse.model_selection.chose("dense_start") and not background:
        joined = with_backdrop(
            joined, seen, plan.views, renderer, threads=threads, check=progress.check
        )
    names = {
        view: scene.views[view].camera.name
        for view in held_out_views(scene, settings.holdout_every)
    }
    held_out, lpips_note = held_out_metrics(
        joined, seen, names, progress, threads=threads, renderer=renderer,
        exposure_correction=None if coarse.exposure is None else corrected_for_measuring,
    )  # fmt: skip
    return TrainingResult(
        joined, settings.iterations, (), tuple(held_out), time.monotonic() - begun_s, (),
        lpips_note, coarse.model_selection, coarse.exposure is not None, device=device,
    )  # fmt: skip


def joined_blocks(plan: BlockPlan, parts: Iterable[OrientedGaussians]) -> OrientedGaussians:
    """Return the Gaussians of all blocks, each cropped to its cell, in the order of the blocks.

    What no block trained is as the coarse training left it. A Gaussian has one owner, the cell that
    holds its mean.

    Raises
    ------
    UsageError
        There is not one part for each block, or one has another degree of harmonics.
    """
    coarse, pieces, count = plan.coarse.gaussians, [], 0
    for count, part in enumerate(parts, 1):
        if count > len(plan.blocks):
            break
        if part.sh_degree != coarse.sh_degree:
            raise UsageError(
                f"Block {count - 1} has harmonics of degree {part.sh_degree}, not "
                f"{coarse.sh_degree}.", "Train the block again, with this plan.",
            )  # fmt: skip
        own = plan.tiling.owner(part.means.double().numpy()) == count - 1
        pieces.append(part.detached().select(torch.from_numpy(own)))
        pieces.append(coarse.select(torch.from_numpy(plan.kept(count - 1))))
    if count != len(plan.blocks):
        raise UsageError(
            f"There are {count} trained blocks, or more, of {len(plan.blocks)}.",
            "Join the parts of one plan, in order.",
        )
    tensors = {
        name: torch.cat([getattr(piece, name) for piece in pieces])
        for name, _ in coarse.tensors()
    }  # fmt: skip
    return OrientedGaussians(**tensors)


def within_limit(
    plan: BlockPlan,
    gaussians: OrientedGaussians,
    photos: PhotoSource,
    most: int,
    progress: Progress,
    renderer: Renderer,
    threads: int,
) -> OrientedGaussians:
    """Return at most so many Gaussians: those that fill most of the training photos."""
    if len(gaussians) <= most:
        return gaussians
    seen = Visibility(gaussians, photos, plan.views, renderer, threads)
    total = np.zeros(len(gaussians))
    for weights in seen.weights(progress, "joining blocks"):
        total += weights
    order = np.argsort(-total, kind="stable")
    _logger.info("joined blocks: %d Gaussians over the limit", len(gaussians) - most)
    return gaussians.select(torch.from_numpy(np.sort(order[:most])))


def _hash(gaussians: OrientedGaussians) -> str:
    digest = hashlib.sha256()
    for _, tensor in gaussians.tensors():
        digest.update(tensor.detach().contiguous().numpy().tobytes())
    return digest.hexdigest()

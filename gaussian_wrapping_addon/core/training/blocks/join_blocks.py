# SPDX-License-Identifier: GPL-3.0-or-later
"""Join trained blocks along the borders of their cells, and train them together for a while."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import torch

from ...dataset.photo_source import PhotoSource
from ...dataset.scene import Scene
from ...dataset.view_split import held_out_views
from ...errors import UsageError
from ...gaussians.model import OrientedGaussians
from ...kernels.parallel import default_threads
from ...progress import Progress
from ...render.types.renderer import Renderer
from ...render.view_renderer import ViewRenderer
from ...settings import TrainingSettings
from ...stereo.depth_priors import DepthPrior
from ..appearance.photo_exposure import corrected_for_measuring
from ..backdrop import with_backdrop
from ..cancellation import CancellablePhotos
from ..devices.backend import Backend
from ..live_view import held_out_metrics
from ..result import TrainingResult
from ..trainer import train
from .block_plan import BlockPlan
from .block_settings import BlockSettings
from .photo_choice import Visibility
from .train_block import decided

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
        Of :func:`~.train_block.train_block`, in the order of the blocks; one at a time is held.
    scene, photos, settings
        As they were given to :func:`~.plan_blocks.plan_blocks`.
    blocks : BlockSettings
        How long they are trained together.
    folder : Path
        Receives checkpoints and pictures.
    progress, seed, threads, backend
        As for :func:`~..trainer.train`.
    priors : mapping of int to DepthPrior, optional
        Confirmed depths (:func:`~.coarse_training.confirmed_depths`).

    Raises
    ------
    UsageError
        There is not one part for each block, or one is of another plan.
    Cancelled, ParseError, WrapError
        As by :func:`~..trainer.train`.
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

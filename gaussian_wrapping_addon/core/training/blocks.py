# SPDX-License-Identifier: GPL-3.0-or-later
"""A training in blocks: one block around context that stands still, joining."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import math
from collections.abc import Iterable, Mapping

import numpy as np
import torch

from ..errors import UsageError
from ..gaussians.model import OrientedGaussians
from ..progress import Progress
from ..render.types import Renderer
from ..scene.scene import PhotoSource
from ..settings import TrainingSettings
from ..stereo.depth_maps import DepthPrior
from .block_plan import POLISH_ITERATIONS, BlockPlan, Visibility
from .schedule import REFERENCE_ITERATIONS
from .start import Handover

# -- Train one block: its Gaussians move, those around it stand still (docs/method.md, section 16)


def block_training(
    plan: BlockPlan,
    index: int,
    settings: TrainingSettings,
    priors: Mapping[int, DepthPrior] | None = None,
) -> tuple[TrainingSettings, Handover]:
    """Return the settings of a block and what it takes over, for :func:`~.trainer.train`.

    The training's result has the Gaussians of the block, those in its margin included, and none
    that stood still. ``settings`` are the whole training's; ``priors`` holds the confirmed depths
    of at least the block's views (:func:`~.block_plan.confirmed_depths`).
    """
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
    return shorter, handover


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
        _decided(plan, settings),
        iterations=iterations,
        extra_iterations=0,
        max_gaussians=block.max_gaussians,
        densify_every=max(1, round(share * settings.densify_every)),
        short_run_power=power,
    )


def _decided(plan: BlockPlan, settings: TrainingSettings) -> TrainingSettings:
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


def joint_training(
    plan: BlockPlan, parts: Iterable[OrientedGaussians], photos: PhotoSource,
    settings: TrainingSettings, progress: Progress, renderer: Renderer, *, threads: int = 0,
    priors: Mapping[int, DepthPrior] | None = None,
) -> tuple[TrainingSettings, Handover]:  # fmt: skip
    """Join the Gaussians of all blocks; return settings and handover to train them together.

    The last iterations are those of a training that is continued: on all photos, at the last rates,
    with no Gaussian added or removed.

    Parameters
    ----------
    parts : iterable of OrientedGaussians
        Results of :func:`block_training`, in the order of the blocks; one at a time is held.
    photos, settings
        As for :func:`~.block_plan.plan_blocks`; the renderer overwrites its last view.

    Raises
    ------
    UsageError
        There is not one part for each block, or one is of another plan.
    Cancelled
    """
    joined = joined_blocks(plan, parts)
    over = len(joined) - settings.max_gaussians
    if over > 0:  # those stay that fill most of the training photos
        seen = Visibility(joined, photos, plan.views, renderer, threads)
        total = np.zeros(len(joined))
        for weights in seen.weights(progress, "joining blocks"):
            total += weights
        order = np.argsort(-total, kind="stable")[: settings.max_gaussians]
        _logger.info("joined blocks: %d Gaussians over the limit", over)
        joined = joined.select(torch.from_numpy(np.sort(order)))
    polish = round(POLISH_ITERATIONS * settings.iterations) + settings.extra_iterations
    handover = plan.handover(
        f"joined {_hash(joined)}", gaussians=joined, iteration=settings.iterations,
        rate_factor=POLISH_RATE, priors=priors or {},
    )  # fmt: skip
    return dataclasses.replace(_decided(plan, settings), extra_iterations=polish), handover


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
    names = [name for name, _ in coarse.tensors()]
    tensors = {name: torch.cat([getattr(piece, name) for piece in pieces]) for name in names}
    return OrientedGaussians(**tensors)


def _hash(gaussians: OrientedGaussians) -> str:
    digest = hashlib.sha256()
    for _, tensor in gaussians.tensors():
        digest.update(tensor.detach().contiguous().numpy().tobytes())
    return digest.hexdigest()

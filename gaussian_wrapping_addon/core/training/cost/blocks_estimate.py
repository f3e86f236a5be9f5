# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimate the cost of a training in blocks: coarse training, one block, joining."""

from __future__ import annotations

import dataclasses
import math

from ...errors import UsageError
from ...report_warning import ReportWarning
from ...settings import TrainingSettings
from ..blocks.block_settings import BlockSettings
from .training_estimate import (
    GAUSSIAN_COPIES,
    MEMORY_SHARE_LEFT,
    Estimate,
    Machine,
    SceneFacts,
    check_resources,
    estimate,
    gaussian_bytes,
)

PHOTOS_OVERLAP = 1.6
"""A block takes about so many times its share of the photos: those of its margin, and those that
look into it from outside."""

JOINED_COPIES = 3
"""Of the values of joined Gaussians that are not trained together: a block's, all, as rendered."""

MOST_ADVISED = 64
"""Blocks that a warning names."""

LEAST_PHOTOS = 20
"""Photos of a block: fewer show too little of it from all sides."""

MARGIN_GAUSSIANS = 1.4
"""Gaussians of a block with its margin, as a multiple of those in its cell: 0.2 of the cell's size
along two axes, on one side each for the four blocks of a square."""


def estimate_training(
    facts: SceneFacts, settings: TrainingSettings, machine: Machine, *, first: int = 0
) -> Estimate:
    """Estimate the cost of a training, in blocks or in one piece.

    Parameters
    ----------
    facts, settings, machine
        As for :func:`~.training_estimate.estimate`.
    first : int
        Iterations already done by a checkpoint of a training in one piece.

    Returns
    -------
    Estimate
        Of blocks the time of all of them together, one after another, and the memory of the largest
        process.

    Raises
    ------
    UsageError
        There are more blocks than photos: told before the coarse training, not after it.
    """
    if settings.blocks == 1:
        return estimate(facts, settings, machine, first=first)
    if settings.blocks > facts.photos:
        raise UsageError(
            f"The training cannot be divided into {settings.blocks} blocks: "
            f"{facts.photos} photos.", "Choose fewer blocks.",
        )  # fmt: skip
    parts = block_estimates(facts, settings, machine)
    count = [1, settings.blocks, 1]
    return Estimate(
        sum(n * part.seconds_low for n, part in zip(count, parts, strict=True)),
        sum(n * part.seconds_high for n, part in zip(count, parts, strict=True)),
        max(part.memory_bytes for part in parts),
        sum(n * part.disk_bytes for n, part in zip(count, parts, strict=True)),
        settings.max_gaussians,
        parts[2].photos,
    )


def block_estimates(
    facts: SceneFacts, settings: TrainingSettings, machine: Machine
) -> tuple[Estimate, Estimate, Estimate]:
    """Return the estimates of the coarse training, of one block, and of joining all."""
    blocks = BlockSettings.of(settings)
    share = min(1.0, PHOTOS_OVERLAP / blocks.blocks)
    photos = dataclasses.replace(
        facts,
        photos=max(1, math.ceil(share * facts.photos)),
        points=math.ceil(facts.points / blocks.blocks),
    )
    of_block = dataclasses.replace(
        settings,
        iterations=max(1, round(share * settings.iterations)),
        extra_iterations=0,
        max_gaussians=gaussians_of_block(settings),
        dense_start="off",
    )
    further = settings.extra_iterations + round(blocks.polish_iterations * settings.iterations)
    joined = estimate(
        facts, dataclasses.replace(settings, extra_iterations=further, dense_start="off"), machine,
        first=settings.iterations,
    )  # fmt: skip
    if not further:  # they are rendered, without moments and snapshots
        values = (GAUSSIAN_COPIES - JOINED_COPIES) * gaussian_bytes(settings)
        less = round(joined.gaussians * values)
        joined = dataclasses.replace(joined, memory_bytes=joined.memory_bytes - less)
    return (
        estimate(facts, blocks.coarse(settings), machine),
        estimate(photos, of_block, machine),
        joined,
    )


def coarse_gaussians(settings: TrainingSettings) -> int:
    """Return the largest number of Gaussians of the coarse training."""
    return BlockSettings.of(settings).coarse(settings).max_gaussians


def gaussians_of_block(settings: TrainingSettings) -> int:
    """Return about the largest number of Gaussians that one block trains."""
    return math.ceil(MARGIN_GAUSSIANS * settings.max_gaussians / settings.blocks)


def memory_warnings(
    facts: SceneFacts, settings: TrainingSettings, machine: Machine, expected: Estimate
) -> list[ReportWarning]:
    """Check disk space and memory; where memory is short, say which number of blocks fits.

    Raises
    ------
    ResourceError
        The disk has less free space than the training will write.
    """
    warnings = check_resources(expected, machine)
    advice = blocks_advice(facts, settings, machine) if warnings else ""
    return [dataclasses.replace(warning, hint=advice) for warning in warnings]


def blocks_advice(facts: SceneFacts, settings: TrainingSettings, machine: Machine) -> str:
    """Return which number of blocks fits into the free memory; empty if none does."""
    if not machine.memory_bytes:
        return ""
    for polish in dict.fromkeys((settings.polish, 0.0)):
        blocks = max(2, 2 * settings.blocks)
        while blocks <= min(MOST_ADVISED, facts.photos // LEAST_PHOTOS):
            divided = dataclasses.replace(settings, blocks=blocks, polish=polish)
            needed = estimate_training(facts, divided, machine).memory_bytes
            if needed <= MEMORY_SHARE_LEFT * machine.memory_bytes:
                options = f"--blocks {blocks}" + ("" if polish else " --polish 0")
                return f"In blocks it needs {needed / 2**30:.1f} GB: {options}."
            blocks *= 2
    return ""

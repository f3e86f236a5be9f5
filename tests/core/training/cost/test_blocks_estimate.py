# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimates of trainings in blocks: what they save."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training.block_plan import BlockSettings
from gaussian_wrapping_addon.core.training.estimate import (
    Machine,
    SceneFacts,
    block_estimates,
    estimate,
    estimate_training,
)

FACTS = SceneFacts(400, 640.0 * 480.0, 640, 20_000)
LARGE = TrainingSettings(iterations=3000, max_gaussians=4_000_000, sh_degree=3)
MACHINE = Machine(2)


def test_one_block_is_a_training_in_one_piece() -> None:
    assert estimate_training(FACTS, LARGE, MACHINE) == estimate(FACTS, LARGE, MACHINE)


def test_each_process_of_four_blocks_needs_less_than_the_whole() -> None:
    whole = estimate(FACTS, LARGE, MACHINE)
    coarse, block, joined = block_estimates(FACTS, replace(LARGE, blocks=4), MACHINE)
    assert coarse.memory_bytes < 0.7 * whole.memory_bytes
    assert block.memory_bytes < 0.5 * whole.memory_bytes
    assert joined.seconds_high < 0.3 * whole.seconds_high
    together = estimate_training(FACTS, replace(LARGE, blocks=4), MACHINE)
    assert together.memory_bytes == joined.memory_bytes
    assert together.seconds_high == pytest.approx(
        coarse.seconds_high + 4 * block.seconds_high + joined.seconds_high
    )


def test_more_blocks_make_smaller_processes() -> None:
    parts = [block_estimates(FACTS, replace(LARGE, blocks=n), MACHINE)[:2] for n in (2, 4, 8, 16)]
    coarse, block = ([part.memory_bytes for part in column] for column in zip(*parts, strict=True))
    assert block == sorted(block, reverse=True)
    assert block[3] < 0.2 * block[0]
    assert coarse == sorted(coarse, reverse=True)
    assert [BlockSettings(n).coarse_share for n in (2, 4, 8, 16)] == [0.5, 0.5, 0.25, 0.125]


def test_more_blocks_than_photos_are_refused_before_anything_is_trained() -> None:
    few = replace(FACTS, photos=7)
    assert estimate_training(few, replace(LARGE, blocks=7), MACHINE).seconds_high > 0.0
    with pytest.raises(UsageError, match="8 blocks: 7 photos"):
        estimate_training(few, replace(LARGE, blocks=8), MACHINE)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimates of trainings in blocks: what they save, and which number a warning advises."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gaussian_wrapping_addon.core.errors import ResourceError, UsageError
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training.block_plan import BlockSettings
from gaussian_wrapping_addon.core.training.estimate import (
    Machine,
    SceneFacts,
    block_estimates,
    blocks_advice,
    estimate,
    estimate_training,
    memory_warnings,
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
    # Joined Gaussians that are trained are all in one process; else they are only rendered.
    lean = block_estimates(FACTS, replace(LARGE, blocks=4, polish=0.0), MACHINE)[2]
    assert lean.memory_bytes < 0.65 * joined.memory_bytes
    assert lean.seconds_high < 0.1 * joined.seconds_high
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


def test_where_memory_is_short_the_number_of_blocks_that_fits_is_told() -> None:
    whole = estimate(FACTS, LARGE, MACHINE)
    lean = estimate_training(FACTS, replace(LARGE, blocks=8, polish=0.0), MACHINE)
    some = Machine(2, memory_bytes=round(1.2 * lean.memory_bytes))
    (warning,) = memory_warnings(FACTS, LARGE, some, whole)
    assert warning.code == "memory-short"
    assert "--blocks" in warning.hint
    assert warning.hint.endswith("--polish 0.")
    plenty = Machine(2, memory_bytes=2 * whole.memory_bytes)
    assert memory_warnings(FACTS, LARGE, plenty, whole) == []
    little = Machine(2, memory_bytes=600 * 2**20)
    assert blocks_advice(FACTS, LARGE, little) == ""
    assert [w.hint for w in memory_warnings(FACTS, LARGE, little, whole)] == [""]
    few = replace(FACTS, photos=30)
    assert blocks_advice(few, LARGE, some) == "", "a block of 15 photos shows too little"


def test_more_blocks_than_photos_are_refused_before_anything_is_trained() -> None:
    few = replace(FACTS, photos=7)
    assert estimate_training(few, replace(LARGE, blocks=7), MACHINE).seconds_high > 0.0
    with pytest.raises(UsageError, match="8 blocks: 7 photos"):
        estimate_training(few, replace(LARGE, blocks=8), MACHINE)


def test_a_full_disk_is_refused() -> None:
    expected = estimate_training(FACTS, replace(LARGE, blocks=4), MACHINE)
    with pytest.raises(ResourceError):
        memory_warnings(FACTS, LARGE, Machine(2, disk_free_bytes=1 << 20), expected)

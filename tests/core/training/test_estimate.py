# SPDX-License-Identifier: GPL-3.0-or-later
"""Time, memory and disk of a training, before it starts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import DeviceError, ResourceError, UsageError
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.stereo.depth_maps import least_divisor
from gaussian_wrapping_addon.core.training.block_plan import coarse_settings
from gaussian_wrapping_addon.core.training.estimate import (
    MATCHING_PIXEL_BYTES,
    MATCHING_PIXEL_S,
    Machine,
    SceneFacts,
    block_estimates,
    check_resources,
    estimate,
    estimate_training,
    gaussian_counts,
    speeds,
    this_machine,
)
from gaussian_wrapping_addon.core.training.schedule import Schedule
from gaussian_wrapping_addon.core.training.start import start_budget

# -- Training estimate: monotonicity, range of measured trainings, check of a full disk -----------

FACTS = SceneFacts(40, 640 * 480, 640, 3000)
PLAIN = TrainingSettings(multi_view="off", growth="on", wrapping="on")
MACHINE = Machine()

STANDARD = TrainingSettings(iterations=3000, max_gaussians=80_000, max_image_px=640)

# Finished trainings (benchmarks/scenes, 40 photos of 640 x 480, settings STANDARD): speed of the
# machine as it was measured before each (the first: two quiet threads), seconds, Gaussians.
MEASURED = ((1.0, 335, 36_600), (0.357, 688, 52_506), (0.447, 561, 38_845))


@pytest.mark.parametrize(("speed", "seconds", "gaussians"), MEASURED)
def test_the_range_holds_measured_trainings(speed: float, seconds: int, gaussians: int) -> None:
    found = estimate(FACTS, STANDARD, Machine(speed))
    assert found.seconds_low < seconds < found.seconds_high
    assert gaussians <= found.gaussians <= STANDARD.max_gaussians


def test_large_photos_cost_what_their_windows_cost() -> None:
    large = replace(STANDARD, max_image_px=2560)
    whole = replace(large, pixels_per_iteration=10**9)
    facts = SceneFacts(40, 2560 * 1920, 2560, 3000)
    assert estimate(facts, large, MACHINE).seconds_high < 2 * (
        estimate(FACTS, STANDARD, MACHINE).seconds_high
    )
    assert estimate(facts, whole, MACHINE).seconds_high > 10 * (
        estimate(facts, large, MACHINE).seconds_high
    )


@pytest.mark.parametrize(
    "larger",
    [
        {"iterations": 2 * PLAIN.iterations},
        {"extra_iterations": 500},
        {"max_gaussians": 2 * PLAIN.max_gaussians},
        {"multi_view": "on"},
        {"multi_view": "auto"},
        {"depth_from": 0.0},
    ],
)
def test_more_of_anything_takes_longer(larger: dict) -> None:
    before = estimate(FACTS, PLAIN, MACHINE)
    after = estimate(FACTS, replace(PLAIN, **larger), MACHINE)
    assert after.seconds_high > before.seconds_high
    assert after.memory_bytes >= before.memory_bytes
    assert after.disk_bytes >= before.disk_bytes


def test_extra_iterations_cost_what_the_last_ones_cost() -> None:
    one, two, three = (
        estimate(FACTS, replace(PLAIN, extra_iterations=n), MACHINE).seconds_high
        for n in (0, 100, 200)
    )
    assert three - two == pytest.approx(two - one)
    assert (two - one) / 100 > one / PLAIN.iterations  # full size, most Gaussians


def test_a_faster_machine_takes_less() -> None:
    fast, slow = (estimate(FACTS, PLAIN, Machine(speed)) for speed in (2.0, 0.5))
    assert slow.seconds_low == pytest.approx(4 * fast.seconds_low)
    assert slow.memory_bytes == fast.memory_bytes


def test_images_count_at_the_size_that_is_trained() -> None:
    small = estimate(FACTS, PLAIN, MACHINE)
    same = replace(FACTS, pixels=16 * FACTS.pixels, long_side_px=4 * FACTS.long_side_px)
    assert estimate(same, PLAIN, MACHINE).seconds_high == pytest.approx(small.seconds_high)


def test_growth_off_keeps_the_start_and_on_reaches_the_cap() -> None:
    kept = replace(PLAIN, growth="off", wrapping="off")
    sparse = gaussian_counts(FACTS, replace(kept, dense_start="off"), 1.0)
    assert (sparse == 5000).all()
    dense = gaussian_counts(FACTS, kept, 1.0)
    assert (dense == start_budget(Schedule(kept, 640).growth_limit())).all()
    on = gaussian_counts(FACTS, replace(PLAIN, extra_iterations=50), 1.0)
    assert len(on) == PLAIN.iterations + 50
    assert (np.diff(on) >= 0).all()
    assert 0.97 * PLAIN.max_gaussians < on[-1] <= PLAIN.max_gaussians
    few = gaussian_counts(replace(FACTS, points=10**6), PLAIN, 1.0)
    assert few[0] == Schedule(PLAIN, 640).growth_limit()


def test_matching_adds_time_and_memory_once() -> None:
    without = estimate(FACTS, replace(PLAIN, dense_start="off", growth="on"), MACHINE)
    fixed = replace(PLAIN, growth="on")
    whole, later = (estimate(FACTS, fixed, MACHINE, first=first) for first in (0, 1))
    pixels = FACTS.photos * FACTS.pixels
    matched = pixels / least_divisor(640, pixels, fixed.match_px) ** 2
    assert whole.memory_bytes - without.memory_bytes == pytest.approx(
        MATCHING_PIXEL_BYTES * matched, rel=0.01
    )
    # The first iteration takes far less than matching all photos.
    assert whole.seconds_low - later.seconds_low > 0.7 * MATCHING_PIXEL_S * matched


def test_a_full_disk_is_refused_and_little_memory_is_told() -> None:
    found = estimate(FACTS, PLAIN, MACHINE)
    plenty = Machine(1.0, 10 * found.memory_bytes, 10 * found.disk_bytes)
    assert check_resources(found, plenty) == []
    assert check_resources(found, MACHINE) == []  # a system that tells nothing
    with pytest.raises(ResourceError, match="free") as caught:
        check_resources(found, replace(plenty, disk_free_bytes=found.disk_bytes - 1))
    assert caught.value.hint
    (warning,) = check_resources(found, replace(plenty, memory_bytes=found.memory_bytes))
    assert warning.code == "memory-short"
    assert "--max-gaussians" in warning.text


def test_photos_take_what_is_theirs_and_the_rest_is_read_on_demand() -> None:
    machine = Machine(1.0, 4 * 2**30)
    few = estimate(FACTS, PLAIN, machine)
    assert few.photos.fits
    assert few.photos.all_bytes == round(FACTS.photos * FACTS.pixels * 3 * (1 + 1 / 4 + 1 / 16))
    assert few.sentence().endswith(f"photos {few.photos.sentence()}")
    large = replace(PLAIN, max_image_px=4000, dense_start="off")
    facts = SceneFacts(400, 4000 * 3000, 4000, 3000)
    many, more = (estimate(replace(facts, photos=count), large, machine) for count in (400, 800))
    assert not many.photos.fits
    assert many.photos.budget_bytes == 2**30
    assert more.photos.all_bytes == 2 * many.photos.all_bytes
    assert more.memory_bytes == many.memory_bytes


def test_this_machine_reads_what_is_free_also_for_folders_to_come(tmp_path: Path) -> None:
    machine = this_machine(tmp_path / "not" / "yet", 1.5)
    assert machine.speed == 1.5
    assert machine.disk_free_bytes > 0
    assert machine.memory_bytes >= 0


def test_what_a_checkpoint_has_done_costs_nothing_more() -> None:
    longer = replace(STANDARD, extra_iterations=500)
    whole, rest = estimate(FACTS, longer, MACHINE), estimate(FACTS, longer, MACHINE, first=3000)
    base = estimate(FACTS, STANDARD, MACHINE)
    assert rest.seconds_low == pytest.approx(whole.seconds_low - base.seconds_low)
    assert 0 < rest.seconds_high < 0.3 * whole.seconds_high


# -- Estimates of trainings in blocks: what they save, and which number a warning advises ---------

MANY = SceneFacts(400, 640.0 * 480.0, 640, 20_000)
LARGE = TrainingSettings(iterations=3000, max_gaussians=4_000_000, sh_degree=3)


def test_one_block_is_a_training_in_one_piece() -> None:
    assert estimate_training(MANY, LARGE, MACHINE) == estimate(MANY, LARGE, MACHINE)


def test_each_process_of_four_blocks_needs_less_than_the_whole() -> None:
    whole = estimate(MANY, LARGE, MACHINE)
    coarse, block, joined = block_estimates(MANY, replace(LARGE, blocks=4), MACHINE)
    assert coarse.memory_bytes < 0.7 * whole.memory_bytes
    assert block.memory_bytes < 0.5 * whole.memory_bytes
    assert joined.seconds_high < 0.3 * whole.seconds_high
    together = estimate_training(MANY, replace(LARGE, blocks=4), MACHINE)
    assert together.memory_bytes == joined.memory_bytes
    assert together.seconds_high == pytest.approx(
        coarse.seconds_high + 4 * block.seconds_high + joined.seconds_high
    )


def test_more_blocks_make_smaller_processes() -> None:
    parts = [block_estimates(MANY, replace(LARGE, blocks=n), MACHINE)[:2] for n in (2, 4, 8, 16)]
    coarse, block = ([part.memory_bytes for part in column] for column in zip(*parts, strict=True))
    assert block == sorted(block, reverse=True)
    assert block[3] < 0.2 * block[0]
    assert coarse == sorted(coarse, reverse=True)
    assert [
        coarse_settings(replace(LARGE, blocks=n)).max_gaussians / LARGE.max_gaussians
        for n in (2, 4, 8, 16)
    ] == [0.5, 0.5, 0.25, 0.125]


def test_more_blocks_than_photos_are_refused_before_anything_is_trained() -> None:
    few = replace(MANY, photos=7)
    assert estimate_training(few, replace(LARGE, blocks=7), MACHINE).seconds_high > 0.0
    with pytest.raises(UsageError, match="8 blocks: 7 photos"):
        estimate_training(few, replace(LARGE, blocks=8), MACHINE)


def test_a_gpu_that_fails_while_it_is_timed_does_not_end_the_estimate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(error: Exception) -> None:
        def timed(device: int) -> float:
            assert device == 1
            raise error

        monkeypatch.setattr("gaussian_wrapping_addon.core.training.estimate.gpu_speed", timed)

    fails(DeviceError("The driver does not answer.", "Restart it."))
    assert speeds(4, "cuda:1") == (4 * speeds(1, "cuda:1")[0], 1.0)
    fails(RuntimeError("a fault of this program"))
    with pytest.raises(RuntimeError, match="a fault of this program"):
        speeds(4, "cuda:1")

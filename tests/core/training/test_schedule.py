# SPDX-License-Identifier: GPL-3.0-or-later
"""Schedule: order of milestones, caps, rates, for every preset and unusual lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gaussian_wrapping_addon.core.limits import SCENE_RADIUS
from gaussian_wrapping_addon.core.settings import PRESETS, TrainingSettings, preset
from gaussian_wrapping_addon.core.training.schedule import (
    FIRST_BUDGET,
    POSITION_RATE,
    PYRAMID,
    REFERENCE_ITERATIONS,
    RESET_EVERY,
    SMALLEST_SIDE_PX,
    Schedule,
)


@pytest.mark.parametrize(
    "settings",
    [
        *(replace(preset(p).training, wrapping="on") for p in PRESETS),
        TrainingSettings(iterations=7, wrap_rounds=0, wrapping="on"),
    ],
    ids=[*PRESETS, "seven"],
)
def test_milestones_come_in_order_and_everything_ends_at_full_quality(
    settings: TrainingSettings,
) -> None:
    plan = Schedule(settings, settings.max_image_px)
    every = range(settings.iterations)
    divisors = [plan.divisor(i) for i in every]
    assert divisors == sorted(divisors, reverse=True)
    assert divisors[-1] == 1
    degrees = [plan.sh_degree(i) for i in every]
    assert degrees == sorted(degrees)
    assert degrees[0] == 0
    assert degrees[-1] == settings.sh_degree
    for flag in (plan.uses_depth, plan.is_oriented):
        values = [flag(i) for i in every]
        assert values == sorted(values)
        assert values[-1]
    assert not any(plan.is_oriented(i) and not plan.uses_depth(i) for i in every)
    assert sum(plan.starts_orientation(i) for i in every) == 1
    assert not any(plan.densifies(i) and plan.is_oriented(i) for i in every)
    assert sum(plan.wraps(i) for i in every) == settings.wrap_rounds
    assert all(plan.is_oriented(i) for i in every if plan.wraps(i))
    assert all(plan.gathers_statistics(i - 1) for i in every if plan.densifies(i))


def test_small_photos_skip_the_coarse_levels() -> None:
    settings = TrainingSettings(iterations=100)
    assert Schedule(settings, 4 * SMALLEST_SIDE_PX).divisor(0) == PYRAMID[0][0] == 4
    assert Schedule(settings, 4 * SMALLEST_SIDE_PX - 1).divisor(0) == 2
    assert Schedule(settings, SMALLEST_SIDE_PX).divisor(0) == 1


def test_growth_leaves_room_for_the_wrapping_rounds() -> None:
    settings = TrainingSettings(max_gaussians=1000, wrap_rounds=5, wrap_share=0.05)
    count = Schedule(settings, 640).growth_limit()
    for _ in range(5):
        count = int(count * 1.05)
    assert 990 <= count <= 1000


def test_position_rate_falls_log_linearly_and_orientation_waits() -> None:
    settings = TrainingSettings(iterations=REFERENCE_ITERATIONS, sh_degree=1, wrapping="on")
    plan = Schedule(settings, 640)
    first, middle, last = (float(plan.rates(i)["means"][0]) for i in (0, 15_000, 30_000))
    assert first == pytest.approx(SCENE_RADIUS * POSITION_RATE[0], rel=1e-6)
    assert last == pytest.approx(SCENE_RADIUS * POSITION_RATE[1], rel=1e-6)
    assert middle == pytest.approx(np.sqrt(first * last), rel=1e-5)
    assert "orientation" not in plan.rates(19_000)
    assert plan.rates(21_000)["orientation"].shape == (4,)
    assert plan.rates(0)["sh"].shape == (12,)
    assert plan.rates(0)["sh"][0] > 5 * plan.rates(0)["sh"][3]
    assert float(plan.rates(0, 0.5)["means"][0]) == pytest.approx(0.5 * first)


def test_opacity_resets_only_where_there_is_time_to_recover() -> None:
    for iterations in (1500, 3000, 7000):
        plan = Schedule(TrainingSettings(iterations=iterations), 640)
        assert not any(plan.resets_opacity(i) for i in range(iterations))
    plan = Schedule(TrainingSettings(iterations=30_000), 640)
    resets = [i for i in range(30_000) if plan.resets_opacity(i)]
    assert resets == [RESET_EVERY * k for k in (1, 2, 3, 4)]


def test_short_runs_take_larger_steps_and_long_ones_the_published() -> None:
    published = Schedule(TrainingSettings(iterations=REFERENCE_ITERATIONS), 640).rates(0)
    short = Schedule(TrainingSettings(iterations=1500), 640)
    factor = short.short_run_factor
    assert factor == pytest.approx(20**0.4)
    rates = short.rates(0)
    for name, power in (("means", 0.5), ("opacity_logits", 0.5), ("log_scales", 1), ("quats", 1)):
        assert rates[name] == pytest.approx(published[name] * factor**power, rel=1e-5), name
    assert rates["sh"][0] == pytest.approx(published["sh"][0] * factor, rel=1e-5)
    assert rates["sh"][3] == pytest.approx(published["sh"][3] * factor**2, rel=1e-5)
    assert Schedule(TrainingSettings(iterations=60_000), 640).short_run_factor == 1.0


def test_the_budget_grows_evenly_to_the_cap_and_never_falls() -> None:
    settings = TrainingSettings(iterations=1000, max_gaussians=50_000, wrap_rounds=2)
    schedule = Schedule(settings, 640)
    limit = schedule.growth_limit()
    assert limit * 1.05**2 <= 50_000 < (limit + 2) * 1.05**2
    budgets = [schedule.budget(i) for i in range(0, 1001, 50)]
    assert budgets[0] == FIRST_BUDGET
    assert budgets == sorted(budgets)
    assert schedule.budget(250) == limit // 2
    assert {schedule.budget(i) for i in (500, 700, 1000)} == {limit}
    few = Schedule(TrainingSettings(iterations=1000, max_gaussians=400, wrap_rounds=0), 640)
    assert few.budget(0) == 400


def test_pruning_and_comparisons_happen_at_their_shares() -> None:
    schedule = Schedule(TrainingSettings(iterations=1000), 640)
    assert [i for i in range(1001) if schedule.prunes(i)] == [200, 300, 400, 500, 600, 700]
    none = Schedule(TrainingSettings(iterations=1000, prune_share=0.0), 640)
    assert not any(none.prunes(i) for i in range(1001))
    held = Schedule(TrainingSettings(iterations=1000, growth="off"), 640)
    assert not any(held.prunes(i) for i in range(1001))
    assert [i for i in range(1001) if schedule.compares_views(i)] == list(range(233, 750))
    third = Schedule(TrainingSettings(iterations=30, multi_view_every=3), 640)
    assert [i for i in range(31) if third.compares_views(i)] == [9, 12, 15, 18, 21]


def test_without_wrapping_nothing_is_oriented() -> None:
    schedule = Schedule(TrainingSettings(iterations=300), 640)
    assert not any(schedule.is_oriented(i) or schedule.starts_orientation(i) for i in range(301))
    with_it = Schedule(TrainingSettings(iterations=300, wrapping="on"), 640)
    assert [i for i in range(301) if with_it.starts_orientation(i)] == [200]
    assert with_it.is_oriented(200)


def test_more_iterations_keep_the_plan_and_its_last_rates() -> None:
    short = Schedule(TrainingSettings(iterations=300), 640)
    longer = Schedule(TrainingSettings(iterations=300, extra_iterations=200), 640)
    assert (short.total, longer.total) == (300, 500)
    for iteration in (0, 69, 150, 299):
        assert longer.divisor(iteration) == short.divisor(iteration)
        for name, rates in short.rates(iteration).items():
            assert np.array_equal(longer.rates(iteration)[name], rates)
    for name, rates in short.rates(300).items():
        assert np.array_equal(longer.rates(480)[name], rates)
    assert not any(longer.densifies(i) or longer.wraps(i) for i in range(301, 501))
    assert longer.divisor(450) == 1


def test_a_coarser_finest_level_is_never_passed() -> None:
    schedule = Schedule(TrainingSettings(iterations=100), 800, finest=2)
    assert [schedule.divisor(i) for i in (0, 20, 99)] == [4, 2, 2]


def test_finished_gaussians_are_refined_at_full_size_with_late_rates() -> None:
    settings = TrainingSettings(iterations=100, sh_degree=2)
    schedule, plain = Schedule(settings, 800, refines=True), Schedule(settings, 800)
    assert {schedule.divisor(i) for i in range(100)} == {1}
    assert schedule.sh_degree(0) == 2
    first = schedule.rates(0)["means"][0]
    assert first == pytest.approx(plain.rates(70)["means"][0], rel=1e-6)
    assert schedule.rates(100)["means"][0] == pytest.approx(plain.rates(100)["means"][0])

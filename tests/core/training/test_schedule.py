# SPDX-License-Identifier: GPL-3.0-or-later
"""The plan of a run: order of milestones, caps, rates, for every preset and odd lengths."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.settings import PRESETS, TrainingSettings, preset
from gaussian_wrapping_addon.core.tolerances import SCENE_RADIUS
from gaussian_wrapping_addon.core.training.schedule import (
    POSITION_RATE,
    PYRAMID,
    REFERENCE_ITERATIONS,
    RESET_EVERY,
    SMALLEST_SIDE_PX,
    Schedule,
)


@pytest.mark.parametrize(
    "settings",
    [*(preset(p).training for p in PRESETS), TrainingSettings(iterations=7, wrap_rounds=0)],
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
    settings = TrainingSettings(iterations=REFERENCE_ITERATIONS, sh_degree=1)
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

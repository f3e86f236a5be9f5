# SPDX-License-Identifier: GPL-3.0-or-later
"""Density control: cloning, splitting, pruning, the cap, the opacity reset."""

from __future__ import annotations

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import TRAINED, OrientedGaussians
from gaussian_wrapping_addon.core.render.types import RenderStatistics
from gaussian_wrapping_addon.core.training.adam import Adam
from gaussian_wrapping_addon.core.training.density import (
    CLONE_SIZE,
    GRADIENT_THRESHOLD,
    MIN_OPACITY,
    RESET_OPACITY,
    SPLIT_FACTOR,
    DensityStatistics,
    densify_and_prune,
    reset_opacity,
)
from tests.core.render.scenes import random_gaussians


def filled(gaussians: OrientedGaussians) -> Adam:
    """Return an optimiser whose moments are all one and whose steps are all five."""
    adam = Adam(gaussians)
    for name in TRAINED:
        for moment in adam.moments(name):
            moment[...] = 1.0
    adam.steps[:] = 5
    return adam


def gaussians_of_sizes(sizes: list[float], opacity: float = 0.5) -> OrientedGaussians:
    count = len(sizes)
    some = random_gaussians(count, dtype=torch.float32, filter_size=0.0)
    log_scales = torch.log(torch.tensor(sizes))[:, None].repeat(1, 3)
    logit = float(np.log(opacity / (1 - opacity)))
    return some.replaced(log_scales=log_scales, opacity_logits=torch.full((count,), logit))


def with_gradients(values: list[float]) -> DensityStatistics:
    statistics = DensityStatistics.zeros(len(values))
    statistics.views[:] = 2
    statistics.gradient[:] = 2 * np.asarray(values) * GRADIENT_THRESHOLD
    return statistics


def test_statistics_average_per_half_image_over_the_views_that_saw() -> None:
    statistics = DensityStatistics.zeros(3)
    for visible in ([True, True, False], [True, False, False]):
        statistics.add(
            RenderStatistics(
                np.array(visible), *(np.zeros(3, np.float32) for _ in range(3)),
                grad_px=np.array([1.0, 2.0, 9.0], np.float32),
                grad_abs_px=np.array([3.0, 4.0, 9.0], np.float32),
            ), 40, 30,
        )  # fmt: skip
    assert statistics.gradient.tolist() == [40.0, 40.0, 0.0]
    assert statistics.gradient_abs.tolist() == [120.0, 80.0, 0.0]
    assert statistics.views.tolist() == [2, 1, 0]


def test_small_ones_are_cloned_large_ones_split_quiet_ones_stay() -> None:
    small, large = 0.5 * CLONE_SIZE, 4.0 * CLONE_SIZE
    adam = filled(gaussians_of_sizes([small, large, small, large]))
    before = adam.gaussians().detached().select(torch.arange(4))
    change = densify_and_prune(
        adam, with_gradients([1.5, 1.5, 0.2, 0.2]), 100, np.random.default_rng(0)
    )
    assert (change.cloned, change.split, change.pruned) == (1, 1, 0)
    assert len(adam) == 6
    means, scales = adam.array("means"), np.exp(adam.array("log_scales"))
    # Rows that stay: 0 (cloned), 2, 3; then the clone, then the two halves of 1.
    assert np.array_equal(means[:3], before.means[[0, 2, 3]].numpy())
    assert np.allclose(scales[3], small)
    assert np.allclose(scales[4:], large / SPLIT_FACTOR, rtol=1e-6)
    offset = np.linalg.norm(means[3:] - before.means[[0, 1, 1]].numpy(), axis=1)
    assert (offset > 0).all()
    assert (offset / np.array([small, large, large]) < 5).all()
    assert not np.array_equal(means[4], means[5])
    for name in TRAINED:
        for moment in adam.moments(name):
            assert (moment[:3] == 1).all()
            assert not moment[3:].any()
    assert adam.steps.tolist() == [5, 5, 5, 0, 0, 0]
    for name in ("quats", "sh", "opacity_logits", "orientation"):
        wanted = getattr(before, name)[[0, 2, 3, 0, 1, 1]].numpy()
        assert np.array_equal(adam.array(name), wanted), name


def test_new_positions_are_drawn_from_the_gaussian() -> None:
    count = 4000
    one = random_gaussians(1, 2, filter_size=0.0).replaced(
        log_scales=torch.log(torch.tensor([[0.3, 0.1, 0.02]], dtype=torch.float64)),
        opacity_logits=torch.zeros(1, dtype=torch.float64),
    )
    many = OrientedGaussians(
        **{n: t.float().repeat(count, *[1] * (t.ndim - 1)) for n, t in one.tensors()}
    )
    adam = filled(many)
    densify_and_prune(adam, with_gradients([2.0] * count), 10 * count, np.random.default_rng(1))
    offsets = adam.array("means").astype(np.float64) - one.means.numpy()
    rotation = one.rotations().numpy()[0]
    wanted = rotation @ np.diag([0.3**2, 0.1**2, 0.02**2]) @ rotation.T
    assert len(offsets) == 2 * count
    assert np.abs(np.cov(offsets.T) - wanted).max() < 0.05 * 0.3**2
    assert np.abs(offsets.mean(0)).max() < 0.02


def test_either_statistic_selects_and_both_select_the_same_share() -> None:
    adam = filled(gaussians_of_sizes([0.01] * 10))
    statistics = with_gradients([2, 2, 0, 0, 0, 0, 0, 0, 0, 0])
    statistics.gradient_abs[:] = [0, 0, 7, 8, 0, 0, 0, 0, 0, 0]
    change = densify_and_prune(adam, statistics, 100, np.random.default_rng(0))
    assert change.cloned == 4


def test_the_cap_is_never_passed_and_the_highest_gradients_come_first() -> None:
    gradients = np.random.default_rng(0).permutation(np.arange(20) / 4 + 1.1)
    adam = filled(gaussians_of_sizes([0.01] * 20))
    before = adam.array("means").copy()
    change = densify_and_prune(
        adam, with_gradients(gradients.tolist()), 23, np.random.default_rng(0)
    )
    assert len(adam) == 23
    assert change.cloned == 3
    best = np.sort(np.argsort(-gradients)[:3])
    offset = np.linalg.norm(adam.array("means")[20:] - before[best], axis=1)
    assert offset.max() < 0.05
    for limit in (23, 5, 0):
        densify_and_prune(adam, with_gradients([2.0] * 23), limit, np.random.default_rng(0))
        assert len(adam) == 23


def test_transparent_ones_are_pruned_but_never_all() -> None:
    gaussians = gaussians_of_sizes([0.01, 0.02, 0.03], 0.5 * MIN_OPACITY)
    gaussians.opacity_logits[1] = 1.0
    adam = filled(gaussians)
    change = densify_and_prune(adam, with_gradients([9, 0, 9]), 100, np.random.default_rng(0))
    assert (change.cloned, change.pruned, len(adam)) == (0, 2, 1)
    assert np.allclose(np.exp(adam.array("log_scales")), 0.02)
    adam = filled(gaussians_of_sizes([0.01, 0.02], 0.5 * MIN_OPACITY))
    densify_and_prune(adam, with_gradients([0, 0]), 100, np.random.default_rng(0))
    assert len(adam) == 1


def test_opacity_reset_caps_the_effective_opacity() -> None:
    gaussians = random_gaussians(200, dtype=torch.float32, filter_size=0.1)
    gaussians.opacity_logits[:5] = -9.0
    adam = filled(gaussians)
    before = gaussians.log_opacities().exp().numpy()
    reset_opacity(adam)
    after = adam.gaussians().detached().log_opacities().exp().numpy()
    faint = before < RESET_OPACITY
    assert 5 <= faint.sum() < 100
    assert np.allclose(after[faint], before[faint], rtol=1e-5)
    assert np.allclose(after[~faint], RESET_OPACITY, rtol=1e-3)
    assert not any(moment.any() for moment in adam.moments("opacity_logits"))
    assert all((moment == 1).all() for moment in adam.moments("means"))


def behind_frozen(rest: OrientedGaussians, frozen: int) -> Adam:
    """Return an optimiser of frozen Gaussians, some transparent, and these after them."""
    front = random_gaussians(frozen, 9, dtype=torch.float32, filter_size=0.0)
    front.opacity_logits[::3] = -9.0
    adam = filled(front.joined(rest))
    adam.frozen = frozen
    return adam


def test_frozen_ones_stay_and_change_nothing_for_the_others() -> None:
    sizes = [0.5 * CLONE_SIZE, 4.0 * CLONE_SIZE] * 10
    rest = gaussians_of_sizes(sizes)
    rest.opacity_logits[5] = -9.0
    values = np.random.default_rng(1).uniform(0.1, 2.0, 20).tolist()
    alone, adam = filled(rest), behind_frozen(rest, 30)
    front = adam.gaussians().detached().select(torch.arange(30))
    weights = np.random.default_rng(2).uniform(1, 2, 20)
    one = densify_and_prune(alone, with_gradients(values), 25, np.random.default_rng(0), weights)
    # Their gradients would come first.
    other = densify_and_prune(
        adam, with_gradients([50.0] * 30 + values), 25, np.random.default_rng(0),
        np.concatenate([np.full(30, 9.0), weights]),
    )  # fmt: skip
    assert one == other
    assert one.pruned == 1
    assert len(adam) == 30 + len(alone) == 55
    found = adam.gaussians().detached()
    for name, tensor in alone.gaussians().detached().tensors():
        assert torch.equal(getattr(found, name)[30:], tensor), name
        assert torch.equal(getattr(found, name)[:30], getattr(front, name)), name
    assert np.array_equal(adam.all_moments[30:], alone.all_moments)
    reset_opacity(adam)
    reset_opacity(alone)
    assert np.array_equal(adam.array("opacity_logits")[:30], front.opacity_logits.numpy())
    assert np.array_equal(adam.array("opacity_logits")[30:], alone.array("opacity_logits"))
    # Of the others one is always left.
    few = behind_frozen(gaussians_of_sizes([1.0, 1.0], opacity=0.001), 30)
    densify_and_prune(few, with_gradients([0.0] * 32), 100, np.random.default_rng(0))
    assert len(few) == 31

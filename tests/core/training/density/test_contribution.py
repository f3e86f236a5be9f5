# SPDX-License-Identifier: GPL-3.0-or-later
"""Contribution of Gaussians over the views, and pruning by it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.training.adam import Adam
from gaussian_wrapping_addon.core.training.density import (
    needed_by_a_view,
    prune_contributors,
)
from gaussian_wrapping_addon.core.training.wrapping import WrapView
from tests.core.render.scenes import random_gaussians


def camera(shift: float = 0.0) -> Camera:
    pose = np.concatenate([np.eye(3), [[shift], [0.0], [6.0]]], 1)
    return Camera("view", 64, 48, 60.0, 60.0, 32.0, 24.0, pose)


def a_wall_before(gaussians: OrientedGaussians) -> OrientedGaussians:
    """Put an opaque disc before all others as Gaussian 0."""
    first = torch.zeros(len(gaussians), dtype=torch.bool)
    first[0] = True
    means = torch.where(first[:, None], torch.tensor([0.0, 0.0, -4.0]), gaussians.means)
    logits = torch.where(first, torch.tensor(12.0), gaussians.opacity_logits)
    flat = torch.log(torch.tensor([3.0, 3.0, 0.01]))
    scales = torch.where(first[:, None], flat, gaussians.log_scales)
    quats = torch.where(first[:, None], torch.tensor([1.0, 0, 0, 0]), gaussians.quats)
    return gaussians.replaced(means=means, opacity_logits=logits, log_scales=scales, quats=quats)


def view_weights(gaussians: OrientedGaussians, views: list[WrapView]) -> np.ndarray:
    """Return (views, n) blending weights of the Gaussians in each view."""
    options = RenderOptions(depth=False, sh_degree=0, threads=1, statistics=True)
    found = [render(gaussians, view.camera, options).statistics for view in views]
    return np.stack([statistics.weight_sum for statistics in found if statistics is not None])


def test_what_hides_behind_a_wall_is_not_needed() -> None:
    gaussians = a_wall_before(random_gaussians(40, dtype=torch.float32))
    needed = needed_by_a_view(gaussians, [WrapView(camera(), None)], ViewRenderer(), 0.2, threads=1)
    assert needed[0]
    assert (~needed).sum() > 20


@pytest.mark.parametrize("share", [0.0, 0.03, 0.2])
def test_every_view_keeps_its_share_of_the_weights(share: float) -> None:
    gaussians = random_gaussians(80, dtype=torch.float32)
    views = [WrapView(camera(s), None) for s in (-2.0, -0.5, 0.5, 2.5)]
    needed = needed_by_a_view(gaussians, views, ViewRenderer(), share, threads=1)
    weights = view_weights(gaussians, views).astype(np.float64)
    kept = weights[:, needed].sum(1) / weights.sum(1)
    assert (kept >= 1.0 - share - 1e-9).all()
    # No more are kept than views ask for: of each, the next smaller ones would exceed the share.
    for index in np.flatnonzero(needed):
        alone = [row[row <= row[index]].sum() > share * row.sum() for row in weights]
        assert any(alone & (weights[:, index] > 0.0))
    if share == 0.0:
        assert np.array_equal(needed, weights.max(0) > 0.0)


def test_what_weighs_more_is_kept_first() -> None:
    gaussians = random_gaussians(80, dtype=torch.float32)
    views = [WrapView(camera(s), None) for s in (-0.5, 0.5)]
    plain = needed_by_a_view(gaussians, views, ViewRenderer(), 0.2, threads=1)
    chosen = ~plain & (view_weights(gaussians, views).max(0) > 0.0)
    heavy = np.where(chosen, 1e6, 1.0)
    weighted = needed_by_a_view(gaussians, views, ViewRenderer(), 0.2, heavy, threads=1)
    assert chosen.sum() > 5
    assert weighted[chosen].mean() > 0.5


def test_images_change_by_no_more_than_the_share() -> None:
    gaussians = random_gaussians(80, dtype=torch.float32)
    views = [WrapView(camera(s), None) for s in (-0.5, 0.0, 0.5)]
    adam = Adam(gaussians)
    before = [render(gaussians, v.camera, RenderOptions(threads=1)).alpha.numpy() for v in views]
    needed = needed_by_a_view(gaussians, views, ViewRenderer(), 0.02, threads=1)
    gone = prune_contributors(adam, needed)
    assert 0 < gone < 80
    after = [
        render(adam.gaussians(), v.camera, RenderOptions(threads=1)).alpha.numpy() for v in views
    ]
    # What was behind them shows instead, so an image loses less than the share of its weights.
    for a, b in zip(before, after, strict=True):
        assert 0 <= a.sum() - b.sum() <= 0.02 * a.sum()


def test_never_all_are_removed() -> None:
    adam = Adam(random_gaussians(5, dtype=torch.float32))
    assert prune_contributors(adam, np.zeros(5, bool)) == 0
    assert prune_contributors(adam, np.ones(5, bool)) == 0
    assert prune_contributors(adam, np.arange(5) >= 2) == 2
    assert len(adam) == 3


def test_frozen_ones_are_needed_by_definition() -> None:
    adam = Adam(random_gaussians(10, dtype=torch.float32))
    adam.frozen = 4
    means = adam.array("means").copy()
    needed = np.array([False] * 6 + [True, False, False, True])
    assert prune_contributors(adam, needed) == 4
    assert np.array_equal(adam.array("means"), means[[0, 1, 2, 3, 6, 9]])
    assert prune_contributors(adam, np.array([True] * 4 + [False] * 2)) == 0

# SPDX-License-Identifier: GPL-3.0-or-later
"""Contribution of Gaussians over the views, and pruning by it."""

from __future__ import annotations

import numpy as np
import torch

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types.options import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.training.density.contribution import (
    Contributions,
    contributions,
    least_contributors,
    prune_contributors,
)
from gaussian_wrapping_addon.core.training.density.wrapping import WrapView
from gaussian_wrapping_addon.core.training.optimizer.adam import Adam
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


def test_shares_add_up_to_the_mean_alpha() -> None:
    gaussians = random_gaussians(60, dtype=torch.float32)
    views = [WrapView(camera(s), None) for s in (-0.4, 0.3)]
    found = contributions(gaussians, views, ViewRenderer(), threads=1)
    options = RenderOptions(depth=False, threads=1)
    alpha = np.mean([render(gaussians, v.camera, options).alpha.numpy().mean() for v in views])
    np.testing.assert_allclose(found.share.sum(), alpha, rtol=1e-4)
    assert (found.largest <= 0.99 + 1e-6).all()


def test_what_hides_behind_a_wall_contributes_least() -> None:
    gaussians = a_wall_before(random_gaussians(40, dtype=torch.float32))
    found = contributions(gaussians, [WrapView(camera(), None)], ViewRenderer(), threads=1)
    assert found.share.argmax() == 0
    least = least_contributors(found, 0.2)
    assert not least[0]
    assert least.sum() > 20


def test_the_least_make_up_at_most_the_share() -> None:
    share = np.array([0.5, 0.0, 0.01, 0.3, 0.02, 0.17])
    found = Contributions(share, share)
    assert least_contributors(found, 0.03 + 1e-12).tolist() == [
        False, True, True, False, True, False,
    ]  # fmt: skip
    assert least_contributors(found, 0.0).tolist() == [False, True, False, False, False, False]


def test_images_change_by_no_more_than_the_share() -> None:
    gaussians = random_gaussians(80, dtype=torch.float32)
    views = [WrapView(camera(s), None) for s in (-0.5, 0.0, 0.5)]
    adam = Adam(gaussians)
    found = contributions(gaussians, views, ViewRenderer(), threads=1)
    before = [render(gaussians, v.camera, RenderOptions(threads=1)).alpha.numpy() for v in views]
    gone = prune_contributors(adam, least_contributors(found, 0.01))
    assert 0 < gone < 80
    after = [
        render(adam.gaussians(), v.camera, RenderOptions(threads=1)).alpha.numpy() for v in views
    ]
    # What was behind them shows instead, so the images lose less than the share of the weights.
    lost = np.mean([a.mean() - b.mean() for a, b in zip(before, after, strict=True)])
    assert 0 <= lost <= 0.01 * found.share.sum()


def test_never_all_are_removed() -> None:
    adam = Adam(random_gaussians(5, dtype=torch.float32))
    assert prune_contributors(adam, np.ones(5, bool)) == 0
    assert prune_contributors(adam, np.zeros(5, bool)) == 0
    assert prune_contributors(adam, np.arange(5) < 2) == 2
    assert len(adam) == 3

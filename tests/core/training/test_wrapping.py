# SPDX-License-Identifier: GPL-3.0-or-later
"""Wrapping: shrinking, shifting, flipping, normal errors, initial orientation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import TRAINED
from gaussian_wrapping_addon.core.training.adam import Adam
from gaussian_wrapping_addon.core.training.wrapping import (
    FIRST_SIGN,
    WrapView,
    normal_errors,
    start_orientation,
    wrap,
)
from tests.core.render.scenes import random_gaussians
from tests.core.training.small_scene import ring_cameras, sphere_gaussians


def test_clones_are_halved_shifted_and_flipped() -> None:
    gaussians = random_gaussians(60, 4, dtype=torch.float32, filter_size=0.03)
    gaussians.orientation[:, 3] += 0.3 * torch.sign(gaussians.orientation[:, 3])
    adam = Adam(gaussians)
    for name in TRAINED:
        adam.moments(name)[0][...] = 1.0
    errors = np.random.default_rng(0).uniform(0.1, 2.0, 60)
    assert wrap(adam, errors, 0.1, 1000) == 6
    chosen = np.sort(np.argsort(-errors)[:6])
    after = adam.gaussians().detached()
    assert len(after) == 66
    old, front, back = (
        gaussians.select(torch.from_numpy(chosen)),
        after.select(torch.from_numpy(chosen)),
        after.select(torch.arange(60, 66)),
    )
    normals = old.normals().double()
    unit = normals / normals.norm(dim=1, keepdim=True)
    # The product of the raw scales halves exactly, and both copies share it.
    for part in (front, back):
        volume = (part.log_scales - old.log_scales).double().sum(1).exp().numpy()
        assert volume == pytest.approx(0.5, rel=1e-5)
        for name in ("quats", "sh", "opacity_logits"):
            assert torch.equal(getattr(part, name), getattr(old, name))
    assert torch.equal(front.log_scales, back.log_scales)
    # They part along the normal by 0.1 of the new standard deviation along it.
    local = torch.einsum("nij,ni->nj", front.rotations().double(), unit)
    sigma = ((local * front.scales().double()) ** 2).sum(1).sqrt()
    for part, side in ((front, 1.0), (back, -1.0)):
        shift = (part.means - old.means).double()
        assert float((shift - side * 0.1 * sigma[:, None] * unit).abs().max()) < 1e-6
    assert torch.equal(front.orientation, old.orientation)
    assert torch.equal(back.orientation[:, :3], old.orientation[:, :3])
    assert torch.equal(back.orientation[:, 3], -old.orientation[:, 3])
    assert float((front.normals() + back.normals()).abs().max()) < 1e-6
    others = torch.from_numpy(np.setdiff1d(np.arange(60), chosen))
    for name, tensor in gaussians.tensors():
        assert torch.equal(getattr(after, name)[others], tensor[others]), name
    assert (adam.moments("means")[0][:60] == 1).all()
    assert not adam.moments("means")[0][60:].any()


def test_shrinking_along_an_axis_changes_this_axis_alone() -> None:
    gaussians = random_gaussians(1, 1, dtype=torch.float32, filter_size=0.0)
    axis = gaussians.rotations()[0, :, 1]
    gaussians.orientation[0] = torch.cat([axis, torch.tensor([1.0])])
    adam = Adam(gaussians)
    assert wrap(adam, np.ones(1), 1.0, 10) == 1
    change = (adam.gaussians().detached().log_scales[0] - gaussians.log_scales[0]).numpy()
    assert change == pytest.approx([0.0, np.log(0.5), 0.0], abs=1e-6)


def test_cap_share_and_orientation_limit_the_clones() -> None:
    gaussians = random_gaussians(40, 2, dtype=torch.float32)
    gaussians.orientation[:, 3] += 0.3 * torch.sign(gaussians.orientation[:, 3])
    gaussians.orientation[:10, 3] = 0.0  # without a sign there is nothing to flip
    errors = np.ones(40)
    errors[30:] = 0.0
    for share, limit, wanted in ((1.0, 100, 20), (1.0, 47, 7), (0.05, 100, 2), (1.0, 40, 0)):
        adam = Adam(gaussians)
        assert wrap(adam, errors, share, limit) == wanted
        assert len(adam) == 40 + wanted
    adam = Adam(gaussians)
    wrap(adam, errors, 1.0, 100)
    assert float((adam.gaussians().detached().orientation[40:, 3]).abs().min()) > 0.0


def views(count: int = 6) -> list[WrapView]:
    return [WrapView(camera, None) for camera in ring_cameras(count, 48)]


def test_the_vote_orients_a_sphere_outwards() -> None:
    truth = sphere_gaussians(150)
    adam = Adam(truth.replaced(orientation=torch.zeros(150, 4)))
    start_orientation(adam, views(), threads=1)
    orientation = adam.array("orientation")
    outward = (adam.gaussians().detached().normals().numpy() * truth.means.numpy()).sum(1)
    voted = orientation[:, 3] != 0
    assert voted.mean() > 0.9
    assert np.array_equal(np.abs(orientation[voted, 3]), np.full(voted.sum(), FIRST_SIGN, "f4"))
    # Near the silhouette a Gaussian may also be seen from its back; the rest must be right.
    assert (outward[voted] > 0).mean() > 0.97
    assert np.abs(outward[voted]).min() > 0.99 * np.tanh(FIRST_SIGN)


def test_the_vote_leaves_those_that_are_oriented_as_they_are() -> None:
    truth = sphere_gaussians(150)
    given = truth.orientation.clone()
    given[:, 3] *= -1.0  # inwards: no vote would have it so
    given[::3] = 0.0
    given[1::3, 3] = 0.03  # too short a normal to count
    adam = Adam(truth.replaced(orientation=given))
    start_orientation(adam, views(), threads=1)
    found = adam.array("orientation")
    kept = np.arange(150) % 3 == 2
    assert np.array_equal(found[kept], given.numpy()[kept])
    voted = found[~kept]
    assert (np.abs(voted[:, 3]) == FIRST_SIGN).mean() > 0.9
    outward = (adam.gaussians().detached().normals().numpy() * truth.means.numpy()).sum(1)
    assert (outward[~kept][voted[:, 3] != 0] > 0).mean() > 0.97


def test_errors_point_at_the_gaussians_with_wrong_normals() -> None:
    truth = sphere_gaussians(150)
    right = normal_errors(truth, views(), threads=1)
    assert right.shape == (150,)
    flipped = truth.replaced(orientation=truth.orientation.clone())
    wrong = np.arange(0, 150, 10)
    flipped.orientation[wrong, 3] *= -1.0
    errors = normal_errors(flipped, views(), threads=1)
    seen = right > 0
    assert seen.mean() > 0.8
    assert np.median(right[seen]) < 0.2
    assert np.median(errors[wrong][seen[wrong]]) > 5 * np.median(right[seen])
    assert np.isin(np.argsort(-errors)[:10], wrong).mean() > 0.6
    # One that is masked everywhere has no error.
    masked = [WrapView(v.camera, np.zeros((48, 48), bool)) for v in views()]
    assert not normal_errors(flipped, masked, threads=1).any()


def test_frozen_ones_are_neither_cloned_nor_turned() -> None:
    rest, front = (
        random_gaussians(40, 2, dtype=torch.float32),
        random_gaussians(25, 3, dtype=torch.float32),
    )
    for some in (rest, front):
        some.orientation[:, 3] += 0.3 * torch.sign(some.orientation[:, 3])
    errors = np.random.default_rng(0).uniform(0.1, 1, 40)
    for share, limit in ((0.3, 100), (1.0, 47)):
        alone, adam = Adam(rest), Adam(front.joined(rest))
        adam.frozen = 25
        clones = wrap(alone, errors, share, limit)
        assert wrap(adam, np.concatenate([np.full(25, 2.0), errors]), share, limit) == clones > 0
        found = adam.gaussians().detached()
        for name, tensor in alone.gaussians().detached().tensors():
            assert torch.equal(getattr(found, name)[25:], tensor), name
            assert torch.equal(getattr(found, name)[:25], getattr(front, name)), name
    without = sphere_gaussians(60)
    without = without.replaced(orientation=torch.zeros(60, 4))
    adam = Adam(without)
    adam.frozen = 20
    start_orientation(adam, views(), threads=1)
    assert not adam.array("orientation")[:20].any()
    assert adam.array("orientation")[20:].any()

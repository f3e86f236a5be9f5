# SPDX-License-Identifier: GPL-3.0-or-later
"""Gradients of depth queries against the definition's, in Gaussians and positions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.render.depth_query import query_view, solve_depths
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.reference import reference_depth_at
from gaussian_wrapping_addon.core.render.types import RenderOptions

from .comparisons import leaves, relative_l2
from .query_autograd import query_depth
from .query_scenes import EYE, SHAPES, Oracle, random_positions, scene
from .scenes import look_at


@pytest.mark.parametrize(("name", "bound"), [("generic", 1e-4), ("thin", 1e-4), ("inside", 1e-4)])
def test_depth_gradients_are_those_of_the_definition(name: str, bound: float) -> None:
    gaussians, camera = scene(name)
    options = RenderOptions(threads=2)
    positions = random_positions(camera, 1500)
    one, two = leaves(gaussians, torch.float32), leaves(gaussians, torch.float64)
    at_one = torch.from_numpy(positions).requires_grad_()
    at_two = torch.from_numpy(positions).double().requires_grad_()
    fast = query_depth(one, camera, at_one, options)
    exact = reference_depth_at(two, camera, at_two, options)
    # A depth's gradient is something well conditioned over the slope of log T.
    result = solve_depths(query_view(RawArrays.from_gaussians(one), camera, options), positions)
    slopes = np.zeros(len(positions))
    slopes[result.positions.order] = result.slopes
    random = np.random.default_rng(6)
    weight = torch.from_numpy(random.normal(size=len(positions)) * slopes)
    weight = torch.where((fast.detach() > 0) & (exact.detach() > 0), weight, 0.0)
    assert int((weight != 0).sum()) > 300
    (fast.double() * weight).sum().backward()
    (exact * weight).sum().backward()
    for field in SHAPES:
        assert relative_l2(getattr(one, field).grad, getattr(two, field).grad) < bound, field
    assert at_one.grad is not None
    assert at_two.grad is not None
    assert relative_l2(at_one.grad, at_two.grad) < bound


def test_gradient_on_positions_is_the_slope_of_the_depth() -> None:
    gaussians, camera = scene("generic")
    oracle = Oracle(gaussians, camera)
    positions = random_positions(camera, 800).clip(1.0, [49.0, 39.0]).astype(np.float32)
    at = torch.from_numpy(positions).requires_grad_()
    depth = query_depth(gaussians, camera, at)
    depth.sum().backward()
    assert at.grad is not None
    step = 1e-5
    checked = 0
    for axis in range(2):
        shift = np.zeros(2)
        shift[axis] = step
        ahead, behind = oracle.depth(positions + shift), oracle.depth(positions - shift)
        difference = (ahead - behind) / (2.0 * step)
        # A contributor that enters between the two positions is a jump, not a slope.
        smooth = (ahead > 0) & (behind > 0) & (np.abs(difference) < 1.0)
        error = np.abs(at.grad[:, axis].numpy() - difference)[smooth]
        assert (error < 1e-4).mean() > 0.99
        checked += int(smooth.sum())
    assert checked > 600


def test_bitwise_the_same_for_any_number_of_threads() -> None:
    gaussians, _ = scene("generic")
    camera = look_at(EYE, width=90, height=70, focal=100.0)
    positions = torch.from_numpy(random_positions(camera, 5000))
    results = []
    for threads in (1, 2, 4):
        leaf, at = leaves(gaussians, torch.float32), positions.clone().requires_grad_()
        options = RenderOptions(threads=threads)
        depth = query_depth(leaf, camera, at, options)
        depth.square().sum().backward()
        results.append([depth.detach(), at.grad] + [getattr(leaf, field).grad for field in SHAPES])
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)

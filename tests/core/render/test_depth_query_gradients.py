# SPDX-License-Identifier: GPL-3.0-or-later
"""Gradients of depth queries against the definition's, in Gaussians, positions and depths."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.render.projection.projection import (
    RawArrays,
    RawGradients,
    project_backward,
)
from gaussian_wrapping_addon.core.render.query.depth_query import (
    add_query_gradients,
    query_depth,
    query_transmittance,
    query_view,
    query_view_of,
    solve_depths,
)
from gaussian_wrapping_addon.core.render.raster.blend import (
    Images,
    RenderBuffers,
    blend,
    blend_backward,
)
from gaussian_wrapping_addon.core.render.reference.reference import (
    reference_depth_at,
    reference_transmittance_at,
)
from gaussian_wrapping_addon.core.render.render import project_view, render
from gaussian_wrapping_addon.core.render.types.options import RenderOptions

from .comparisons import leaves, relative_l2
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


@pytest.mark.parametrize("name", ["generic", "thin", "opaque"])
def test_transmittance_gradients_are_those_of_the_definition(name: str) -> None:
    gaussians, camera = scene(name)
    positions = torch.from_numpy(random_positions(camera, 1500))
    random = np.random.default_rng(7)
    depths = torch.from_numpy(random.uniform(1.0, 4.0, 1500).astype(np.float32))
    weight = torch.from_numpy(random.normal(size=1500))
    grads = []
    for dtype in (torch.float32, torch.float64):
        leaf = leaves(gaussians, dtype)
        at = positions.to(dtype).clone().requires_grad_()
        deep = depths.to(dtype).clone().requires_grad_()
        if dtype == torch.float32:
            through = query_transmittance(leaf, camera, at, deep)
        else:
            through = reference_transmittance_at(leaf, camera, at, deep, RenderOptions())
        (through.double() * weight).sum().backward()
        grads.append([*(getattr(leaf, field).grad for field in SHAPES), at.grad, deep.grad])
    for fast, exact in zip(*grads, strict=True):
        assert relative_l2(fast, exact) < 1e-4


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
        through = query_transmittance(leaf, camera, at, torch.full((5000,), 2.3), options)
        (depth.square().sum() + through.square().sum()).backward()
        results.append(
            [depth.detach(), through.detach(), at.grad]
            + [getattr(leaf, field).grad for field in SHAPES]
        )
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a, b)


def test_one_projection_serves_image_and_query() -> None:
    gaussians, camera = scene("generic")
    options = RenderOptions(threads=1)
    positions = random_positions(camera, 500)
    weight = np.random.default_rng(3).normal(size=500).astype(np.float32)

    raw = RawArrays.from_gaussians(gaussians)
    view = project_view(raw, camera, options)
    images, buffers = Images.allocate(camera, options), RenderBuffers()
    blend(view, images, buffers)
    ones = [np.ones_like(images.color), *[np.zeros_like(images.color)] * 2]
    ones += [np.zeros_like(images.alpha)] * 2
    grad_params, _, _ = blend_backward(view, images, ones, buffers, absolute=False)
    shared = query_view_of(view)
    result = solve_depths(shared, positions)
    on_positions, _ = add_query_gradients(shared, result, weight, grad_params)
    total = RawGradients.zeros(raw)
    project_backward(raw, camera, options, view.screen, grad_params, total)

    leaf, at = leaves(gaussians, torch.float32), torch.from_numpy(positions).requires_grad_()
    depth = query_depth(leaf, camera, at, options)
    loss = render(leaf, camera, options).color.sum() + (depth * torch.from_numpy(weight)).sum()
    loss.backward()
    np.testing.assert_allclose(result.values, depth.detach().numpy(), rtol=5e-6)
    assert relative_l2(on_positions, at.grad) < 1e-4
    for field in SHAPES:
        assert relative_l2(getattr(total, field), getattr(leaf, field).grad) < 1e-4, field

# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth queries: invalid arguments, and results where little or nothing is visible."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.query.depth_query import query_depth, query_transmittance
from gaussian_wrapping_addon.core.render.types.options import RenderOptions

from .comparisons import leaves
from .query_scenes import SHAPES, scene
from .scenes import isotropic, look_at


def test_positions_off_the_image_have_no_answer_and_no_gradient() -> None:
    gaussians = isotropic([(0.0, 0.0, 0.0)], [15.0], [0.9], torch.float32)  # covers everything
    pose = look_at((0.0, -40.0, 0.0)).cam_from_world
    camera = Camera("front", 20, 10, 40.0, 40.0, 10.0, 5.0, pose)
    inside = [[0.0, 0.0], [20.0, 10.0], [0.0, 10.0], [7.3, 2.2]]
    nan, inf = math.nan, math.inf
    outside = [[-1e-3, 5.0], [5.0, 10.001], [20.01, 5.0], [nan, 5.0], [5.0, nan], [inf, 5.0]]
    outside += [[-inf, 5.0], [1e30, -1e30], [nan, inf]]
    leaf = leaves(gaussians, torch.float32)
    at = torch.tensor(inside + outside, requires_grad=True)
    depths = torch.full((len(at),), 38.0, requires_grad=True)
    found = [query_depth(leaf, camera, at), query_transmittance(leaf, camera, at, depths)]
    for answer in found:
        assert (answer[: len(inside)] > 0).all()
        assert not answer[len(inside) :].any()
    (found[0].sum() + found[1].sum()).backward()
    for grad in (at.grad, depths.grad):
        assert grad is not None
        assert torch.isfinite(grad).all()
        assert grad[: len(inside)].any()
        assert not grad[len(inside) :].any()
    deep = torch.tensor([nan, inf, -inf, 38.0])
    through = query_transmittance(leaf, camera, at.detach()[3].expand(4, 2), deep)
    assert through[0] == 0.0
    assert 0.0 < through[1] < through[3] < through[2] <= 1.0


def test_nothing_to_see_and_nothing_asked() -> None:
    gaussians = isotropic([(0.0, 9.0, 0.0)], [0.1], [0.9], torch.float32)
    camera = look_at((0.0, 3.0, 0.0), width=18, height=10)  # looks away
    for some in (gaussians, gaussians.select(torch.zeros(1, dtype=torch.bool))):
        for count in (0, 3):
            leaf = leaves(some, torch.float32)
            at = torch.full((count, 2), 4.0, requires_grad=True)
            depth = query_depth(leaf, camera, at)
            assert depth.shape == (count,)
            assert not depth.any()
            through = query_transmittance(leaf, camera, at, torch.ones(count))
            assert (through == 1.0).all()
            (depth.sum() + through.sum()).backward()
            assert leaf.means.grad is not None
            assert not leaf.means.grad.any()


def test_wrong_shapes_are_refused() -> None:
    gaussians, camera = scene("generic")
    with pytest.raises(UsageError, match="shape"):
        query_depth(gaussians, camera, torch.zeros((4, 3)))
    with pytest.raises(UsageError, match="depths of shape"):
        query_transmittance(gaussians, camera, torch.zeros((4, 2)), torch.zeros(3))


def test_changed_parameters_are_refused_by_backward() -> None:
    gaussians, camera = scene("generic")
    leaf = leaves(gaussians, torch.float32)
    depth = query_depth(leaf, camera, torch.full((3, 2), 20.0))
    with torch.no_grad():
        leaf.means.mul_(1.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        depth.sum().backward()


def floats(low: float, high: float, shape: tuple[int, ...]) -> st.SearchStrategy[np.ndarray]:
    """Return arrays of finite float32 between two bounds."""
    return hnp.arrays(np.float32, shape, elements=st.floats(low, high, width=32))


@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_answers_and_gradients_are_finite(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 5))
    gaussians = OrientedGaussians(
        torch.from_numpy(data.draw(floats(-8.0, 8.0, (count, 3)))),
        torch.from_numpy(data.draw(floats(-40.0, 8.0, (count, 3)))),
        torch.from_numpy(data.draw(floats(-2.0, 2.0, (count, 4)))),
        torch.from_numpy(data.draw(floats(-40.0, 40.0, (count,)))),
        torch.zeros((count, 1, 3)),
        torch.zeros((count, 4)),
        torch.from_numpy(data.draw(floats(0.0, 0.5, (count,)))),
    )
    camera = look_at((0.0, -4.0, 0.0), width=20, height=18, focal=25.0)
    anything = st.one_of(st.floats(-2.0, 22.0, width=32), st.floats(width=32))
    at = torch.from_numpy(data.draw(hnp.arrays(np.float32, (12, 2), elements=anything)))
    # However small a Gaussian is, some position looks at it.
    at[:count] = torch.from_numpy(camera.project(gaussians.means.numpy())[0]).float()
    deep = torch.from_numpy(data.draw(hnp.arrays(np.float32, (12,), elements=anything)))
    options = RenderOptions(threads=1, depth_valid_transmittance=data.draw(st.floats(0.0, 1.0)))
    leaf = leaves(gaussians, torch.float32)
    at, deep = at.requires_grad_(), deep.requires_grad_()
    depth = query_depth(leaf, camera, at, options)
    through = query_transmittance(leaf, camera, at, deep, options)
    assert torch.isfinite(depth).all()
    assert (depth >= 0).all()
    assert ((through >= 0) & (through <= 1)).all()
    (depth.sum() + through.sum()).backward()
    for grad in [*(getattr(leaf, field).grad for field in SHAPES), at.grad, deep.grad]:
        assert grad is not None
        assert torch.isfinite(grad).all()

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

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera

from .comparisons import leaves
from .query_autograd import query_depth
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
    found = query_depth(leaf, camera, at)
    assert (found[: len(inside)] > 0).all()
    assert not found[len(inside) :].any()
    found.sum().backward()
    assert at.grad is not None
    assert torch.isfinite(at.grad).all()
    assert at.grad[: len(inside)].any()
    assert not at.grad[len(inside) :].any()


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
            depth.sum().backward()
            assert leaf.means.grad is not None
            assert not leaf.means.grad.any()


def test_wrong_shapes_are_refused() -> None:
    gaussians, camera = scene("generic")
    with pytest.raises(UsageError, match="shape"):
        query_depth(gaussians, camera, torch.zeros((4, 3)))


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
    options = RenderOptions(threads=1, depth_valid_transmittance=data.draw(st.floats(0.0, 1.0)))
    leaf = leaves(gaussians, torch.float32)
    at = at.requires_grad_()
    depth = query_depth(leaf, camera, at, options)
    assert torch.isfinite(depth).all()
    assert (depth >= 0).all()
    depth.sum().backward()
    for grad in [*(getattr(leaf, field).grad for field in SHAPES), at.grad]:
        assert grad is not None
        assert torch.isfinite(grad).all()

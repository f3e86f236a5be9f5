# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth queries where a solver goes wrong: thin layers before and behind surfaces, plateaus."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.render.depth_query import query_depth
from gaussian_wrapping_addon.core.render.reference import reference_depth_at
from gaussian_wrapping_addon.core.render.types import RenderOptions

from .comparisons import leaves, narrowed, relative_l2
from .depth_scenes import SCENES, WIDE, assert_depth, ball_before_disc, scene
from .first_principles import FirstPrinciples

OPTIONS = RenderOptions(threads=1)
SHAPES = ("means", "log_scales", "quats", "opacity_logits")


def pixel_centres(camera: Camera) -> torch.Tensor:
    """Return (h * w, 2) positions, row by row."""
    y, x = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    return torch.from_numpy(np.stack([x.reshape(-1), y.reshape(-1)], 1))


@pytest.mark.parametrize("name", SCENES)
def test_depth_against_bisection(name: str) -> None:
    gaussians, camera = scene(name)
    with torch.no_grad():
        found = query_depth(
            leaves(gaussians, torch.float32), camera, pixel_centres(camera), OPTIONS
        )
    truth = FirstPrinciples(gaussians, camera).images()
    assert_depth(found.double().numpy().reshape(truth.depth.shape), truth)


@pytest.mark.parametrize("thickness", [1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_a_hidden_thin_disc_leaves_the_gradient_alone(thickness: float) -> None:
    # All depths of the ball before it weigh alike, flat or not.
    gaussians = narrowed(ball_before_disc(thickness))
    grads = []
    for dtype in (torch.float32, torch.float64):
        leaf, at = leaves(gaussians, dtype), pixel_centres(WIDE).to(dtype).requires_grad_()
        ask = query_depth if dtype == torch.float32 else reference_depth_at
        depth = ask(leaf, WIDE, at, OPTIONS)
        near = (depth.detach() > 0) & (depth.detach() < 4.0)
        assert int(near.sum()) >= 4
        weight = torch.from_numpy(np.random.default_rng(7).normal(size=len(at)))
        (depth.double() * torch.where(near, weight, 0.0)).sum().backward()
        found = [getattr(leaf, name).grad for name in SHAPES]
        grads.append([grad.double().numpy() for grad in (*found, at.grad)])
    whole = float(np.linalg.norm([np.linalg.norm(grad) for grad in grads[1]]))
    for fast, exact in zip(*grads, strict=True):
        assert relative_l2(fast, exact, whole) < 1e-4
    # The disc itself gets none.
    assert not any(grad[0].any() for grad in grads[0][: len(SHAPES)])

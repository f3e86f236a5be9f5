# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth queries in difficult cases: thin layers in front of and behind surfaces, plateaus."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.depth_query import query_view
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.reference import reference_depth_at, reference_projection
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera

from .comparisons import leaves, narrowed, relative_l2
from .depth_scenes import SCENES, WIDE, assert_depth, ball_before_disc, doubled, scene
from .first_principles import FirstPrinciples
from .query_autograd import query_depth
from .scenes import front_camera, one_gaussian
from .test_properties import cameras, steady, wild_gaussians

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


@pytest.mark.parametrize("aside", [300.0, 3000.0])
def test_a_gaussian_that_projects_far_aside_is_seen(aside: float) -> None:
    # Hundreds of images aside, beyond where a finer screen numbers its pixels.
    gaussians = narrowed(one_gaussian((3 * aside, 0.1, 3 * aside), 0.98, (aside, -3.5, 0.0)))
    camera = front_camera(40, 36, focal=45.0)
    positions = pixel_centres(camera)
    with torch.no_grad():
        found = query_depth(leaves(gaussians, torch.float32), camera, positions, OPTIONS)
        exact = reference_depth_at(gaussians, camera, positions, OPTIONS)
    assert (exact > 0).all()
    assert ((found - exact).abs() < 1e-5 * exact).all()


@pytest.mark.parametrize("length", [1e3, 1e5, 1e8])
def test_a_slanted_beam_of_any_length_is_seen_whole(length: float) -> None:
    # Its box is cut off far beyond the image, and is no longer that of the ellipse.
    gaussians = narrowed(one_gaussian((length, 0.01, 0.3), 0.98, turn=0.6, axis=1))
    camera = front_camera(40, 36, focal=45.0)
    positions = pixel_centres(camera)
    with torch.no_grad():
        found = query_depth(leaves(gaussians, torch.float32), camera, positions, OPTIONS)
        exact = reference_depth_at(gaussians, camera, positions, OPTIONS)
    assert (exact > 0).sum() > 300
    assert torch.equal(found > 0, exact > 0)
    assert ((found - exact).abs() <= 1e-5 * exact).all()


@steady(60)
@given(gaussians=wild_gaussians(), camera=cameras(), near_z=st.sampled_from([0.2, 0.0, -1.0]))
def test_what_the_image_hides_is_hidden(
    gaussians: OrientedGaussians, camera: Camera, near_z: float
) -> None:
    options = RenderOptions(near_z=near_z, sh_degree=0, threads=1)
    # In the projection's own arithmetic: at the rule's edge float32 decides otherwise.
    usable = reference_projection(doubled(gaussians), camera, options).usable
    leaf = leaves(gaussians, torch.float32)
    view = query_view(RawArrays.from_gaussians(leaf), camera, options)
    assert not view.screen.visible[~usable.numpy()].any()
    at = pixel_centres(camera).float().requires_grad_()
    depth = query_depth(leaf, camera, at, options)
    assert torch.isfinite(depth).all()
    depth.sum().backward()
    for grad in [*(getattr(leaf, name).grad for name in SHAPES), at.grad]:
        assert grad is not None
        assert torch.isfinite(grad).all()

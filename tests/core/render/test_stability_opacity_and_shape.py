# SPDX-License-Identifier: GPL-3.0-or-later
"""Hard cases 1 to 3 of the kernels: opacity, tiny and far, anisotropy; against 60 digits.

Where the standard deviation along the ray falls below 1e-3 of the depth, the float32 depth (and
peak) resolves it to only 6e-8 depth / sigma, and with it the part of the depth's gradient that
reaches opacity and thickness. The part that reaches means and rotation stays. Such cases state
their own tolerance for the depth's gradient; no case is looser in its images' gradient.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians

from .comparisons import judge
from .scenes import coloured, front_camera, isotropic, one_gaussian, random_gaussians

DIGITS = 60


def of_logit(logit: float) -> OrientedGaussians:
    gaussians = random_gaussians(2, 1, sh_degree=0, spread=0.3, scale=(0.2, 0.5))
    return gaussians.replaced(opacity_logits=torch.full((2,), logit, dtype=torch.float64))


@pytest.mark.parametrize("logit", [20.0, 80.0, 4.0, -4.0])
def test_item_01_opacity_near_0_and_1(logit: float) -> None:
    verdict = judge(of_logit(logit), front_camera(5, 4), digits=DIGITS)
    verdict.assert_within(blended=2e-7, depth=1e-6, gradient=1e-5, depth_gradient=2e-5)
    assert (verdict.depth_count >= 3) == (logit > 0)
    # The gradient of a saturated opacity is tiny, not nothing: exp(-80) is 1.8e-35.
    slope = 1.0 / (2.0 + math.exp(logit) + math.exp(-logit))
    assert 0.01 * slope < verdict.sizes["opacity_logits"] < 100.0 * slope


@pytest.mark.parametrize("logit", [-20.0, -80.0])
def test_item_01_vanished_gaussians_leave_no_trace(logit: float) -> None:
    verdict = judge(of_logit(logit), front_camera(5, 4), digits=DIGITS)
    verdict.assert_within(blended=1e-8)
    assert not verdict.found["alpha"].any()
    assert not any(verdict.sizes.values())


def test_item_01_a_capped_alpha_has_no_gradient() -> None:
    # Every ray that passes within 0.1 sigma has alpha 0.99.
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0)], [1.0], [1.0 - 1e-7]))
    verdict = judge(gaussians, front_camera(2, 2, focal=200.0), digits=DIGITS)
    verdict.assert_within(blended=2e-7, depth=1e-6)
    assert verdict.sizes["opacity_logits"] == verdict.sizes["log_scales"] == 0.0
    assert verdict.sizes["sh"] > 0.1


def test_item_01_saturated_layers_in_a_row() -> None:
    # Three layers of alpha 0.99 (capped) in front of each other, seen at and off their centres.
    means = [(0.01 * k, 0.5 * k, 0.02 * k) for k in range(3)]
    gaussians = coloured(isotropic(means, [0.4, 0.3, 0.35], [0.5] * 3))
    gaussians = gaussians.replaced(opacity_logits=torch.tensor([20.0, 80.0, 8.0]).double())
    verdict = judge(gaussians, front_camera(9, 8), digits=DIGITS, gradient_digits=0)
    verdict.assert_within(blended=5e-7, depth=1e-6, gradient=1e-5, depth_gradient=2e-5)
    assert verdict.depth_count >= 6


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_item_01_log_scales_at_extremes(side: float) -> None:
    # exp(-30) is far below a pixel; exp(30) is flat over the image. Each has one visible neighbour.
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0), (0.1, 1.0, 0.0)], [1.0, 0.5], [0.6, 0.8]))
    log_scales = gaussians.log_scales.clone()
    log_scales[0] = side * 30.0
    verdict = judge(gaussians.replaced(log_scales=log_scales), front_camera(4, 4), digits=DIGITS)
    verdict.assert_within(blended=3e-7, gradient=1e-5)
    assert verdict.found["alpha"].max() > 0.5


def test_item_01_the_mip_filter_keeps_what_is_smaller_than_itself() -> None:
    gaussians = one_gaussian((0.3, 0.4, 1e-3), 0.99, (0.02, 0.0, 0.01), 0.4)
    gaussians = gaussians.replaced(filter_3d=torch.full((1,), 0.02).double())
    verdict = judge(gaussians, front_camera(focal=60.0), digits=DIGITS)
    verdict.assert_within(blended=5e-7, gradient=1e-5)
    assert verdict.found["alpha"].max() > 0.02


def four_layers(sigma: float) -> OrientedGaussians:
    random = np.random.default_rng(3)
    means = [tuple(row) for row in random.uniform(-2 * sigma, 2 * sigma, (4, 3))]
    return coloured(isotropic(means, [sigma] * 4, [0.3, 0.9, 0.7, 0.6]))


# A sigma of 1e-4 is 1e-7 and 1e-9 of the depth: float32 depths (column z of the screen rows, the
# solver's t) stand 6e-8 apart, so single layers are not resolved: depths are exact to their
# rounding, and the gradient of the depth is not.
@pytest.mark.parametrize("distance", [1e3, 1e5])
def test_item_02_tiny_and_far(distance: float) -> None:
    camera = front_camera(focal=1.5e4 * distance, distance=distance)
    verdict = judge(four_layers(1e-4), camera, digits=DIGITS, gradient_digits=0)
    verdict.assert_within(
        blended=1e-6, depth=3e-7, gradient=1e-5, depth_gradient=2.0, depth_count=15
    )


@pytest.mark.parametrize("distance", [1e3, 1e5])
def test_item_02_gradients_of_a_tiny_one_against_sixty_digits(distance: float) -> None:
    gaussians = one_gaussian((1e-4, 2e-4, 5e-5), 0.9, (2e-5, 1e-4, -1e-5), 0.4)
    camera = front_camera(focal=1.5e4 * distance, distance=distance)
    verdict = judge(gaussians, camera, digits=DIGITS)
    verdict.assert_within(blended=1e-6, depth=3e-7, gradient=2e-5, depth_gradient=2.0)
    assert verdict.depth_count >= 3


# The law: about 2e-7 depth / sigma. 1e-4 holds for every sigma above 1e-3 of the depth.
@pytest.mark.parametrize("depths_per_sigma", [30.0, 300.0, 1e3, 1e4, 1e5])
def test_item_02_depth_gradient_follows_sigma_over_depth(depths_per_sigma: float) -> None:
    distance = 1e-3 * depths_per_sigma
    camera = front_camera(focal=1.5 * depths_per_sigma, distance=distance)
    verdict = judge(four_layers(1e-3), camera, near_z=1e-3 * distance)
    verdict.assert_within(
        blended=1e-6,
        depth=5e-7,
        gradient=1e-5,
        depth_gradient=3e-5 + 3e-7 * depths_per_sigma,
        depth_count=15,
    )


# Name: scales, turn, axis of the turn (0 tilts towards the ray, 2 about the vertical), focal
# length in pixels (4e6: one pixel is one micro-unit), tolerances of images, of their gradient, of
# the depth's gradient.
SHAPES = {
    "needle along the ray": ((1e-6, 1.0, 1e-6), 0.0, 2, 4e6, 5e-7, 1e-5, 2e-5),
    "needle one micro-radian off": ((1e-6, 1.0, 1e-6), 1e-6, 2, 4e6, 5e-7, 1e-5, 2e-5),
    # Along the ray the tilted needle is 1.5e-6 thick at depth 4: two float32 steps.
    "needle across": ((1e-6, 1.0, 1e-6), 0.7, 2, 4e6, 1e-6, 1e-5, 1.1),
    "needle through the image": ((0.1, 1e5, 0.1), 0.3, 2, 10.0, 2e-6, 2e-5, 1e-4),
    "needle towards the camera": ((0.1, 1e5, 0.1), 0.3, 0, 10.0, 1e-6, 1e-5, 4e-4),
    "disc edge-on": ((1e-6, 0.5, 0.5), 0.0, 2, 4e6, 5e-7, 1e-5, 2e-5),
    "disc two micro-radians off": ((1e-6, 0.5, 0.5), 2e-6, 2, 4e6, 1e-6, 1e-5, 2e-5),
    # Thickness along the ray 5e-5, 2e-6 and 1e-6 at depth 4.
    "disc grazing": ((1e-6, 0.5, 0.5), 0.02, 2, 1e3, 5e-7, 5e-5, 0.5),
    "disc oblique": ((1e-6, 0.5, 0.5), 0.5, 2, 20.0, 5e-7, 1e-5, 0.5),
    "disc from the front": ((0.5, 5e-7, 0.5), 0.3, 2, 10.0, 5e-7, 1e-5, 1.1),
    "plate": ((1e-3, 1e3, 1e3), 0.3, 2, 10.0, 1e-6, 1e-4, 5e-4),
    "plate beyond everything": ((0.1, 1e5, 1e5), 0.3, 2, 10.0, 1e-6, 2e-4, 1e-4),
    # 200 times as long as wide on the screen and 2.5e-3 pixels wide: the conic's terms cancel.
    "thin edge on the screen": ((1e-3, 0.5, 0.5), 0.3, 1, 10.0, 2e-5, 2e-4, 1e-4),
}


@pytest.mark.parametrize("name", SHAPES)
def test_item_03_anisotropy_of_a_million(name: str) -> None:
    scales, turn, axis, focal, blended, gradient, depth_gradient = SHAPES[name]
    gaussians = one_gaussian(scales, 0.9, (0.5 / focal, 0.0, 0.4 / focal), turn, axis)
    verdict = judge(gaussians, front_camera(focal=focal), digits=DIGITS)
    verdict.assert_within(
        blended=blended, depth=5e-6, gradient=gradient, depth_gradient=depth_gradient
    )
    assert verdict.found["alpha"].max() > 0.05


def test_item_03_depth_gradient_of_a_thin_disc_still_moves_it() -> None:
    # Means and rotation of a disc far thinner than a float32 step of its depth.
    gaussians = one_gaussian((0.5, 5e-7, 0.5), 0.9, (0.05, 0.0, 0.04), 0.3, 2)
    verdict = judge(gaussians, front_camera(focal=10.0), digits=DIGITS)
    assert verdict.depth_count >= 4
    assert verdict.depth_gradients["means"] < 1e-5
    assert verdict.depth_gradients["quats"] < 1e-5


def fat_before_thin(thickness: float) -> OrientedGaussians:
    """A ball of sigma 0.4 at depth 3.5, a disc at depth 5 behind it, a cloud at depth 6."""
    disc = one_gaussian((1.5, thickness, 1.5), 0.95, (0.0, 1.0, 0.0))
    others = coloured(isotropic([(-0.3, -0.5, 0.0), (0.0, 2.0, 0.0)], [0.4, 0.8], [0.9, 0.9]), 3)
    parts = zip(disc.tensors(), others.tensors(), strict=True)
    return OrientedGaussians(**{name: torch.cat([one, two]) for (name, one), (_, two) in parts})


@pytest.mark.parametrize("thickness", [1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_item_03_a_thin_disc_leaves_the_surface_before_it_alone(thickness: float) -> None:
    # Depths and their gradients where the ball is seen; the disc, 1.5 units behind, is hidden.
    verdict = judge(fat_before_thin(thickness), front_camera(12, 10, focal=16.0), nearer_than=4.0)
    verdict.assert_within(blended=1e-6, depth=1e-5, gradient=2e-5, depth_gradient=1e-4)
    assert (verdict.truth.depth[verdict.truth.depth > 0] < 4.0).sum() >= 4

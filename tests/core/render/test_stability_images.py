# SPDX-License-Identifier: GPL-3.0-or-later
"""Hard cases 1 to 7 and 12 of the kernels' images: opacity, shape, layers, views.

Where the standard deviation along the ray falls below 1e-3 of the depth, the float32 depth (and
peak) resolves it to only 6e-8 depth / sigma, and with it the part of the depth's gradient that
reaches opacity and thickness. The part that reaches means and rotation stays. Such cases state
their own tolerance for the depth's gradient; no case is looser in its images' gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render import comparisons
from tests.core.render.comparisons import Verdict, gradients_of, images_of
from tests.core.render.cuda.comparison import emulated
from tests.core.render.cuda.emulation import EmulatedKernels
from tests.core.render.depth_scenes import ball_before_disc, joined, layers
from tests.core.render.first_principles import IMAGES, TRAINED
from tests.core.render.scenes import (
    coloured,
    front_camera,
    isotropic,
    look_at,
    one_gaussian,
    random_gaussians,
)
from tests.poses import look_at_pose

DIGITS = 60
Judge = Callable[..., Verdict]


@pytest.fixture(params=["cpu", "emulated"])
def judge(request: pytest.FixtureRequest) -> Judge:
    """Return the judge of the processor's kernels, or of the emulated device's (gradients by
    autograd of the definition)."""
    if request.param == "cpu":
        return comparisons.judge
    kernels = EmulatedKernels(request.getfixturevalue("emulator_library"))

    def of_the_device(*given: Any, **more: Any) -> Verdict:
        more = {**more, "gradient_digits": 0, "renderer": emulated(kernels)}
        return comparisons.judge(*given, **more)

    return of_the_device


def of_logit(logit: float) -> OrientedGaussians:
    gaussians = random_gaussians(2, 1, sh_degree=0, spread=0.3, scale=(0.2, 0.5))
    return gaussians.replaced(opacity_logits=torch.full((2,), logit, dtype=torch.float64))


@pytest.mark.parametrize("logit", [80.0, 4.0, -4.0])
def test_item_01_opacity_near_0_and_1(judge: Judge, logit: float) -> None:
    verdict = judge(of_logit(logit), front_camera(5, 4), digits=DIGITS)
    verdict.assert_within(blended=2e-7, depth=1e-6, gradient=1e-5, depth_gradient=2e-5)
    assert (verdict.depth_count >= 3) == (logit > 0)
    # The gradient of a saturated opacity is tiny, not nothing: exp(-80) is 1.8e-35.
    slope = 1.0 / (2.0 + math.exp(logit) + math.exp(-logit))
    assert 0.01 * slope < verdict.sizes["opacity_logits"] < 100.0 * slope


@pytest.mark.parametrize("logit", [-20.0, -80.0])
def test_item_01_vanished_gaussians_leave_no_trace(judge: Judge, logit: float) -> None:
    verdict = judge(of_logit(logit), front_camera(5, 4), digits=DIGITS)
    verdict.assert_within(blended=1e-8)
    assert not verdict.found["alpha"].any()
    assert not any(verdict.sizes.values())


def test_item_01_a_capped_alpha_has_no_gradient(judge: Judge) -> None:
    # Every ray that passes within 0.1 sigma has alpha 0.99.
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0)], [1.0], [1.0 - 1e-7]))
    verdict = judge(gaussians, front_camera(2, 2, focal=200.0), digits=DIGITS)
    verdict.assert_within(blended=2e-7, depth=1e-6)
    assert verdict.sizes["opacity_logits"] == verdict.sizes["log_scales"] == 0.0
    assert verdict.sizes["sh"] > 0.1


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_item_01_log_scales_at_extremes(judge: Judge, side: float) -> None:
    # exp(-30) is far below a pixel; exp(30) is flat over the image. Each has one visible neighbour.
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0), (0.1, 1.0, 0.0)], [1.0, 0.5], [0.6, 0.8]))
    log_scales = gaussians.log_scales.clone()
    log_scales[0] = side * 30.0
    verdict = judge(gaussians.replaced(log_scales=log_scales), front_camera(4, 4), digits=DIGITS)
    verdict.assert_within(blended=3e-7, gradient=1e-5)
    assert verdict.found["alpha"].max() > 0.5


def test_item_01_the_mip_filter_keeps_what_is_smaller_than_itself(judge: Judge) -> None:
    gaussians = one_gaussian((0.3, 0.4, 1e-3), 0.99, (0.02, 0.0, 0.01), 0.4)
    gaussians = gaussians.replaced(filter_3d=torch.full((1,), 0.02).double())
    verdict = judge(gaussians, front_camera(focal=60.0), digits=DIGITS)
    verdict.assert_within(blended=5e-7, gradient=1e-5)
    assert verdict.found["alpha"].max() > 0.02


# A sigma of 1e-4 is 1e-7 and 1e-9 of the depth: float32 depths (column z of the screen rows, the
# solver's t) round to 2^-24 of it, so single layers are not resolved: depths are exact to six
# roundings of the blending, and the gradient of the depth is not.
@pytest.mark.parametrize("distance", [1e3, 1e5])
def test_item_02_tiny_and_far(distance: float) -> None:
    camera = front_camera(focal=1.5e4 * distance, distance=distance)
    verdict = comparisons.judge(layers(1e-4), camera, digits=DIGITS, gradient_digits=0)
    verdict.assert_within(
        blended=1e-6, depth=6 * 2.0**-24, gradient=1e-5, depth_gradient=2.0, depth_count=15
    )


@pytest.mark.parametrize("distance", [1e3, 1e5])
def test_item_02_gradients_of_a_tiny_one_against_sixty_digits(
    judge: Judge, distance: float
) -> None:
    gaussians = one_gaussian((1e-4, 2e-4, 5e-5), 0.9, (2e-5, 1e-4, -1e-5), 0.4)
    camera = front_camera(focal=1.5e4 * distance, distance=distance)
    verdict = judge(gaussians, camera, digits=DIGITS)
    verdict.assert_within(blended=1e-6, depth=3e-7, gradient=2e-5, depth_gradient=2.0)
    assert verdict.depth_count >= 3


# The law: about 2e-7 depth / sigma. 1e-4 holds for every sigma above 1e-3 of the depth.
@pytest.mark.parametrize("depths_per_sigma", [30.0, 1e3, 1e5])
def test_item_02_depth_gradient_follows_sigma_over_depth(
    judge: Judge, depths_per_sigma: float
) -> None:
    distance = 1e-3 * depths_per_sigma
    camera = front_camera(focal=1.5 * depths_per_sigma, distance=distance)
    verdict = judge(layers(1e-3), camera, near_z=1e-3 * distance)
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
def test_item_03_anisotropy_of_a_million(judge: Judge, name: str) -> None:
    scales, turn, axis, focal, blended, gradient, depth_gradient = SHAPES[name]
    gaussians = one_gaussian(scales, 0.9, (0.5 / focal, 0.0, 0.4 / focal), turn, axis)
    if judge is not comparisons.judge and name == "needle across":
        depth_gradient = math.inf
    verdict = judge(gaussians, front_camera(focal=focal), digits=DIGITS)
    verdict.assert_within(
        blended=blended, depth=5e-6, gradient=gradient, depth_gradient=depth_gradient
    )
    assert verdict.found["alpha"].max() > 0.05
    if name == "disc from the front":
        # Far thinner than a float32 step of its depth, it is still moved and turned.
        assert verdict.depth_count >= 4
        assert max(verdict.depth_gradients[one] for one in ("means", "quats")) < 1e-5


@pytest.mark.parametrize("thickness", [1e-2, 1e-4, 1e-6])
def test_item_03_a_thin_disc_leaves_the_surface_before_it_alone(
    judge: Judge, thickness: float
) -> None:
    # Depths and their gradients where the ball is seen; the disc, 1.5 units behind, is hidden.
    gaussians = ball_before_disc(thickness)
    verdict = judge(gaussians, front_camera(12, 10, focal=16.0), nearer_than=4.0)
    verdict.assert_within(blended=1e-6, depth=1e-5, gradient=2e-5, depth_gradient=1e-4)
    assert (verdict.truth.depth[verdict.truth.depth > 0] < 4.0).sum() >= 4


def test_item_05_ten_thousand_nearly_transparent_layers(judge: Judge) -> None:
    # 1500 of them, each of alpha 0.006, until less than 1e-4 of the light is left: the float32
    # product gathers 1500 roundings of 6e-8, and where it passes 1e-4 is a matter of one layer.
    means = [(0.0, y, 0.0) for y in np.linspace(-0.5, 0.5, 10_000)]
    gaussians = coloured(isotropic(means, [1.0] * 10_000, [0.006] * 10_000))
    verdict = judge(gaussians, front_camera(4, 3, focal=60.0), margin=2e-6)
    verdict.assert_within(blended=3e-5, depth=1e-5, gradient=1e-4, depth_gradient=1e-4, clear=0.0)
    assert (verdict.found["depth"] > 0).all()


def test_item_05_two_opaque_layers(judge: Judge) -> None:
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0), (0.0, 1.0, 0.0)], [0.5, 0.5], [0.999, 0.999]))
    verdict = judge(gaussians, front_camera(), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=1e-6, gradient=1e-5, depth_gradient=2e-5)
    assert verdict.depth_count >= 8


def test_item_05_identical_depths_keep_the_order_of_indices(judge: Judge) -> None:
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0)] * 4, [0.5] * 4, [0.5] * 4))
    verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=1e-6, gradient=1e-5, depth_gradient=5e-5)
    turned = gaussians.select(torch.tensor([3, 2, 1, 0]))
    other = judge(turned, front_camera(4, 3), gradients=False)
    other.assert_within(blended=5e-7)
    assert abs(other.found["color"] - verdict.found["color"]).max() > 1e-2


def test_item_05_distances_that_float32_cannot_tell_apart_are_ties(judge: Judge) -> None:
    # 4 + 1e-9 rounds to 4: the farther one is blended first because its index is smaller.
    gaussians = coloured(isotropic([(0.0, 1e-9, 0.0), (0.0, 0.0, 0.0)], [0.5, 0.5], [0.6, 0.7]))
    verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=1e-6, gradient=1e-5, depth_gradient=5e-5)


def few() -> OrientedGaussians:
    return random_gaussians(3, 21, sh_degree=1, spread=0.3, scale=(0.2, 0.5), opacity=(0.5, 0.9))


def test_item_06_a_zero_quaternion_is_the_identity_and_gets_no_gradient(judge: Judge) -> None:
    zero, unit = few(), few()
    zero.quats[1], unit.quats[1] = 0.0, torch.tensor([2.0, 0.0, 0.0, 0.0])
    verdict = judge(zero, front_camera())
    verdict.assert_within(blended=5e-7, gradient=1e-5)
    same = judge(unit, front_camera(), gradients=False)
    for name in IMAGES:
        np.testing.assert_array_equal(same.found[name], verdict.found[name])
    weights = {name: np.ones_like(same.found[name]) for name in IMAGES}
    options = RenderOptions(threads=1)
    found = gradients_of(render, zero, front_camera(), options, weights, torch.float32)
    assert not found["quats"][1].any()


@pytest.mark.parametrize("factor", [1e-8, 1e6, 1e30])
def test_item_06_quaternions_of_any_length(judge: Judge, factor: float) -> None:
    # The images do not change; the gradient falls as 1 / length. 1e30 squared is beyond float32.
    gaussians = few()
    long = gaussians.replaced(quats=gaussians.quats * factor)
    base = judge(gaussians, front_camera(), gradients=False)
    verdict = judge(long, front_camera())
    verdict.assert_within(blended=5e-7, gradient=1e-5, depth_gradient=1e-4)
    for name in IMAGES:
        np.testing.assert_allclose(verdict.found[name], base.found[name], atol=2e-6, err_msg=name)


@pytest.mark.parametrize("length", [0.0, 1e-8, 1e20])
def test_item_06_direction_vectors_of_any_length(judge: Judge, length: float) -> None:
    gaussians = few()
    gaussians.orientation[:, :3] *= length
    verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS, gradients=bool(length))
    verdict.assert_within(blended=5e-7, gradient=1e-5, depth_gradient=1e-4)
    assert verdict.found["normal"].any() == bool(length)
    # Without a direction there is no gradient either.
    options, loss = RenderOptions(threads=1), {"normal": np.ones((3, 4, 3))}
    found = gradients_of(render, gaussians, front_camera(4, 3), options, loss, torch.float32)
    assert any(gradient.any() for gradient in found.values()) == bool(length)


@pytest.mark.parametrize("sign", [20.0, -1e30, 1e-30, 0.0])
def test_item_06_saturated_sign(judge: Judge, sign: float) -> None:
    gaussians = few()
    gaussians.orientation[:, 3] = sign
    verdict = judge(gaussians, front_camera(4, 3))
    verdict.assert_within(blended=5e-7, gradient=1e-5, depth_gradient=1e-4)
    if abs(sign) >= 20.0:
        flipped = gaussians.replaced(orientation=-gaussians.orientation)
        same = judge(flipped, front_camera(4, 3), gradients=False)
        np.testing.assert_array_equal(same.found["normal"], verdict.found["normal"])


def test_item_07_plateau_exactly_at_half() -> None:
    # Zero logits: alpha is 0.5 up to the fall-off over a pixel, so T stays at 0.5 (or rounds to it)
    # for three units between the layers. Any depth on the plateau is right.
    gaussians = isotropic([(0.0, 0.0, 0.0), (0.0, 3.0, 0.0)], [0.05, 0.05], [0.5, 0.9])
    gaussians.opacity_logits[0] = 0.0
    camera = front_camera(2, 2, focal=4e6)
    with torch.no_grad():
        view = images_of(render(gaussians, camera, RenderOptions(threads=1)))
    assert (view["depth"] > 4.0 - 1e-3).all()
    assert (view["depth"] < 7.0 - 0.05).all()
    np.testing.assert_allclose(view["alpha"], 0.95, atol=1e-6)
    weights = {name: np.ones_like(view[name]) for name in IMAGES}
    found = gradients_of(
        render, gaussians, camera, RenderOptions(threads=1), weights, torch.float32
    )
    # The floor of the slope, 1e-3 of 1 / sigma, bounds the depth's gradient.
    for name in TRAINED:
        assert np.isfinite(found[name]).all(), name
        assert abs(found[name]).max() < 1e3, name


@pytest.mark.parametrize("offset", [1e-3, -1e-3])
def test_item_07_plateau_just_beside_half(judge: Judge, offset: float) -> None:
    # T is 0.499 or 0.501 on the plateau: the crossing is in the first or in the second layer.
    gaussians = coloured(
        isotropic([(0.0, 0.0, 0.0), (0.0, 3.0, 0.0)], [0.05, 0.05], [0.5 + offset, 0.9])
    )
    verdict = judge(gaussians, front_camera(2, 2, focal=4e4), digits=DIGITS)
    # 0.06 sigma before the first peak, where the slope is 0.06 / sigma and float32 peaks stand
    # 1e-5 sigma apart.
    verdict.assert_within(
        blended=5e-7, depth=1e-5, gradient=1e-5, depth_gradient=5e-4, depth_count=4
    )
    assert ((verdict.found["depth"] < 4.0) == (offset > 0)).all()


def test_item_07_final_transmittance_between_limit_and_half(judge: Judge) -> None:
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0)], [0.3], [0.53]))
    camera = front_camera(16, 16, focal=30.0)
    strict = judge(gaussians, camera)
    strict.assert_within(blended=5e-7)
    assert not strict.found["depth"].any()
    lenient = judge(gaussians, camera, limit=0.5)
    lenient.assert_within(blended=5e-7, depth=1e-5, depth_count=4)


@pytest.mark.parametrize("opacity", [0.56, 0.989])
def test_item_07_reached_in_the_first_gaussian(judge: Judge, opacity: float) -> None:
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0)], [0.2], [opacity]))
    verdict = judge(gaussians, front_camera(6, 6, focal=2e3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=1e-6, gradient=5e-5, depth_count=36)
    # In closed form; the four pixels in the middle see it within 1.5e-3 of the axis.
    wanted = 4.0 - 0.2 * math.sqrt(2.0 * math.log(2.0 * opacity))
    assert abs(verdict.found["depth"][2:4, 2:4] / wanted - 1.0).max() < 1e-4


def test_item_07_reached_in_the_last_of_many(judge: Judge) -> None:
    # Twenty faint layers let 0.7 through; the last one closes.
    means = [(0.0, 0.1 * k, 0.0) for k in range(21)]
    gaussians = coloured(isotropic(means, [0.03] * 21, [0.0177] * 20 + [0.9]))
    verdict = judge(gaussians, front_camera(4, 4, focal=400.0))
    verdict.assert_within(blended=1e-6, depth=1e-6, gradient=1e-5, depth_count=16)
    assert (verdict.found["depth"] > 5.9).all()


def test_item_07_no_light_reaches_the_camera(judge: Judge) -> None:
    gaussians = coloured(isotropic([(0.0, -3.4, 0.0)] * 3, [2.0] * 3, [0.9] * 3))
    verdict = judge(gaussians, front_camera(), digits=DIGITS, gradient_digits=0)
    verdict.assert_within(blended=5e-7)
    assert verdict.found["alpha"].min() > 0.9
    assert not verdict.found["depth"].any()


def test_item_07_silhouette_ends_at_the_limit(judge: Judge) -> None:
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0)], [0.3], [0.95]))
    camera = look_at((2.0, 0.6, 0.9), width=40, height=40, focal=90.0)
    for limit in (0.1, 0.45, 0.4999):
        verdict = judge(gaussians, camera, limit=limit)
        verdict.assert_within(blended=5e-7, depth=1e-5, depth_count=40)


def test_item_04_camera_inside_gaussians(judge: Judge) -> None:
    gaussians = coloured(
        isotropic(
            [(0.0, -3.4, 0.0), (0.3, -2.0, 0.2), (0.0, 5.0, 0.0)], [1.5, 2.5, 30.0], [0.3, 0.6, 0.7]
        )
    )
    verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=1e-5, gradient=1e-5)
    assert verdict.found["alpha"].min() > 0.8


@pytest.mark.parametrize("scales", [(0.3, 2.0, 0.3), (2.0, 0.3, 2.0), (3.0, 3.0, 0.1)])
def test_item_04_camera_inside_an_anisotropic_one(
    judge: Judge, scales: tuple[float, float, float]
) -> None:
    gaussians = one_gaussian(scales, 0.95, (0.1, -3.5, 0.05), 0.6, 0)
    verdict = judge(gaussians, front_camera(), digits=DIGITS)
    verdict.assert_within(blended=1e-6, depth=2e-5, gradient=1e-5, depth_gradient=1e-3)
    assert verdict.found["alpha"].max() > 0.3


def test_item_04_gaussians_across_the_near_plane(judge: Judge) -> None:
    # Depths 0.3, 0.21 and 0.19 with near 0.2: two are rendered, whole; the third is not at all.
    gaussians = coloured(
        isotropic(
            [(0.1, -3.7, 0.0), (0.0, -3.79, 0.05), (0.0, -3.81, 0.0)],
            [0.3, 0.1, 0.3],
            [0.5, 0.7, 0.9],
        )
    )
    verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=2e-5, gradient=1e-5, depth_gradient=1e-3)
    alone = judge(gaussians.select(torch.tensor([0, 1])), front_camera(4, 3), gradients=False)
    for name in IMAGES:
        np.testing.assert_array_equal(alone.found[name], verdict.found[name])


def test_item_04_a_peak_behind_the_camera_of_a_slanted_ray(judge: Judge) -> None:
    # Centre in front of the near plane, maximum along the outer rays at negative depth.
    slanted = one_gaussian((3.0, 3.0, 0.05), 0.9, (0.0, -3.6, 0.3), 0.9, 0)
    gaussians = joined(slanted, coloured(isotropic([(0.0, 0.0, 0.0)], [1.0], [0.9]), 3))
    verdict = judge(gaussians, front_camera(6, 5, focal=3.0), digits=DIGITS, gradient_digits=0)
    verdict.assert_within(blended=2e-6, depth=2e-5, gradient=5e-5, depth_gradient=1e-3)
    assert verdict.found["alpha"].max() > 0.5


def test_item_04_larger_than_the_scene(judge: Judge) -> None:
    gaussians = coloured(
        isotropic([(0.0, 3.0, 0.0), (20.0, 400.0, 30.0)], [50.0, 500.0], [0.3, 0.9])
    )
    verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, gradient=1e-5)
    assert verdict.found["alpha"].min() > 0.85


def cloud(count: int = 40, spread: float = 0.8) -> OrientedGaussians:
    return random_gaussians(count, 17, spread=spread, opacity=(0.3, 0.97))


@pytest.mark.parametrize(("width", "height"), [(1, 1), (37, 1), (1, 23), (16, 16), (33, 47)])
def test_item_12_any_image_size(judge: Judge, width: int, height: int) -> None:
    camera = look_at((2.2, 1.0, 0.8), width=width, height=height, focal=20.0)
    verdict = judge(cloud(), camera)
    verdict.assert_within(blended=1e-6, depth=1e-5)
    assert verdict.found["alpha"].max() > 0.5


@pytest.mark.parametrize(("cx", "cy"), [(-400.0, 300.0), (-4000.0, 30.0), (60.0, 5e4)])
def test_item_12_principal_point_far_off_the_image(judge: Judge, cx: float, cy: float) -> None:
    # The camera looks past the scene; the image is a crop far from its axis.
    focal = 2000.0
    direction = np.array([(12.0 - cx) / focal, (10.0 - cy) / focal, 1.0])
    pose = look_at_pose((3.0, 0.5, 0.4))
    forward = pose[:, :3].T @ (direction / np.linalg.norm(direction))
    # Move the eye so that the oblique ray through the image's centre meets the origin.
    eye = -3.0 * forward
    pose = np.concatenate([pose[:, :3], -(pose[:, :3] @ eye)[:, None]], 1)
    near = 0.02
    camera = Camera("shifted", 24, 20, focal, focal, cx, cy, pose)
    gaussians = random_gaussians(30, 5, spread=0.02, scale=(0.002, 0.01), opacity=(0.3, 0.97))
    gaussians = gaussians.replaced(filter_3d=torch.zeros(30).double())
    verdict = judge(gaussians, camera, near_z=near)
    verdict.assert_within(blended=1e-5, depth=1e-5, gradient=1e-4, depth_gradient=2e-3)
    assert verdict.found["alpha"].max() > 0.5
    assert verdict.depth_count > 20


def test_item_12_120_degrees_wide(judge: Judge) -> None:
    focal = 18.5 / math.tan(math.radians(60.0))
    camera = replace(front_camera(37, 21, distance=1.0), fx=focal, fy=focal)
    verdict = judge(cloud(60, 3.0), camera)
    verdict.assert_within(blended=3e-6, depth=1e-5, depth_count=5)


def test_item_12_very_different_focal_lengths(judge: Judge) -> None:
    camera = replace(look_at((2.2, 1.0, 0.8), width=40, height=30, focal=30.0), fy=300.0)
    verdict = judge(cloud(), camera)
    verdict.assert_within(blended=3e-6, depth=1e-5)


@pytest.mark.parametrize("eye", [(0.0, 0.0, 3.0), (0.0, 0.0, -3.0), (3.0, 0.0, 0.0)])
def test_item_12_along_the_axes_of_the_harmonics(
    judge: Judge, eye: tuple[float, float, float]
) -> None:
    # Directions at the poles of the harmonics, exactly: their gradient has no seam there.
    means = [(0.0, 0.0, 0.0), (0.2, 0.0, 0.1)]
    gaussians = isotropic(means, [0.3, 0.4], [0.7, 0.8])
    random = np.random.default_rng(8)
    gaussians = gaussians.replaced(sh=torch.from_numpy(random.normal(size=(2, 16, 3)) * 0.2))
    verdict = judge(gaussians, look_at(eye, width=6, height=5, focal=12.0))
    verdict.assert_within(blended=5e-7, depth=1e-5)

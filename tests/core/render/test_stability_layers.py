# SPDX-License-Identifier: GPL-3.0-or-later
"""Hard cases 5 to 7 of the kernels: many layers and ties, degenerate parameters, plateaus of T."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.reference import render_reference
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions

from .comparisons import gradients_of, images_of, judge, relative_l2
from .first_principles import IMAGES, TRAINED
from .scenes import coloured, front_camera, isotropic, look_at, random_gaussians

DIGITS = 60


# -- item 5: layers -------------------------------------------------------------------------------


def ten_thousand_layers(opacity: float) -> OrientedGaussians:
    positions = np.linspace(-0.5, 0.5, 10_000)
    return coloured(
        isotropic([(0.0, y, 0.0) for y in positions], [1.0] * 10_000, [opacity] * 10_000)
    )


def test_item_05_ten_thousand_nearly_transparent_layers() -> None:
    # 1500 of them, each of alpha 0.006, until less than 1e-4 of the light is left: the float32
    # product gathers 1500 roundings of 6e-8, and where it passes 1e-4 is a matter of one layer.
    verdict = judge(ten_thousand_layers(0.006), front_camera(4, 3, focal=60.0), margin=2e-6)
    verdict.assert_within(blended=3e-5, depth=1e-5, gradient=1e-4, depth_gradient=1e-4, clear=0.0)
    assert (verdict.found["depth"] > 0).all()


def test_item_05_ten_thousand_layers_below_the_threshold_are_nothing() -> None:
    verdict = judge(ten_thousand_layers(0.0039), front_camera(4, 3, focal=60.0), gradients=False)
    assert not verdict.found["alpha"].any()
    verdict.assert_within()


def test_item_05_two_opaque_layers() -> None:
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0), (0.0, 1.0, 0.0)], [0.5, 0.5], [0.999, 0.999]))
    verdict = judge(gaussians, front_camera(), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=1e-6, gradient=1e-5, depth_gradient=2e-5)
    assert verdict.depth_count >= 8


def test_item_05_identical_depths_keep_the_order_of_indices() -> None:
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0)] * 4, [0.5] * 4, [0.5] * 4))
    verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=1e-6, gradient=1e-5, depth_gradient=5e-5)
    turned = gaussians.select(torch.tensor([3, 2, 1, 0]))
    other = judge(turned, front_camera(4, 3), gradients=False)
    other.assert_within(blended=5e-7)
    assert abs(other.found["color"] - verdict.found["color"]).max() > 1e-2


def test_item_05_distances_that_float32_cannot_tell_apart_are_ties() -> None:
    # 4 + 1e-9 rounds to 4: the farther one is blended first because its index is smaller.
    gaussians = coloured(isotropic([(0.0, 1e-9, 0.0), (0.0, 0.0, 0.0)], [0.5, 0.5], [0.6, 0.7]))
    verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=1e-6, gradient=1e-5, depth_gradient=5e-5)


# -- item 6: degenerate parameters -----------------------------------------------------------------


def few() -> OrientedGaussians:
    return random_gaussians(3, 21, sh_degree=1, spread=0.3, scale=(0.2, 0.5), opacity=(0.5, 0.9))


def test_item_06_a_zero_quaternion_is_the_identity_and_gets_no_gradient() -> None:
    gaussians = few()
    quats = gaussians.quats.clone()
    quats[1] = 0.0
    verdict = judge(gaussians.replaced(quats=quats), front_camera(), gradients=False)
    verdict.assert_within(blended=5e-7)
    quats[1] = torch.tensor([2.0, 0.0, 0.0, 0.0])
    same = judge(gaussians.replaced(quats=quats), front_camera(), gradients=False)
    for name in IMAGES:
        np.testing.assert_array_equal(same.found[name], verdict.found[name])
    quats[1] = 0.0
    weights = {name: np.ones_like(same.found[name]) for name in IMAGES}
    options = RenderOptions(threads=1)
    some = gaussians.replaced(quats=quats)
    fast = gradients_of(render, some, front_camera(), options, weights, torch.float32)
    exact = gradients_of(render_reference, some, front_camera(), options, weights, torch.float64)
    assert not fast["quats"][1].any()
    for name in TRAINED:
        assert relative_l2(fast[name], exact[name]) < 1e-5, name


@pytest.mark.parametrize("factor", [1e-8, 1e-3, 1e6, 1e18, 1e30])
def test_item_06_quaternions_of_any_length(factor: float) -> None:
    # The images do not change; the gradient falls as 1 / length. 1e30 squared is beyond float32.
    gaussians = few()
    long = gaussians.replaced(quats=gaussians.quats * factor)
    base = judge(gaussians, front_camera(), gradients=False)
    verdict = judge(long, front_camera())
    verdict.assert_within(blended=5e-7, gradient=1e-5, depth_gradient=1e-4)
    for name in IMAGES:
        np.testing.assert_allclose(verdict.found[name], base.found[name], atol=2e-6, err_msg=name)


@pytest.mark.parametrize("length", [0.0, 1e-8, 1e20])
def test_item_06_direction_vectors_of_any_length(length: float) -> None:
    gaussians = few()
    orientation = gaussians.orientation.clone()
    orientation[:, :3] *= length
    gaussians = gaussians.replaced(orientation=orientation)
    if length:
        verdict = judge(gaussians, front_camera(4, 3), digits=DIGITS)
        verdict.assert_within(blended=5e-7, gradient=1e-5, depth_gradient=1e-4)
        return
    verdict = judge(gaussians, front_camera(4, 3), gradients=False)
    assert not verdict.found["normal"].any()
    weights = {"normal": np.ones((3, 4, 3))}
    options = RenderOptions(threads=1)
    found = gradients_of(render, gaussians, front_camera(4, 3), options, weights, torch.float32)
    for name in TRAINED:
        assert not found[name].any(), name


@pytest.mark.parametrize("sign", [20.0, -20.0, 100.0, -1e30, 1e-30, 0.0])
def test_item_06_saturated_sign(sign: float) -> None:
    gaussians = few()
    orientation = gaussians.orientation.clone()
    orientation[:, 3] = sign
    gaussians = gaussians.replaced(orientation=orientation)
    verdict = judge(gaussians, front_camera(4, 3))
    verdict.assert_within(blended=5e-7, gradient=1e-5, depth_gradient=1e-4)
    if abs(sign) >= 20.0:
        flipped = orientation * torch.tensor([-1.0, -1.0, -1.0, -1.0]).double()
        same = judge(gaussians.replaced(orientation=flipped), front_camera(4, 3), gradients=False)
        np.testing.assert_array_equal(same.found["normal"], verdict.found["normal"])


# -- item 7: plateaus and limits of T --------------------------------------------------------------


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
def test_item_07_plateau_just_beside_half(offset: float) -> None:
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


def test_item_07_final_transmittance_between_limit_and_half() -> None:
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0)], [0.3], [0.53]))
    camera = front_camera(16, 16, focal=30.0)
    strict = judge(gaussians, camera)
    strict.assert_within(blended=5e-7)
    assert not strict.found["depth"].any()
    lenient = judge(gaussians, camera, limit=0.5)
    lenient.assert_within(blended=5e-7, depth=1e-5, depth_count=4)


def test_item_07_never_reaching_half() -> None:
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0), (0.0, 0.1, 0.0)], [0.3, 0.2], [0.28, 0.3]))
    verdict = judge(gaussians, front_camera(16, 16, focal=30.0), limit=1.0)
    verdict.assert_within(blended=5e-7)
    assert 0.45 < verdict.found["alpha"].max() < 0.5
    assert not verdict.found["depth"].any()


@pytest.mark.parametrize("opacity", [0.56, 0.8, 0.95, 0.989])
def test_item_07_reached_in_the_first_gaussian(opacity: float) -> None:
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0)], [0.2], [opacity]))
    verdict = judge(gaussians, front_camera(6, 6, focal=2e3), digits=DIGITS)
    verdict.assert_within(blended=5e-7, depth=1e-6, gradient=5e-5, depth_count=36)
    # In closed form; the four pixels in the middle see it within 1.5e-3 of the axis.
    wanted = 4.0 - 0.2 * math.sqrt(2.0 * math.log(2.0 * opacity))
    assert abs(verdict.found["depth"][2:4, 2:4] / wanted - 1.0).max() < 1e-4


def test_item_07_reached_in_the_last_of_many() -> None:
    # Twenty faint layers let 0.7 through; the last one closes.
    means = [(0.0, 0.1 * k, 0.0) for k in range(21)]
    gaussians = coloured(isotropic(means, [0.03] * 21, [0.0177] * 20 + [0.9]))
    verdict = judge(gaussians, front_camera(4, 4, focal=400.0))
    verdict.assert_within(blended=1e-6, depth=1e-6, gradient=1e-5, depth_count=16)
    assert (verdict.found["depth"] > 5.9).all()


def test_item_07_no_light_reaches_the_camera() -> None:
    gaussians = coloured(isotropic([(0.0, -3.4, 0.0)] * 3, [2.0] * 3, [0.9] * 3))
    verdict = judge(gaussians, front_camera(), digits=DIGITS, gradient_digits=0)
    verdict.assert_within(blended=5e-7)
    assert verdict.found["alpha"].min() > 0.9
    assert not verdict.found["depth"].any()


def test_item_07_silhouette_ends_at_the_limit() -> None:
    gaussians = coloured(isotropic([(0.0, 0.0, 0.0)], [0.3], [0.95]))
    for limit in (0.1, 0.3, 0.45, 0.4999):
        verdict = judge(
            gaussians, look_at((2.0, 0.6, 0.9), width=40, height=40, focal=90.0), limit=limit
        )
        verdict.assert_within(blended=5e-7, depth=1e-5, depth_count=40)

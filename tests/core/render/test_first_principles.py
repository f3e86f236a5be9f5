# SPDX-License-Identifier: GPL-3.0-or-later
"""The definition renderer equals first principles: every image, and gradients of every parameter.

Values against covariances, means and rays; gradients by ``gradcheck`` and against differences in
60-digit arithmetic.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.reference import reference_projection, render_reference
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.comparisons import gradients_of, images_of, random_weights, relative_l2
from tests.core.render.first_principles import IMAGES, TRAINED, FirstPrinciples, Truth
from tests.core.render.scenes import front_camera, look_at, one_gaussian, random_gaussians

BACKGROUND = (0.3, 0.1, 0.2)


def images(
    gaussians: OrientedGaussians, camera: Camera, **options: object
) -> dict[str, np.ndarray]:
    with torch.no_grad():
        return images_of(render_reference(gaussians, camera, RenderOptions(**options)))  # type: ignore[arg-type]


def assert_same(
    gaussians: OrientedGaussians, camera: Camera, tolerance: float, digits: int = 0
) -> Truth:
    """Compare every image; depths relatively."""
    truth = FirstPrinciples(gaussians, camera, background=BACKGROUND, digits=digits).images()
    assert truth.margin.min() > 1e-7
    found = images(gaussians, camera, background=BACKGROUND)
    for name in IMAGES[:4]:
        error = abs(found[name] - truth.image(name).astype(np.float64)).max()
        assert error <= tolerance, (name, error)
    depth = truth.depth.astype(np.float64)
    sure = truth.limit_margin > 1e-7
    np.testing.assert_array_equal(found["depth"][sure] > 0, depth[sure] > 0)
    assert (abs(found["depth"] - depth)[sure] <= 10 * tolerance * depth[sure]).all()
    return truth


@pytest.mark.parametrize(
    ("seed", "degree", "eye"),
    [
        (0, 0, (2.0, 0.6, 0.9)),
        (1, 3, (-0.4, -2.5, 0.7)),
        (2, 2, (0.6, 0.5, -0.2)),
        (3, 1, (0.02, 0.01, 2.2)),
    ],
)
def test_every_image_of_generic_scenes(
    seed: int, degree: int, eye: tuple[float, float, float]
) -> None:
    gaussians = random_gaussians(40, seed, sh_degree=degree, opacity=(0.05, 0.999))
    truth = assert_same(gaussians, look_at(eye, width=17, height=13, focal=19.0), 1e-13)
    assert (truth.depth > 0).mean() > 0.2


@pytest.mark.parametrize("seed", [0, 1])
def test_numpy_and_sixty_digits_agree(seed: int) -> None:
    gaussians = random_gaussians(5, seed, sh_degree=3, scale=(0.2, 0.5), opacity=(0.3, 0.9))
    camera = look_at((2.0, 0.6, 0.9), width=4, height=3, focal=7.0)
    wide = FirstPrinciples(gaussians, camera, digits=60).images()
    plain = FirstPrinciples(gaussians, camera).images()
    for name in (*IMAGES, "slope", "sharpest"):
        error = abs(plain.image(name) - wide.image(name).astype(np.float64)).max()
        assert error < 1e-13 * (1.0 + abs(plain.image(name)).max()), name


# Scales, turn and focal length; what is 1e6 times as long as wide rounds to 1e-10.
SHAPES = [
    ((1e-6, 0.5, 0.5), 0.0, 4e6),
    ((1e-6, 0.5, 0.5), 0.02, 1e3),
    ((1e-6, 1.0, 1e-6), 0.0, 4e6),
    ((0.1, 1e5, 0.1), 0.3, 10.0),
    ((0.1, 1e5, 1e5), 0.3, 10.0),
    ((0.5, 5e-7, 0.5), 0.3, 10.0),
]


@pytest.mark.parametrize(("scales", "turn", "focal"), SHAPES)
@pytest.mark.parametrize("axis", [0, 2])
def test_extreme_shapes_against_sixty_digits(
    scales: tuple[float, float, float], turn: float, focal: float, axis: int
) -> None:
    gaussians = one_gaussian(scales, 0.9, (0.5 / focal, 0.0, 0.4 / focal), turn, axis)
    assert_same(gaussians, front_camera(focal=focal), 1e-9, digits=60)


@pytest.mark.parametrize("distance", [1e3, 1e5])
def test_tiny_and_far_against_sixty_digits(distance: float) -> None:
    gaussians = random_gaussians(
        3, 5, sh_degree=0, spread=2e-4, scale=(5e-5, 2e-4), filter_size=0.0
    )
    camera = front_camera(focal=1.5e4 * distance, distance=distance)
    # A mean of 1e5 is known to 1.5e-11, which is 3e-7 of a sigma.
    assert_same(gaussians, camera, 1e-15 * distance / 5e-5)


# -- gradients ------------------------------------------------------------------------------------

SMALL = look_at((2.6, 0.4, 0.5), width=3, height=2, focal=9.0)
OPTIONS = RenderOptions(background=BACKGROUND)


def smooth_scene() -> OrientedGaussians:
    """Four Gaussians that all reach every pixel, far from every threshold."""
    gaussians = random_gaussians(
        4, 11, sh_degree=1, spread=0.25, scale=(0.35, 0.7), opacity=(0.5, 0.9), filter_size=0.05
    )
    truth = FirstPrinciples(gaussians, SMALL).images()
    assert truth.margin.min() > 0.05
    assert truth.kink.min() > 1e-3
    assert truth.limit_margin.min() > 0.02
    assert (truth.depth > 0).all()
    return gaussians


@pytest.mark.parametrize("name", TRAINED)
def test_gradcheck_of_every_image(name: str) -> None:
    gaussians = smooth_scene()

    def every_image(value: Tensor) -> tuple[Tensor, ...]:
        view = render_reference(gaussians.replaced(**{name: value}), SMALL, OPTIONS)
        return tuple(getattr(view, image) for image in IMAGES)

    value = getattr(gaussians, name).clone().requires_grad_()
    assert torch.autograd.gradcheck(
        every_image, (value,), eps=1e-6, atol=1e-7, rtol=1e-5, fast_mode=False
    )


@pytest.mark.parametrize("name", TRAINED)
def test_gradcheck_of_projection_columns(name: str) -> None:
    gaussians = random_gaussians(3, 8, sh_degree=3)
    scale = reference_projection(gaussians, SMALL, OPTIONS).params.abs().amax(0) + 1e-3

    def columns(value: Tensor) -> Tensor:
        screen = reference_projection(gaussians.replaced(**{name: value}), SMALL, OPTIONS)
        return screen.params / scale

    value = getattr(gaussians, name).clone().requires_grad_()
    assert torch.autograd.gradcheck(
        columns, (value,), eps=1e-6, atol=1e-7, rtol=1e-5, fast_mode=False
    )


# Which images depend on which parameters at all.
DEPENDENT = {
    "means": IMAGES,
    "log_scales": IMAGES,
    "quats": IMAGES,
    "opacity_logits": IMAGES,
    "sh": ("color",),
    "orientation": ("normal",),
}


@functools.cache
def three_gaussians() -> tuple[OrientedGaussians, Camera, list[dict], list[dict]]:
    """A scene, a loss for each image, and its gradients in 60-digit arithmetic."""
    gaussians = random_gaussians(
        3, 4, sh_degree=1, spread=0.3, scale=(0.2, 0.5), opacity=(0.5, 0.97)
    )
    camera = look_at((2.3, 0.4, 0.5), width=3, height=2, focal=5.0)
    oracle = FirstPrinciples(gaussians, camera, background=BACKGROUND, digits=60)
    truth = oracle.images()
    assert (truth.depth > 0).sum() >= 3
    losses = [{name: weight} for name, weight in random_weights(truth, margin=1e-3).items()]
    return gaussians, camera, losses, oracle.gradients(losses)


@pytest.mark.parametrize("image", IMAGES)
def test_gradients_against_sixty_digits(image: str) -> None:
    gaussians, camera, losses, truths = three_gaussians()
    loss, wanted = losses[IMAGES.index(image)], truths[IMAGES.index(image)]
    found = gradients_of(render_reference, gaussians, camera, OPTIONS, loss, torch.float64)
    for name in TRAINED:
        if image in DEPENDENT[name]:
            assert np.linalg.norm(wanted[name]) > 1e-3, name
            assert relative_l2(found[name], wanted[name]) < 1e-12, name
        else:
            assert not wanted[name].any(), name
            assert not found[name].any(), name


@pytest.mark.parametrize(("scales", "turn", "focal"), SHAPES)
def test_gradients_of_extreme_shapes(
    scales: tuple[float, float, float], turn: float, focal: float
) -> None:
    gaussians = one_gaussian(scales, 0.9, (0.5 / focal, 0.0, 0.4 / focal), turn, 2)
    camera = front_camera(focal=focal)
    oracle = FirstPrinciples(gaussians, camera, background=BACKGROUND, digits=60)
    weights = random_weights(oracle.images(), margin=1e-4)
    (wanted,) = oracle.gradients([weights])
    found = gradients_of(render_reference, gaussians, camera, OPTIONS, weights, torch.float64)
    whole = float(np.linalg.norm([np.linalg.norm(value) for value in wanted.values()]))
    for name in TRAINED:
        assert relative_l2(found[name], wanted[name], whole) < 1e-8, name


def test_filter_gets_no_gradient_and_gradients_stay_finite_off_screen() -> None:
    gaussians = random_gaussians(20, 3)
    quats = gaussians.quats.clone()
    quats[0] = 0.0
    means = gaussians.means.clone()
    means[1] = torch.tensor([5.0, 0.0, 0.0])  # behind the camera
    gaussians = gaussians.replaced(quats=quats, means=means)
    camera = look_at((2.0, 0.1, 0.2))
    weights = {name: np.ones((30, 40, 3) if name in IMAGES[:3] else (30, 40)) for name in IMAGES}
    found = gradients_of(render_reference, gaussians, camera, OPTIONS, weights, torch.float64)
    for name in TRAINED:
        assert np.isfinite(found[name]).all(), name
        assert not found[name][1].any(), name
        assert found[name].any(), name
    assert not found["quats"][0].any()


# -- options --------------------------------------------------------------------------------------


def test_depth_validity_follows_the_option() -> None:
    gaussians = random_gaussians(25, 5, opacity=(0.3, 0.9))
    camera = look_at((2.4, 0.2, 0.4), width=16, height=12, focal=20.0)
    alpha = images(gaussians, camera)["alpha"]
    strict = images(gaussians, camera, depth_valid_transmittance=0.2)["depth"]
    loose = images(gaussians, camera, depth_valid_transmittance=0.9)["depth"]
    np.testing.assert_array_equal(strict > 0, alpha >= 0.8)
    np.testing.assert_array_equal(loose > 0, alpha > 0.5)
    assert (loose > 0).sum() > (strict > 0).sum() > 0
    np.testing.assert_array_equal(strict[strict > 0], loose[strict > 0])
    assert not images(gaussians, camera, depth=False)["depth"].any()


def test_background_fills_what_is_left() -> None:
    gaussians = random_gaussians(10, 3)
    camera = look_at((2.4, 0.2, 0.4), width=16, height=12, focal=20.0)
    black = images(gaussians, camera)
    bright = images(gaussians, camera, background=(1.0, 0.25, 0.5))
    left = 1.0 - black["alpha"][..., None]
    np.testing.assert_allclose(
        bright["color"], black["color"] + left * [1.0, 0.25, 0.5], atol=1e-14
    )
    for name in IMAGES[1:]:
        np.testing.assert_array_equal(bright[name], black[name])


def test_chunks_and_order_of_storage_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians = random_gaussians(30, 4)
    camera = look_at((2.4, 0.2, 0.4), width=11, height=9, focal=13.0)
    whole = images(gaussians, camera)
    shuffled = images(gaussians.select(torch.randperm(30, generator=torch.manual_seed(0))), camera)
    monkeypatch.setattr("gaussian_wrapping_addon.core.render.reference._ELEMENTS_PER_CHUNK", 1000)
    chunked = images(gaussians, camera)
    for name in IMAGES:
        np.testing.assert_allclose(shuffled[name], whole[name], atol=1e-13)
        np.testing.assert_allclose(chunked[name], whole[name], atol=1e-13)


def test_empty_scene_is_the_background() -> None:
    view = images(random_gaussians(0), look_at((2.0, 0.0, 0.0)), background=BACKGROUND)
    np.testing.assert_array_equal(view["color"], np.broadcast_to(BACKGROUND, (30, 40, 3)))
    for name in IMAGES[1:]:
        assert not view[name].any()


def test_scale_invariance() -> None:
    gaussians = random_gaussians(30, 2, opacity=(0.3, 0.95))
    camera = look_at((-0.3, -2.2, 1.4), width=20, height=15, focal=22.0)
    view = images(gaussians, camera)
    for factor in (1e3, 1e-3):
        bigger = gaussians.replaced(
            means=gaussians.means * factor,
            log_scales=gaussians.log_scales + math.log(factor),
            filter_3d=gaussians.filter_3d * factor,
        )
        pose = camera.cam_from_world * [1.0, 1.0, 1.0, factor]
        scaled = images(bigger, replace(camera, cam_from_world=pose), near_z=0.2 * factor)
        np.testing.assert_allclose(scaled["color"], view["color"], atol=1e-10)
        np.testing.assert_allclose(scaled["depth"] / factor, view["depth"], atol=1e-9)


def test_statistics_are_refused() -> None:
    with pytest.raises(UsageError, match="statistics"):
        render_reference(
            random_gaussians(3), look_at((2.0, 0.0, 0.0)), RenderOptions(statistics=True)
        )

# SPDX-License-Identifier: GPL-3.0-or-later
"""The definition renderer equals first principles: every image, and gradients of every parameter.

Values against covariances, means and rays; gradients by ``gradcheck`` and against differences in
60-digit arithmetic.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.reference import render_reference
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


OPTIONS = RenderOptions(background=BACKGROUND)


# Which images depend on which parameters at all; others on all.
DEPENDENT = {"sh": ("color",), "orientation": ("normal",)}


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
        if image in DEPENDENT.get(name, IMAGES):
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

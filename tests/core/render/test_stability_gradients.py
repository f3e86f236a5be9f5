# SPDX-License-Identifier: GPL-3.0-or-later
"""Hard case 13 of the kernels: every image's gradient to every parameter.

Bounds are L2-relative per parameter group. The loss over the depth weighs each pixel by its slope
of log T (``comparisons.random_weights``).
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection import (
    RawArrays,
    RawGradients,
    project_backward,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.reference import reference_projection, render_reference
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera

from .comparisons import (
    gradients_of,
    judge,
    narrowed,
    random_weights,
    relative_l2,
)
from .first_principles import IMAGES, TRAINED, FirstPrinciples
from .scenes import look_at, random_gaussians

DEPENDENT = {"sh": ("color",), "orientation": ("normal",)}


def generic(count: int = 120, seed: int = 31, **options: object) -> OrientedGaussians:
    return narrowed(random_gaussians(count, seed, **{"opacity": (0.1, 0.97), **options}))  # type: ignore[arg-type]


@functools.cache
def generic_view() -> tuple[OrientedGaussians, Camera, dict[str, np.ndarray]]:
    gaussians = generic(sh_degree=3)
    camera = look_at((2.2, 1.0, 0.8), width=33, height=21, focal=36.0)
    truth = FirstPrinciples(gaussians, camera).images()
    assert (truth.depth > 0).mean() > 0.3
    return gaussians, camera, random_weights(truth, margin=1e-4)


@pytest.mark.parametrize("image", IMAGES)
def test_item_13_each_image_to_each_parameter(image: str) -> None:
    gaussians, camera, weights = generic_view()
    loss = {image: weights[image]}
    options = RenderOptions(threads=2)
    fast = gradients_of(render, gaussians, camera, options, loss, torch.float32)
    exact = gradients_of(render_reference, gaussians, camera, options, loss, torch.float64)
    for name in TRAINED:
        if image in DEPENDENT.get(name, IMAGES):
            error = relative_l2(fast[name], exact[name])
            assert error < (5e-5 if image == "depth" else 5e-6), (name, error)
        else:
            assert not exact[name].any(), name
            assert not fast[name].any(), name


view = functools.partial(look_at, width=28, height=21, focal=32.0)
# Name: Gaussians, camera, bounds of the gradient of images and of depth. The last column is loose
# where float32 depths resolve sigma poorly, see test_stability_opacity_and_shape.py.
SCENES = {
    "generic": (lambda: generic(), view((2.2, 1.0, 0.8)), 5e-6, 5e-5),
    "from within": (lambda: generic(200, 1), view((0.1, 0.2, 0.0), (1.0, 0.3, 0.2)), 1e-5, 1e-4),
    "many small": (
        lambda: generic(400, 3, scale=(0.004, 0.02), filter_size=0.004),
        view((1.6, 0.6, 0.5), focal=50.0),
        1e-4,
        1e-3,
    ),
    "large and dense": (
        lambda: generic(60, 5, scale=(0.3, 1.5), opacity=(0.6, 0.999)),
        view((2.2, 1.0, 0.8)),
        1e-5,
        1e-4,
    ),
    "faint": (lambda: generic(400, 7, opacity=(0.01, 0.08)), view((2.2, 1.0, 0.8)), 1e-5, 1e-4),
    "flat discs": (
        lambda: generic(150, 9, scale=(0.002, 0.4), filter_size=0.001),
        view((2.2, 1.0, 0.8)),
        1e-4,
        1e-3,
    ),
    "opaque": (
        lambda: generic(80, 11, opacity=(0.98, 0.99999)),
        view((2.2, 1.0, 0.8)),
        1e-5,
        1e-4,
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_item_13_hard_scenes(name: str) -> None:
    make, camera, gradient, depth_gradient = SCENES[name]
    verdict = judge(make(), camera)
    verdict.assert_within(
        blended=2e-5, depth=1e-4, gradient=gradient, depth_gradient=depth_gradient, clear=0.97
    )
    assert verdict.found["alpha"].max() > 0.5


@pytest.mark.parametrize("name", TRAINED)
def test_item_13_analytic_projection_in_float64(name: str) -> None:
    """The hand-written backward of the projection against central differences of its forward."""
    gaussians = random_gaussians(4, 8, sh_degree=3)
    camera = look_at((2.0, 0.6, 0.9))
    options = RenderOptions(threads=1)
    random = np.random.default_rng(2)
    arrays = RawArrays.from_gaussians(gaussians)
    screen = project_gaussians(arrays, camera, options)
    assert screen.visible.all()
    weights = random.normal(size=screen.params.shape) / (abs(screen.params).max(0) + 1e-3)
    weights[:, 23] = 0.0
    found = RawGradients.zeros(arrays)
    project_backward(arrays, camera, options, screen, weights, found)
    values = getattr(gaussians, name)
    wanted = np.zeros(values.shape)
    step = 1e-6
    for at in np.ndindex(*values.shape):
        sums = []
        for side in (step, -step):
            moved = values.clone()
            moved[at] += side
            # The forward pass writes float32: torch's projection is its float64 form.
            wide = reference_projection(gaussians.replaced(**{name: moved}), camera, options)
            sums.append(float((wide.params.numpy() * weights).sum()))
        wanted[at] = (sums[0] - sums[1]) / (2.0 * step)
    assert relative_l2(getattr(found, name), wanted) < 1e-7


def test_gradients_add_up_over_images() -> None:
    gaussians, camera, weights = generic_view()
    options = RenderOptions(threads=1)
    whole = gradients_of(render, gaussians, camera, options, weights, torch.float32)
    parts = [
        gradients_of(render, gaussians, camera, options, {image: weights[image]}, torch.float32)
        for image in IMAGES
    ]
    for name in TRAINED:
        total = np.sum([part[name] for part in parts], axis=0)
        assert relative_l2(total, whole[name]) < 5e-6, name

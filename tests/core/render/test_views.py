# SPDX-License-Identifier: GPL-3.0-or-later
"""Views without autograd are bitwise equal to render(), in reused memory."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import TRAINED, OrientedGaussians
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import (
    ImageGradients,
    RenderOptions,
    RenderStatistics,
    VisibleGradients,
)
from gaussian_wrapping_addon.core.render.view_renderer import ViewPass, ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.comparisons import leaves
from tests.core.render.scenes import isotropic, look_at, random_gaussians

IMAGES = ("color", "normal", "geometric_normal", "alpha", "depth")
CAMERA = look_at((2.2, 1.0, 0.8), width=41, height=35)


def scene(count: int = 120, seed: int = 3) -> OrientedGaussians:
    """Return Gaussians of which some are off the image and some behind the camera."""
    return random_gaussians(count, seed, dtype=torch.float32, spread=2.5, scale=(0.02, 0.3))


def image_gradients(camera: Camera, seed: int = 7) -> ImageGradients:
    """Return random gradients of all images."""
    random = np.random.default_rng(seed)
    one = (camera.height, camera.width)
    shapes = [(*one, 3)] * 3 + [one] * 2
    return ImageGradients(*(random.normal(size=s).astype(np.float32) for s in shapes))


def copied(view: ViewPass, gradients: VisibleGradients) -> dict[str, np.ndarray]:
    """Return copies of everything that a view gives."""
    arrays = {name: getattr(view, name) for name in IMAGES}
    arrays |= {f"grad {name}": getattr(gradients, name) for name in ("ids", *TRAINED)}
    if view.statistics is not None:
        for item in dataclasses.fields(RenderStatistics):
            value = getattr(view.statistics, item.name)
            if value is not None:
                arrays[item.name] = value
    return {name: array.copy() for name, array in arrays.items()}


def run(
    renderer: ViewRenderer,
    gaussians: OrientedGaussians,
    camera: Camera = CAMERA,
    **options: object,
) -> dict[str, np.ndarray]:
    """Render and take the gradient; return copies of everything."""
    chosen = RenderOptions(**options)  # type: ignore[arg-type]
    view = renderer.render(RawArrays.from_gaussians(gaussians), camera, chosen)
    return copied(view, view.backward(image_gradients(camera)))


def assert_equal(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    """Require the same arrays, bit for bit."""
    assert one.keys() == other.keys()
    for name in one:
        assert one[name].dtype == other[name].dtype, name
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


@pytest.mark.parametrize("depth", [False, True])
def test_the_same_as_with_autograd(depth: bool) -> None:
    gaussians = scene()
    direct = run(ViewRenderer(), gaussians, depth=depth, statistics=True, threads=2)
    leaf = leaves(gaussians, torch.float32)
    out = render(leaf, CAMERA, RenderOptions(depth=depth, statistics=True, threads=2))
    incoming = image_gradients(CAMERA)
    images = [getattr(out, name) for name in IMAGES]
    torch.autograd.backward(images, [torch.from_numpy(getattr(incoming, name)) for name in IMAGES])
    for name, image in zip(IMAGES, images, strict=True):
        np.testing.assert_array_equal(image.detach().numpy(), direct[name])
    ids = direct["grad ids"]
    assert 10 < len(ids) < len(gaussians)
    for name in TRAINED:
        dense = getattr(leaf, name).grad.numpy()
        np.testing.assert_array_equal(dense[ids], direct[f"grad {name}"])
        assert not np.delete(dense, ids, axis=0).any()
    assert out.statistics is not None
    for item in dataclasses.fields(RenderStatistics):
        np.testing.assert_array_equal(getattr(out.statistics, item.name), direct[item.name])
    assert direct["grad_px"].any()
    np.testing.assert_array_equal(np.nonzero(direct["visible"])[0], ids)
    np.testing.assert_array_equal(direct["radii_px"] > 0, direct["visible"])


def test_screen_gradients_alone_are_those_of_all_statistics() -> None:
    some = run(ViewRenderer(), scene(), screen_gradients=True)
    every = run(ViewRenderer(), scene(), statistics=True)
    assert "strongest" not in some
    assert len(some["weight_sum"]) == len(some["weight_max"]) == 0
    shared = [name for name in some if name not in ("weight_sum", "weight_max")]
    assert_equal({name: some[name] for name in shared}, {name: every[name] for name in shared})


def test_gradients_without_statistics_are_the_same() -> None:
    plain, every = run(ViewRenderer(), scene()), run(ViewRenderer(), scene(), statistics=True)
    for name, array in plain.items():
        # Other kernels, whose fused operations may round differently.
        difference = np.linalg.norm(array.astype(np.float64) - every[name])
        assert difference <= 1e-6 * np.linalg.norm(every[name]), name


def test_missing_gradients_are_zeros() -> None:
    raw = RawArrays.from_gaussians(scene())
    whole = image_gradients(CAMERA)
    view = ViewRenderer().render(raw, CAMERA)
    missing = copied(view, view.backward(ImageGradients(color=whole.color)))
    zeros = {name: np.zeros_like(getattr(whole, name)) for name in IMAGES[1:]}
    given = copied(view, view.backward(ImageGradients(color=whole.color, **zeros)))
    assert_equal(missing, given)
    assert missing["grad means"].any()


def test_memory_used_before_changes_nothing() -> None:
    renderer = ViewRenderer()
    wide = look_at((-2.0, 1.5, 0.4), width=70, height=20)
    nothing = scene().replaced(opacity_logits=torch.full((120,), -20.0))
    calls = [
        (scene(), CAMERA, {"statistics": True}),
        (scene(300, 5), wide, {}),
        (scene(40, 6), CAMERA, {"depth": False, "background": (0.3, 0.2, 0.1)}),
        (nothing, CAMERA, {"statistics": True}),
        (scene(), wide, {"screen_gradients": True, "budget_bytes": 2_000}),
        (scene(), CAMERA, {"statistics": True}),
    ]
    for gaussians, camera, options in calls:
        used = run(renderer, gaussians, camera, **options)
        assert_equal(used, run(ViewRenderer(), gaussians, camera, **options))


def test_backward_runs_as_often_as_asked() -> None:
    view = ViewRenderer().render(
        RawArrays.from_gaussians(scene()), CAMERA, RenderOptions(budget_bytes=4_000)
    )
    assert view.bands > 2
    first = copied(view, view.backward(image_gradients(CAMERA)))
    assert_equal(first, copied(view, view.backward(image_gradients(CAMERA))))


def test_a_view_whose_memory_was_used_again_and_wrong_shapes_are_refused() -> None:
    renderer = ViewRenderer()
    raw = RawArrays.from_gaussians(scene())
    view = renderer.render(raw, CAMERA)
    renderer.render(raw, CAMERA)
    with pytest.raises(UsageError, match="memory"):
        view.backward(image_gradients(CAMERA))
    view = renderer.render(raw, CAMERA)
    with pytest.raises(UsageError, match="gradient of alpha"):
        view.backward(ImageGradients(alpha=np.zeros((35, 40), np.float32)))


@pytest.mark.parametrize("count", [0, 3])
def test_nothing_seen(count: int) -> None:
    gaussians = isotropic([(0.0, 9.0, 0.0)] * 3, [0.1] * 3, [0.9] * 3, torch.float32)
    gaussians = gaussians.select(torch.arange(count))
    camera = look_at((0.0, 3.0, 0.0), width=18, height=10)  # looks away
    arrays = run(ViewRenderer(), gaussians, camera, background=(0.25, 0.5, 1.0), statistics=True)
    np.testing.assert_array_equal(arrays["color"], np.broadcast_to((0.25, 0.5, 1.0), (10, 18, 3)))
    assert len(arrays["grad ids"]) == len(arrays["grad sh"]) == 0
    assert not arrays["visible"].any()
    assert arrays["visible"].shape == (count,)
    assert (arrays["strongest"] == -1).all()


def test_two_views_alive_under_autograd_do_not_share_memory() -> None:
    cameras = [CAMERA, look_at((-2.0, 1.4, 0.3), width=41, height=35)]
    together = scene().means.clone().requires_grad_()
    outs = [render(scene().replaced(means=together), camera) for camera in cameras]
    sum(out.color.square().sum() + out.depth.sum() for out in outs).backward()
    alone = scene().means.clone().requires_grad_()
    for camera in cameras:
        out = render(scene().replaced(means=alone), camera)
        (out.color.square().sum() + out.depth.sum()).backward()
    assert together.grad is not None
    assert alone.grad is not None
    assert torch.allclose(together.grad, alone.grad, rtol=1e-5, atol=1e-6)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Hard cases of the fast renderer: extreme opacities, sizes and shapes, plateaus, many layers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.reference import render_reference
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import Render, RenderOptions

from .scenes import isotropic, look_at, random_gaussians

TRAINED = ("means", "log_scales", "quats", "opacity_logits", "sh", "orientation")
IMAGES = ("color", "normal", "geometric_normal", "alpha", "depth")


def both(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> tuple[Render, Render]:
    """Render the same float32 values fast and, in float64, by the definition."""
    single = {name: tensor.float() for name, tensor in gaussians.tensors()}
    with torch.no_grad():
        fast = render(gaussians.replaced(**single), camera, options)
        double = {name: tensor.double() for name, tensor in single.items()}
        exact = render_reference(gaussians.replaced(**double), camera, options)
    return fast, exact


def assert_finite_gradients(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> dict[str, torch.Tensor]:
    """Check images and gradients of their sum; return the gradients."""
    leaf = gaussians.replaced(
        **{
            name: tensor.float().clone().requires_grad_(name != "filter_3d")
            for name, tensor in gaussians.tensors()
        }
    )
    out = render(leaf, camera, options)
    total = torch.zeros(())
    for name in IMAGES:
        image = getattr(out, name)
        assert torch.isfinite(image).all(), name
        total = total + image.sum()
    total.backward()
    grads = {name: getattr(leaf, name).grad for name in TRAINED}
    for name, grad in grads.items():
        assert torch.isfinite(grad).all(), name
    return grads


def front(width: int = 16, height: int = 16, focal: float = 30.0, distance: float = 4.0) -> Camera:
    """Return a camera on the -y axis that sees the origin through the corner of four pixels."""
    camera = look_at((0.0, -distance, 0.0), width=width, height=height, focal=focal)
    return Camera(
        "front", width, height, focal, focal, width / 2, height / 2, camera.cam_from_world
    )


@pytest.mark.parametrize("logit", [20.0, -20.0])
def test_saturated_opacity(logit: float) -> None:
    gaussians = random_gaussians(12, seed=1, dtype=torch.float32)
    gaussians = gaussians.replaced(opacity_logits=torch.full((12,), logit))
    camera = look_at((2.2, 1.0, 0.8), width=20, height=18)
    fast, exact = both(gaussians, camera, RenderOptions())
    for name in IMAGES[:4]:
        assert (getattr(fast, name) - getattr(exact, name)).abs().max() < 3e-6, name
    assert_finite_gradients(gaussians, camera, RenderOptions())


def test_capped_alpha_has_no_gradient() -> None:
    # Every ray that passes within 0.1 sigma has alpha > 0.99.
    gaussians = isotropic([(0.0, 0.0, 0.0)], [1.0], [1.0 - 1e-7])
    camera = front(width=2, height=2, focal=200.0)
    options = RenderOptions(depth=False, background=(0.3, 0.3, 0.3))
    grads = assert_finite_gradients(gaussians, camera, options)
    assert not grads["opacity_logits"].any()
    assert not grads["log_scales"].any()
    assert grads["sh"].abs().sum() > 0


def test_first_gaussian_alone_has_its_closed_form() -> None:
    for alpha in (0.56, 0.8, 0.95):
        gaussians = isotropic([(0.0, 0.0, 0.0)], [0.2], [alpha])
        camera = front(width=33, height=33, focal=2000.0)
        depth = render(gaussians, camera, RenderOptions()).depth
        # The pixels around the centre see it within 2e-4 of the axis.
        wanted = 4.0 - 0.2 * math.sqrt(2.0 * math.log(2.0 * alpha))
        assert abs(float(depth[16, 16]) - wanted) < 2e-5 * wanted


def test_final_transmittance_between_the_limits_is_no_surface() -> None:
    gaussians = isotropic([(0.0, 0.0, 0.0)], [0.3], [0.53])
    camera = front()
    assert not render(gaussians, camera, RenderOptions()).depth.any()
    lenient = RenderOptions(depth_valid_transmittance=0.5)
    fast, exact = both(gaussians, camera, lenient)
    assert torch.equal(fast.depth > 0, exact.depth > 0)
    found = exact.depth > 0
    assert int(found.sum()) >= 4
    assert ((fast.depth - exact.depth).abs() / exact.depth)[found].max() < 1e-5


def test_never_reaching_half_is_no_surface() -> None:
    gaussians = isotropic([(0.0, 0.0, 0.0)], [0.3], [0.4])
    out = render(gaussians, front(), RenderOptions(depth_valid_transmittance=1.0))
    assert float(out.alpha.max()) > 0.35
    assert not out.depth.any()


def test_plateau_at_exactly_half() -> None:
    # The first layer lets exactly 0.5 through, up to rounding; the second is 3 units behind.
    gaussians = isotropic([(0.0, 0.0, 0.0), (0.0, 3.0, 0.0)], [0.05, 0.05], [0.5, 0.9])
    camera = front(width=2, height=2, focal=4000.0)
    out = render(gaussians, camera, RenderOptions())
    assert (out.depth > 4.0 - 1e-3).all()
    assert (out.depth < 7.0 - 0.05).all()
    assert_finite_gradients(gaussians, camera, RenderOptions())


def test_two_opaque_layers_show_the_first() -> None:
    gaussians = isotropic([(0.0, 0.0, 0.0), (0.0, 1.0, 0.0)], [0.1, 0.1], [0.999, 0.999])
    fast, exact = both(gaussians, front(), RenderOptions())
    assert (fast.alpha - exact.alpha).abs().max() < 3e-6
    found = exact.depth > 0
    assert torch.equal(found, fast.depth > 0)
    assert ((fast.depth - exact.depth).abs() / exact.depth)[found].max() < 1e-5
    assert_finite_gradients(gaussians, front(), RenderOptions())


def test_ten_thousand_nearly_transparent_layers() -> None:
    count = 10_000
    positions = np.linspace(-0.5, 0.5, count)
    gaussians = isotropic([(0.0, y, 0.0) for y in positions], [1.0] * count, [0.006] * count)
    camera = front(width=4, height=3, focal=60.0)
    fast, exact = both(gaussians, camera, RenderOptions())
    # 1500 factors of float32 each round by 6e-8.
    assert (fast.alpha - exact.alpha).abs().max() < 3e-5
    assert (fast.color - exact.color).abs().max() < 3e-5
    assert (exact.depth > 0).all()
    assert ((fast.depth - exact.depth).abs() / exact.depth).max() < 1e-5
    assert_finite_gradients(gaussians, camera, RenderOptions())


@pytest.mark.parametrize("distance", [1e3, 1e5])
def test_tiny_gaussians_far_away(distance: float) -> None:
    # One sigma is one pixel and a half.
    random = np.random.default_rng(3)
    means = [tuple(row) for row in random.uniform(-5e-4, 5e-4, (30, 3))]
    gaussians = isotropic(means, [1e-4] * 30, list(random.uniform(0.3, 0.9, 30)))
    camera = front(width=20, height=20, focal=1.5e4 * distance, distance=distance)
    fast, exact = both(gaussians, camera, RenderOptions())
    assert float(exact.alpha.max()) > 0.8
    # float32 positions on the screen are exact to 1e-6 pixels here, float32 depths to 6e-8.
    assert (fast.alpha - exact.alpha).abs().max() < 1e-4
    found = (exact.depth > 0) & (fast.depth > 0)
    assert int(found.sum()) > 20
    assert ((fast.depth - exact.depth).abs() / exact.depth)[found].max() < 1e-6
    assert_finite_gradients(gaussians, camera, RenderOptions())


@pytest.mark.parametrize(
    ("scales", "turn"),
    [
        ((1e-6, 0.5, 0.5), 0.0),  # disc seen edge-on
        ((1e-6, 0.5, 0.5), 0.02),  # disc at a grazing angle
        ((1e-6, 0.5, 0.5), math.pi / 2),  # disc seen from the front
        ((1e-3, 0.5, 0.5), 0.3),
        ((0.02, 1.0, 0.02), 0.0),  # needle along the ray
        ((0.02, 1.0, 0.02), 0.1),
        ((1e-6, 1.0, 1e-6), 0.7),
    ],
)
def test_extreme_shapes(scales: tuple[float, float, float], turn: float) -> None:
    gaussians = isotropic([(0.05, 0.0, 0.02)], [1.0], [0.9])
    gaussians = gaussians.replaced(
        log_scales=torch.tensor([scales], dtype=torch.float64).log(),
        quats=torch.tensor([[math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]]).double(),
    )
    camera = front(width=21, height=19, focal=40.0)
    fast, exact = both(gaussians, camera, RenderOptions())
    error = (fast.alpha - exact.alpha).abs()
    # A disc one millionth as thick as wide is a step across one pixel: at its edge float32
    # positions decide, elsewhere nothing changes.
    assert float((error > 1e-4).double().mean()) < 0.02
    found = (exact.depth > 0) & (fast.depth > 0) & (error < 1e-4)
    assert (((fast.depth - exact.depth).abs() / exact.depth)[found] < 1e-4).all()
    assert_finite_gradients(gaussians, camera, RenderOptions())


def test_camera_inside_gaussians() -> None:
    # Centres beyond the near plane, bodies around the camera and behind it.
    gaussians = isotropic(
        [(0.0, -3.4, 0.0), (0.3, -2.0, 0.2), (0.0, 5.0, 0.0)], [1.5, 2.5, 30.0], [0.3, 0.6, 0.7]
    )
    camera = front()
    fast, exact = both(gaussians, camera, RenderOptions())
    for name in IMAGES[:4]:
        assert (getattr(fast, name) - getattr(exact, name)).abs().max() < 1e-5, name
    assert torch.equal(fast.depth > 0, exact.depth > 0)
    found = exact.depth > 0
    if found.any():
        assert ((fast.depth - exact.depth).abs() / exact.depth)[found].max() < 1e-4
    assert_finite_gradients(gaussians, camera, RenderOptions())


def test_no_surface_where_no_light_reaches_the_camera() -> None:
    gaussians = isotropic([(0.0, -3.4, 0.0)] * 3, [2.0] * 3, [0.9] * 3)
    out = render(gaussians, front(), RenderOptions())
    assert float(out.alpha.min()) > 0.9
    assert not out.depth.any()
    assert_finite_gradients(gaussians, front(), RenderOptions())


def test_gradients_are_finite_for_wild_parameters() -> None:
    random = np.random.default_rng(7)
    count = 300
    gaussians = random_gaussians(count, seed=7, dtype=torch.float32, spread=3.0)
    log_scales = random.uniform(np.log(1e-5), np.log(20.0), (count, 3))
    quats = random.normal(size=(count, 4)) * 10.0 ** random.uniform(-10, 10, (count, 1))
    quats[::10] = 0.0
    orientation = random.normal(size=(count, 4)) * 30.0
    orientation[::7, :3] = 0.0
    gaussians = gaussians.replaced(
        log_scales=torch.tensor(log_scales, dtype=torch.float32),
        quats=torch.tensor(quats, dtype=torch.float32),
        opacity_logits=torch.tensor(random.uniform(-20, 20, count), dtype=torch.float32),
        orientation=torch.tensor(orientation, dtype=torch.float32),
    )
    for seed in range(3):
        eye = random.normal(size=3) * (1.0 + seed)
        camera = look_at((float(eye[0]), float(eye[1]), float(eye[2])), width=33, height=25)
        assert_finite_gradients(gaussians, camera, RenderOptions(statistics=True))

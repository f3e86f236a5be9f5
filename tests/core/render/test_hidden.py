# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians beyond float32: hidden by kernel and definition alike; valid extremes stay visible."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection import (
    RawArrays,
    project_arrays,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.reference import reference_projection
from gaussian_wrapping_addon.core.render.types import ImageGradients, RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.comparisons import leaves
from tests.core.render.first_principles import TRAINED
from tests.core.render.scenes import look_at, random_gaussians

OPTIONS = RenderOptions(near_z=0.0, threads=1)
# At the origin, along +z.
AXIS = Camera("axis", 20, 18, 30.0, 30.0, 10.0, 9.0, np.eye(3, 4))


def spread_over_magnitudes(count: int, seed: int, camera: Camera) -> OrientedGaussians:
    """Opaque Gaussians before the camera, of sizes and depths around and beyond every limit."""
    random = np.random.default_rng(seed)
    z = 10.0 ** random.uniform(-10, 13, count)
    far = np.where(random.random(count) < 0.2, 10.0 ** random.uniform(0, 7, count), 1.0)
    pixels = random.uniform(0, 1, (count, 2)) * [camera.width, camera.height] * far[:, None]
    aside = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy] * z[:, None]
    sizes = np.log(z)[:, None] + random.normal(size=(count, 3)) * random.uniform(0, 12, (count, 1))
    return OrientedGaussians(
        means=torch.from_numpy(np.concatenate([aside, z[:, None]], 1)),
        log_scales=torch.from_numpy(sizes),
        quats=torch.from_numpy(random.normal(size=(count, 4))),
        opacity_logits=torch.from_numpy(random.uniform(1, 6, count)),
        sh=torch.from_numpy(
            random.normal(size=(count, 4, 3)) * 10.0 ** random.uniform(-1, 9, (count, 1, 1))
        ),
        orientation=torch.from_numpy(random.normal(size=(count, 4))),
        filter_3d=torch.zeros(count, dtype=torch.float64),
    )


@pytest.mark.parametrize("camera", [AXIS, replace(AXIS, fx=3000.0, fy=600.0, cx=-4e5, cy=9e3)])
def test_kernel_and_definition_hide_the_same(camera: Camera) -> None:
    gaussians = spread_over_magnitudes(6000, 5, camera)
    screen = project_gaussians(RawArrays.from_gaussians(gaussians), camera, OPTIONS)
    reference = reference_projection(gaussians, camera, OPTIONS)
    usable, params = reference.usable.numpy(), reference.params.numpy()
    assert not (screen.visible & ~usable).any()
    # Where the ellipse holds the pixel centre nearest to its own, nothing but the rule hides.
    u, v, qa, qb, qc = params[:, :5].T
    x = np.clip(np.floor(u), 0, camera.width - 1) + 0.5 - u
    y = np.clip(np.floor(v), 0, camera.height - 1) + 0.5 - v
    px, py, r, s, t = params[:, 5:10].T
    den = 1.0 + 2.0 * (px * x + py * y) + r * x * x + s * x * y + t * y * y
    with np.errstate(divide="ignore"):
        reach = 2.0 * np.log(params[:, 11] / limits.ALPHA_MIN)
    meets = usable & (qa * x * x + qb * x * y + qc * y * y < 0.9 * reach * den)
    assert screen.visible[meets].all()
    assert meets.sum() > 500
    assert (~usable).sum() > 500
    # Activated Gaussians go the same way, but for their colour.
    colorless = gaussians.replaced(sh=torch.zeros_like(gaussians.sh))
    raw = project_gaussians(RawArrays.from_gaussians(colorless), camera, OPTIONS)
    activated = project_arrays(gaussians.arrays(), camera, OPTIONS.near_z, threads=1)
    np.testing.assert_array_equal(activated.visible, raw.visible)
    assert (raw.visible & ~screen.visible).any()


def test_hidden_rows_do_not_reach_the_gradients_of_the_definition() -> None:
    gaussians = spread_over_magnitudes(2000, 6, AXIS)
    leaf = leaves(gaussians, torch.float64)
    screen = reference_projection(leaf, AXIS, OPTIONS)
    screen.params.sum().backward()
    for name in TRAINED:
        gradient = getattr(leaf, name).grad
        assert gradient.isfinite().all(), name
        assert not gradient[~screen.usable].any(), name
        assert gradient[screen.usable].any(), name


def single(**values: float | list[float]) -> OrientedGaussians:
    """One opaque ball of 0.3 five units before :data:`AXIS`, with some parameters replaced."""
    plain: dict[str, float | list[float]] = {
        "means": [0.0, 0.0, 5.0],
        "log_scales": math.log(0.3),
        "quats": [1.0, 0.0, 0.0, 0.0],
        "opacity_logits": 4.0,
        "sh": 0.3,
        "orientation": [0.0, 0.0, -1.0, 1.0],
        "filter_3d": 0.0,
    }
    shapes = {"means": 3, "log_scales": 3, "quats": 4, "orientation": 4}
    made = {}
    for name, value in {**plain, **values}.items():
        shape = (1, 1, 3) if name == "sh" else (1, shapes[name]) if name in shapes else (1,)
        made[name] = torch.tensor(value, dtype=torch.float64).expand(shape).contiguous()
    return OrientedGaussians(**made)


def sigmas(*values: float) -> list[float]:
    return [math.log(value) for value in values]


_TURN = [0.9, 0.3, 0.1, 0.2]
# A pixel centre is at (10.5, 9.5): straight ahead of this camera.
CENTERED = replace(AXIS, cx=10.5, cy=9.5)
LARGE = replace(AXIS, width=20_000, height=16_000, fx=2e4, fy=2e4, cx=10_000.5, cy=8_000.5)
DISC, SMALL = sigmas(1.0, 1.0, 1e-6), sigmas(1e-4, 1e-4, 1e-4)
SANE = {
    "sigma of 1e-4 at 1e5": (single(means=[0.0, 0.0, 1e5], log_scales=SMALL), CENTERED),
    "the same on 20000 px": (single(means=[0.0, 0.0, 1e5], log_scales=SMALL), LARGE),
    "disc of 1e6 : 1": (single(log_scales=DISC, quats=_TURN), CENTERED),
    "disc of 1e6 : 1 on 20000 px": (single(log_scales=DISC, quats=_TURN), LARGE),
    "grazing disc of 1e6 : 1": (single(log_scales=sigmas(1.0, 1e-6, 1.0)), CENTERED),
    "needle of 1e6 : 1": (single(log_scales=sigmas(1.0, 1e-6, 1e-6)), CENTERED),
    "needle along the ray": (single(log_scales=sigmas(1e-6, 1e-6, 1.0)), LARGE),
    "disc of 1e6 : 1 at 1e-3 of the scale": (
        single(means=[0.0, 0.0, 5e-3], log_scales=sigmas(1e-3, 1e-3, 1e-9), quats=_TURN),
        LARGE,
    ),
    "disc of 1e6 : 1 at 1e4 of the scale": (
        single(means=[0.0, 0.0, 5e4], log_scales=sigmas(1e4, 1e4, 1e-2), quats=_TURN),
        LARGE,
    ),
    "a mean far aside whose Gaussian reaches the camera": (
        single(means=[100.0, 0.0, 0.2], log_scales=sigmas(60.0, 60.0, 60.0)),
        LARGE,
    ),
    "lights of 1e6": (single(sh=1e6), CENTERED),
}


@pytest.mark.parametrize("name", SANE)
def test_sane_extremes_stay(name: str) -> None:
    gaussians, camera = SANE[name]
    assert reference_projection(gaussians, camera, OPTIONS).usable.all()
    assert project_gaussians(RawArrays.from_gaussians(gaussians), camera, OPTIONS).visible.all()


@pytest.mark.parametrize(
    ("name", "at"),
    [
        ("z", limits.FINITE_Z_MIN),
        ("z", limits.FINITE_Z_MAX),
        ("offset", limits.FINITE_OFFSET_PX),
        ("sigma_z", limits.FINITE_SIGMA_Z),
        ("color", limits.FINITE_COLOR),
        ("spread", limits.FINITE_SPREAD),
        ("pull", limits.FINITE_PULL),
        ("num", limits.FINITE_NUM),
        ("den", limits.FINITE_DEN),
    ],
)
def test_each_limit_is_where_it_is_said_to_be(name: str, at: float) -> None:
    seen = []
    for value in (at * 0.999, at * 1.001):
        gaussians, camera = at_limit(name, value)
        usable = bool(reference_projection(gaussians, camera, OPTIONS).usable.all())
        screen = project_gaussians(RawArrays.from_gaussians(gaussians), camera, OPTIONS)
        assert bool(screen.visible.all()) == usable
        seen.append(usable)
    assert seen == ([False, True] if at == limits.FINITE_Z_MIN else [True, False])


def at_limit(name: str, value: float) -> tuple[OrientedGaussians, Camera]:
    """One Gaussian of which one limited quantity is ``value`` and the others are far from theirs.

    All are seen along the optical axis, so that ``den = 1 + (d / f)^2 a_side / a0``.
    """
    # Offsets of the corner that is farthest, in both directions, tile included.
    reach = 10.5 + 16.0, 9.5 + 16.0
    squares = (reach[0] ** 2 + reach[1] ** 2) / 30.0**2
    if name == "z":
        return single(means=[0.0, 0.0, value], log_scales=sigmas(*[0.1 * value] * 3)), CENTERED
    if name == "offset":
        z, focal = 1.0, 1000.0
        x = (value - 16.0 - 10.5) / focal * z
        sizes = sigmas(x, x, x)
        return single(means=[x, 0.0, z], log_scales=sizes), replace(CENTERED, fx=focal, fy=focal)
    if name == "sigma_z":
        return single(log_scales=sigmas(1e14, 1e14, value)), CENTERED
    if name == "color":
        # The first basis function is 1 / sqrt(4 pi).
        return single(sh=(value - 0.5) * math.sqrt(4.0 * math.pi)), CENTERED
    if name == "spread":
        # A plane through the axis, tilted by 45 degrees: a0 = 1 / (2 thin^2), sigma_z^2 = 1 / 2.
        turn = [math.cos(math.pi / 8), math.sin(math.pi / 8), 0.0, 0.0]
        thin = 0.5 / math.sqrt(value)
        scaled = 1e6  # large, so that the pull is far from its limit
        sizes = sigmas(scaled, scaled, thin * scaled)
        return single(means=[0.0, 0.0, 5.0], log_scales=sizes, quats=turn), CENTERED
    if name == "pull":
        sigma = math.sqrt(5.0 * (1.0 + squares) / value)
        return single(log_scales=sigmas(sigma, sigma, sigma)), CENTERED
    if name == "num":
        # A ball of equal angle: num = (z / sigma)^2 (d / f)^2.
        sigma = 1e10 * math.sqrt(squares / value)
        return single(means=[0, 0, 1e10], log_scales=sigmas(sigma, sigma, sigma)), CENTERED
    # den = 1 + (dx^2 / sx^2 + dy^2 / sy^2) sz^2 / f^2.
    ratio = math.sqrt(squares / (value - 1.0))
    return single(log_scales=sigmas(ratio * 1e6, ratio * 1e6, 1e6)), CENTERED


def test_gradients_scale_beyond_the_squares_of_float32() -> None:
    """Lengths are taken in float64: upstream gradients times 2^90 give results times 2^90."""
    raw = RawArrays.from_gaussians(random_gaussians(12, 4, dtype=torch.float32))
    camera = look_at((0.3, -3.0, 0.2), width=20, height=18)
    options = RenderOptions(threads=1, statistics=True, budget_bytes=1)
    renderer, random = ViewRenderer(), np.random.default_rng(2)
    shapes = [(18, 20, 3)] * 3 + [(18, 20)] * 2
    upstream = [random.normal(size=shape).astype(np.float32) for shape in shapes]

    def gradients(factor: float) -> dict[str, np.ndarray]:
        view = renderer.render(raw, camera, options)
        assert view.bands > 1
        out = view.backward(ImageGradients(*(one * np.float32(factor) for one in upstream)))
        found = {name: getattr(out, name).copy() for name in TRAINED}
        for name in ("grad_px", "grad_abs_px"):
            found[name] = getattr(view.statistics, name).copy()
        return found

    many = gradients(2.0**90)
    for name, value in gradients(1.0).items():
        assert value.any(), name
        np.testing.assert_allclose(many[name], value * np.float32(2.0**90), 1e-6, err_msg=name)
    # Beyond float32 a gradient is 0, as a whole.
    for name, value in gradients(2.0**126).items():
        assert np.isfinite(value).all(), name

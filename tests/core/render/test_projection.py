# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled projection: against torch and 60 digits, gradients, what it hides."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.parallel import ArrayStore
from gaussian_wrapping_addon.core.render.projection import (
    RawArrays,
    RawGradients,
    ScreenGaussians,
    project_backward,
    project_backward_visible,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.reference import reference_projection
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.comparisons import leaves
from tests.core.render.depth_scenes import doubled
from tests.core.render.exact_projection import (
    EXACT_COLUMNS,
    exact_columns,
    exact_gradient,
    exact_values,
)
from tests.core.render.first_principles import TRAINED
from tests.core.render.scenes import isotropic, look_at, random_gaussians

CAMERA = look_at((2.0, 0.6, 0.9))
OPTIONS = RenderOptions(threads=1)
AXIS = Camera("axis", 64, 48, 60.0, 66.0, 32.5, 23.5, np.eye(3, 4))


def project(
    gaussians: OrientedGaussians, camera: Camera = CAMERA, options: RenderOptions = OPTIONS
) -> ScreenGaussians:
    return project_gaussians(RawArrays.from_gaussians(gaussians), camera, options)


def single(**changes: object) -> OrientedGaussians:
    """One Gaussian in front of AXIS, with entries exchanged."""
    gaussians = isotropic([(0.1, -0.2, 3.0)], [0.1], [0.8])
    values = {k: torch.tensor([v], dtype=torch.float64) for k, v in changes.items()}
    return gaussians.replaced(**values)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_columns_equal_torch(degree: int, dtype: torch.dtype) -> None:
    gaussians = random_gaussians(300, degree, sh_degree=degree, dtype=dtype)
    screen = project(gaussians)
    reference = reference_projection(doubled(gaussians), CAMERA, OPTIONS)
    seen = screen.visible
    assert seen.mean() > 0.8
    assert reference.usable.numpy()[seen].all()
    wanted = reference.params.numpy()
    # One rounding to float32; a cancelled entry is judged by its block's size.
    size = np.abs(wanted)
    for block in ((2, 5), (5, 7), (7, 10), (13, 16), (16, 19), (19, 22)):
        size[:, slice(*block)] = size[:, slice(*block)].max(1, keepdims=True)
    error = np.abs(screen.params - wanted)[seen]
    assert (error <= 6.1e-8 * size[seen] + 1e-12).all()
    np.testing.assert_allclose(screen.depths[seen], reference.depths.numpy()[seen], rtol=1e-7)
    assert not screen.params[~seen].any()


def test_used_degree_can_be_lowered() -> None:
    gaussians = random_gaussians(50, 1, sh_degree=3)
    low = project(gaussians, options=RenderOptions(sh_degree=1, threads=1))
    cut = project(gaussians.replaced(sh=gaussians.sh[:, :4]))
    np.testing.assert_array_equal(low.params, cut.params)
    with pytest.raises(UsageError, match="coefficients"):
        project(gaussians.replaced(sh=gaussians.sh[:, :5]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_value_depends_on_neighbours(dtype: torch.dtype) -> None:
    """Any Gaussian alone, or with any others around it, has bitwise the same row and gradient."""
    gaussians = random_gaussians(61, 9, spread=2.0, dtype=dtype)
    # Values that are not finite, or overflow, must not leak into the rest of a block.
    gaussians.means[7] = torch.nan
    gaussians.log_scales[12] = torch.inf
    gaussians.sh[20] = -torch.inf
    gaussians.log_scales[21] = 300.0
    gaussians.quats[33] = 0.0
    whole = project(gaussians)
    raw = RawArrays.from_gaussians(gaussians)
    grad_params = np.random.default_rng(1).normal(size=(61, 24)).astype(raw.means.dtype)
    ids = np.arange(61, dtype=np.int32)
    every = project_backward_visible(raw, CAMERA, OPTIONS, whole, grad_params, ids)
    assert not whole.visible[[7, 12, 20, 21]].any()
    assert 15 < whole.visible.sum() < 55
    random = np.random.default_rng(2)
    for size in (*range(1, 18), 40):
        chosen = np.sort(random.choice(61, size, replace=False))
        part = gaussians.select(torch.from_numpy(chosen))
        screen = project(part)
        np.testing.assert_array_equal(screen.visible, whole.visible[chosen])
        seen = screen.visible
        for field in dataclasses.fields(screen):
            got, wanted = getattr(screen, field.name), getattr(whole, field.name)[chosen]
            np.testing.assert_array_equal(got[seen], wanted[seen])
        grads = project_backward_visible(
            RawArrays.from_gaussians(part), CAMERA, OPTIONS, screen, grad_params[chosen], ids[:size]
        )
        for name in TRAINED:
            np.testing.assert_array_equal(getattr(grads, name), getattr(every, name)[chosen])
            assert np.isfinite(getattr(grads, name)).all()


@pytest.mark.parametrize("degree", [0, 3])
def test_backward_equals_autograd_and_adds(degree: int) -> None:
    gaussians = random_gaussians(200, 0, sh_degree=degree, filter_size=0.08)
    # Bright and dark colours: some are clamped.
    gaussians = gaussians.replaced(sh=gaussians.sh * 3.0)
    raw = RawArrays.from_gaussians(gaussians)
    screen = project(gaussians)
    grad_params = np.random.default_rng(0).normal(size=(200, 24))
    leaf = leaves(gaussians, torch.float64)
    reference = reference_projection(leaf, CAMERA, OPTIONS)
    weights = torch.from_numpy(np.where(screen.visible[:, None], grad_params, 0.0))
    (reference.params * weights).sum().backward()
    grads = RawGradients.zeros(raw)
    project_backward(raw, CAMERA, OPTIONS, screen, grad_params, grads)
    twice = RawGradients.zeros(raw)
    for _ in range(2):
        project_backward(raw, CAMERA, OPTIONS, screen, grad_params, twice)
    assert (screen.params[screen.visible, 13:16] == 0.0).any()
    for name in TRAINED:
        wanted, got = getattr(leaf, name).grad.numpy(), getattr(grads, name)
        np.testing.assert_array_equal(getattr(twice, name), 2.0 * got)
        rows = (len(wanted), -1)
        size = np.abs(wanted.reshape(rows)).max(1)
        error = np.abs(got - wanted).reshape(rows).max(1)
        assert (error <= 1e-10 * (size + 1e-6 * size.max())).all(), name
        assert not got[~screen.visible].any()


def test_compact_rows_are_the_dense_ones() -> None:
    gaussians = random_gaussians(300, 4, dtype=torch.float32)
    gaussians = gaussians.replaced(means=gaussians.means * 2.0)
    raw = RawArrays.from_gaussians(gaussians)
    options = RenderOptions(threads=3, sh_degree=1)
    screen = project(gaussians, options=options)
    grad_params = np.random.default_rng(0).normal(size=(300, 24)).astype(np.float32)
    dense = RawGradients.zeros(raw)
    project_backward(raw, CAMERA, options, screen, grad_params, dense)
    seen = np.flatnonzero(screen.visible).astype(np.int32)
    assert 50 < len(seen) < 290
    store = ArrayStore()
    for ids in (seen, seen[3:50], seen[:1], seen[:0], np.arange(300, dtype=np.int32)):
        for name in TRAINED:
            store.take(f"grad {name}", getattr(raw, name).shape, np.float32)[:] = np.nan
        part = project_backward_visible(raw, CAMERA, options, screen, grad_params, ids, store.take)
        assert part.ids is ids
        for name in TRAINED:
            got = getattr(part, name)
            np.testing.assert_array_equal(got, getattr(dense, name)[ids], err_msg=name)
            reused = store.take(f"grad {name}", getattr(raw, name).shape, np.float32)
            assert np.isnan(reused[len(ids) :]).all()
            assert np.shares_memory(got, reused) or not len(ids)
        # Coefficients above the degree used.
        assert not part.sh[:, 4:].any()


EDGE_ON = {"log_scales": [0.0, 0.0, np.log(1e-6)], "quats": [1.0, 1.0, 0.0, 0.0]}
HARD_SHAPES: list[dict[str, object]] = [
    {},
    {"log_scales": [0.0, -0.5, np.log(1e-6)], "quats": [0.9, 0.1, 0.3, -0.2]},
    {"log_scales": [np.log(1e-6), np.log(2e-6), -1.0], "quats": [0.2, 0.5, 0.7, -0.6]},
    {"log_scales": [np.log(1e-6), np.log(2e-6), -1.0], "quats": [1.0, 0.0, 0.0, 0.0]},
    EDGE_ON,
    EDGE_ON | {"means": [0.0, 0.0, 3.0]},
    {"log_scales": [np.log(1e-4)] * 3, "means": [0.0, 0.0, 1e3]},
    {"log_scales": [np.log(3e-4), np.log(1e-4), np.log(1e-4)], "means": [50.0, 9.0, 1e3]},
    {"log_scales": [4.0, 3.0, 2.0], "means": [4.0, 3.0, 20.0], "quats": [0.9, 0.1, 0.3, 0.1]},
]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("changes", HARD_SHAPES)
def test_hard_shapes_and_their_gradients_against_sixty_digits(
    changes: dict[str, object], dtype: torch.dtype
) -> None:
    gaussians = single(**changes)
    # A pixel centre lies on the mean.
    ahead = (gaussians.means[0] / gaussians.means[0, 2]).numpy()
    camera = dataclasses.replace(AXIS, cx=32.5 - AXIS.fx * ahead[0], cy=23.5 - AXIS.fy * ahead[1])
    gaussians = gaussians.replaced(**{name: t.to(dtype) for name, t in gaussians.tensors()})
    exact = exact_values(gaussians)
    wanted = np.array([float(v) for v in exact_columns(exact, camera)])
    screen = project(gaussians, camera)
    assert screen.visible.all()
    assert np.isfinite(screen.boxes).all()
    size = np.abs(wanted)
    for block in ((2, 5), (5, 7), (7, 10), (12, 15)):
        size[slice(*block)] = size[slice(*block)].max()
    slack = np.full(len(size), 1e-9)
    # A rounding of the axes by eps turns the gradient of an edge-on disc by eps (1e6)^2.
    slack[[5, 6, 12, 13, 14]] += 1e-15 * np.exp(2.0 * np.ptp(gaussians.log_scales.numpy()))
    got = screen.params[0, EXACT_COLUMNS].astype(np.float64)
    assert (np.abs(got - wanted) <= 1e-7 * size + slack).all()

    # Every column counts: weights are those that make the columns' shares of the sum alike.
    weights = np.random.default_rng(3).uniform(0.5, 1.5, len(wanted)) / (np.abs(wanted) + 1e-6)
    weights = weights.astype(np.float32).astype(np.float64)
    raw = RawArrays.from_gaussians(gaussians)
    grad_params = np.zeros((1, 24), raw.means.dtype)
    grad_params[0, EXACT_COLUMNS] = weights
    grads = RawGradients.zeros(raw)
    project_backward(raw, camera, OPTIONS, screen, grad_params, grads)
    slopes = exact_gradient(exact, camera, weights)
    rounding = 2.0**-24 if dtype == torch.float32 else 0.0
    whole = np.linalg.norm(np.concatenate(list(slopes.values())))
    for name, value in slopes.items():
        error = np.linalg.norm(getattr(grads, name)[0] - value)
        assert error <= (1e-13 + rounding) * np.linalg.norm(value) + 1e-13 * whole, name


@pytest.mark.parametrize(
    "name", ["means", "log_scales", "quats", "opacity_logits", "sh", "orientation", "filter_3d"]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_hide_the_gaussian(name: str, value: float) -> None:
    gaussians = isotropic([(0.1, -0.2, 3.0), (0.2, 0.1, 3.0)], [0.1, 0.1], [0.8, 0.8])
    broken = getattr(gaussians, name).clone()
    broken[0] = value
    screen = project(gaussians.replaced(**{name: broken}), AXIS)
    if name == "opacity_logits" and value == np.inf:
        assert screen.params[0, 11] == 1.0  # an opaque limit that is well defined
    else:
        assert not screen.visible[0]
        assert not screen.params[0].any()
    assert screen.visible[1]
    assert np.isfinite(screen.params).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_boxes_are_those_of_the_ellipsoid_and_culling_leaves_out_only_what_is_not_seen(
    seed: int,
) -> None:
    """Exactly those are visible whose box, by the reference's columns, holds a pixel centre."""
    gaussians = random_gaussians(3000, seed, spread=4.0, scale=(0.003, 1.5), filter_size=0.05)
    # Also around the limit of what is too faint.
    gaussians.opacity_logits[::3] = torch.linspace(-6.0, -5.0, 1000, dtype=torch.float64)
    camera = dataclasses.replace(CAMERA, cx=-7.0 if seed == 1 else CAMERA.cx)
    screen = project(gaussians, camera)
    reference = reference_projection(gaussians, camera, OPTIONS)
    opacity = torch.exp(gaussians.log_opacities())
    local = gaussians.means @ torch.from_numpy(camera.rotation).T
    local += torch.from_numpy(camera.cam_from_world[:, 3])
    axes = torch.from_numpy(camera.rotation) @ gaussians.rotations()
    scaled = axes * gaussians.scales()[:, None]
    covariance = scaled @ scaled.transpose(1, 2)
    # Dual conic of the ellipsoid at 1/255 as a plane sees it: K (m m^T - threshold Sigma) K^T.
    threshold = 2.0 * torch.log(opacity * 255.0)[:, None, None]
    dual = local[:, :, None] * local[:, None] - threshold * covariance
    lens = torch.tensor(
        [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]],
        dtype=torch.float64,
    )
    dual = (lens @ dual @ lens.T).numpy()
    usable = reference.usable.numpy()
    bounded = usable & (dual[:, 2, 2] > 0.0)
    assert (usable & ~bounded).sum() > 10
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = dual[:, [0, 1], 2] / dual[:, 2:, 2]
        half = np.sqrt(middle**2 - dual[:, [0, 1], [0, 1]] / dual[:, 2:, 2])
        first = np.maximum(np.ceil(middle - half - 0.5), 0.0)
        last = np.minimum(np.floor(middle + half - 0.5), [camera.width - 1.0, camera.height - 1.0])
        wanted = usable & (~bounded | (first <= last).all(1))
        skews = middle.prod(1) - dual[:, 0, 1] / dual[:, 2, 2]
        skews /= half[:, 1]
    np.testing.assert_array_equal(screen.visible, wanted)
    assert 100 < wanted.sum() < 2500
    np.testing.assert_array_equal(np.isinf(screen.skews[wanted]), ~bounded[wanted])
    whole = np.array([0.0, 0.0, camera.width, camera.height], np.float32)
    assert (screen.boxes[wanted & ~bounded] == whole).all()
    seen = wanted & np.isfinite(screen.skews) & (abs(middle) + half < 1e3).all(1)
    assert seen.sum() > 100
    boxes, exact = screen.boxes[seen], np.concatenate([middle - half, middle + half], 1)[seen]
    np.testing.assert_allclose(boxes, exact, rtol=2e-7, atol=2e-6)
    slack = 1e-9 * (1.0 + abs(exact))
    assert (boxes[:, :2] <= exact[:, :2] + slack[:, :2]).all()
    assert (boxes[:, 2:] >= exact[:, 2:] - slack[:, 2:]).all()
    np.testing.assert_allclose(screen.skews[seen], skews[seen], rtol=1e-6, atol=1e-6)

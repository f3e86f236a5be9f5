# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled projection: against torch and 60 digits, gradients, what it hides."""

from __future__ import annotations

import dataclasses
import tracemalloc
from collections.abc import Callable

import mpmath
import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.compiled import kernel
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.parallel import ArrayStore
from gaussian_wrapping_addon.core.render.projection import (
    RawArrays,
    RawGradients,
    ScreenGaussians,
    project_arrays,
    project_backward,
    project_backward_visible,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.projection_kernels import (
    block_scratch,
    exp_parts,
    exp_wide,
    log_wide,
)
from gaussian_wrapping_addon.core.render.reference import reference_projection
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.exact_projection import (
    EXACT_COLUMNS,
    exact_columns,
    exact_gradient,
    exact_values,
)
from tests.core.render.first_principles import TRAINED
from tests.core.render.projections import AXIS, CAMERA, OPTIONS, project, single
from tests.core.render.scenes import isotropic, random_gaussians


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_columns_equal_torch(degree: int, dtype: torch.dtype) -> None:
    gaussians = random_gaussians(300, degree, sh_degree=degree, dtype=dtype)
    screen = project(gaussians)
    wide = OrientedGaussians(**{k: v.double() for k, v in gaussians.tensors()})
    reference = reference_projection(wide, CAMERA, OPTIONS)
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


def test_boxes_are_those_of_the_conic() -> None:
    gaussians = random_gaussians(400, 5, scale=(0.01, 0.2))
    screen = project(gaussians)
    params = reference_projection(gaussians, CAMERA, OPTIONS).params.numpy()
    u, v, qa, qb, qc, px, py, r, s, t, _, opacity = params[:, :12].T
    threshold = 2.0 * np.log(255.0 * np.where(screen.visible, opacity, 1.0))
    shape = np.stack([qa, qb / 2, qb / 2, qc], 1).reshape(-1, 2, 2)
    shape -= threshold[:, None, None] * np.stack([r, s / 2, s / 2, t], 1).reshape(-1, 2, 2)
    bounded = screen.visible & np.isfinite(screen.skews)
    assert bounded.sum() > 300
    inverse = np.linalg.inv(shape[bounded])
    linear = np.stack([px, py], 1)[bounded]
    threshold = threshold[bounded]
    shift = threshold[:, None] * np.einsum("nij,nj->ni", inverse, linear)
    level = threshold + threshold * np.einsum("ni,ni->n", linear, shift)
    center = np.stack([u, v], 1)[bounded] + shift
    half = np.sqrt(level[:, None] * inverse[:, [0, 1], [0, 1]])
    wanted = np.concatenate([center - half, center + half], 1)
    boxes = screen.boxes[bounded]
    np.testing.assert_allclose(boxes, wanted, rtol=2e-7, atol=2e-6)
    slack = 1e-9 * (1.0 + np.abs(wanted))
    assert (boxes[:, :2] <= wanted[:, :2] + slack[:, :2]).all()
    assert (boxes[:, 2:] >= wanted[:, 2:] - slack[:, 2:]).all()
    skew = np.sqrt(level) * inverse[:, 0, 1] / np.sqrt(inverse[:, 1, 1])
    np.testing.assert_allclose(screen.skews[bounded], skew, rtol=1e-6, atol=1e-6)


def test_activated_arrays_give_the_same_rows() -> None:
    gaussians = random_gaussians(200, 7)
    screen = project(gaussians)
    other = project_arrays(gaussians.arrays(), CAMERA, OPTIONS.near_z, threads=2)
    np.testing.assert_array_equal(other.visible, screen.visible)
    columns = [*range(13), *range(16, 24)]
    np.testing.assert_allclose(
        other.params[:, columns], screen.params[:, columns], rtol=3e-7, atol=1e-9
    )
    assert not other.params[:, 13:16].any()
    np.testing.assert_allclose(other.boxes, screen.boxes, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_threads_and_reused_output_change_nothing(dtype: torch.dtype) -> None:
    gaussians = random_gaussians(500, 8, spread=2.5, dtype=dtype)
    alone = project(gaussians)
    seen = alone.visible
    assert 0.2 < seen.mean() < 0.8
    assert np.isinf(alone.depths[~seen]).all()
    for threads in (1, 2, 4):
        reused = ScreenGaussians.allocate(500)
        for field in dataclasses.fields(reused):
            getattr(reused, field.name)[:] = 77
        got = project_gaussians(
            RawArrays.from_gaussians(gaussians), CAMERA, RenderOptions(threads=threads), reused
        )
        assert got is reused
        np.testing.assert_array_equal(got.visible, seen)
        np.testing.assert_array_equal(got.depths, alone.depths)
        # Other rows of what is not visible hold anything.
        for name in ("params", "boxes", "skews"):
            np.testing.assert_array_equal(getattr(got, name)[seen], getattr(alone, name)[seen])
    with pytest.raises(UsageError, match="rows"):
        project_gaussians(
            RawArrays.from_gaussians(gaussians), CAMERA, OPTIONS, ScreenGaussians.allocate(3)
        )


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


def test_reused_output_allocates_no_arrays() -> None:
    raw = RawArrays.from_gaussians(random_gaussians(20_000, 3, dtype=torch.float32))
    screen = project_gaussians(raw, CAMERA, OPTIONS)
    ids = np.flatnonzero(screen.visible).astype(np.int32)
    grad_params = np.ones((20_000, 24), np.float32)
    store = ArrayStore()
    project_backward_visible(raw, CAMERA, OPTIONS, screen, grad_params, ids, store.take)
    tracemalloc.start()
    project_gaussians(raw, CAMERA, OPTIONS, screen)
    project_backward_visible(raw, CAMERA, OPTIONS, screen, grad_params, ids, store.take)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20_000  # bytes: less than one for each Gaussian


@kernel(fast=False, fused=True)
def _evaluate(x: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(x)):
        scale, p = exp_parts(x[i])
        out[0, i] = exp_wide(x[i])
        out[1, i] = (scale - 1.0) + scale * p
        out[2, i] = log_wide(x[i])


@kernel(fast=False, fused=True)
def _scratch(planes: int) -> np.ndarray:
    return block_scratch(planes)


def evaluated(values: np.ndarray) -> np.ndarray:
    out = np.zeros((3, len(values)))
    _evaluate(np.ascontiguousarray(values, np.float64), out)
    return out


def relative_error(got: np.ndarray, wanted: Callable[..., mpmath.mpf], x: np.ndarray) -> float:
    with mpmath.workdps(40):
        exact = [wanted(mpmath.mpf(float(value))) for value in x]
        pairs = zip(got, exact, strict=True)
        return float(max(abs((mpmath.mpf(float(g)) - e) / e) for g, e in pairs))


RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize("reach", [1e-12, 0.4, 30.0, 708.0])
def test_exponential(reach: float) -> None:
    x = np.concatenate([RANDOM.uniform(-reach, reach, 2000), [reach, -reach]])
    got = evaluated(x)
    assert relative_error(got[0], mpmath.exp, x) < 3e-16
    assert relative_error(got[1], mpmath.expm1, x) < 6e-16


def test_exponential_at_its_ends() -> None:
    x = np.array([0.0, -0.0, 709.0, 709.1, np.inf, -708.1, -np.inf, np.nan])
    got = evaluated(x)[0]
    np.testing.assert_array_equal(got[[0, 1, 3, 4, 5, 6]], [1.0, 1.0, np.inf, np.inf, 0.0, 0.0])
    assert relative_error(got[2:3], mpmath.exp, x[2:3]) < 3e-16
    assert np.isnan(got[7])


def test_logarithm() -> None:
    x = np.concatenate([RANDOM.uniform(1.0, 256.0, 2000), 10.0 ** RANDOM.uniform(-300, 300, 1000)])
    got = evaluated(x)[2]
    assert relative_error(got, mpmath.log, x) < 1e-15
    # Near 1 the result is small, and the error too.
    x = 1.0 + RANDOM.uniform(-1e-3, 1e-3, 1000) * 10.0 ** RANDOM.uniform(-10, 0, 1000)
    x = x[x != 1.0]
    assert relative_error(evaluated(x)[2], mpmath.log, x) < 1e-15
    assert evaluated(np.ones(1))[2, 0] == 0.0


def test_scratch_begins_at_a_cache_line() -> None:
    for planes in (1, 7, 100):
        values = _scratch(planes)
        assert values.shape == (8 * planes,)
        assert values.ctypes.data % 64 == 0


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("seed", [0, 1])
def test_backward_equals_autograd(degree: int, seed: int) -> None:
    gaussians = random_gaussians(200, seed, sh_degree=degree, filter_size=0.08)
    # Bright and dark colours: some are clamped.
    gaussians = gaussians.replaced(sh=gaussians.sh * 3.0)
    raw = RawArrays.from_gaussians(gaussians)
    screen = project(gaussians)
    grad_params = np.random.default_rng(seed).normal(size=(200, 24))
    leaves = {
        name: t.clone().requires_grad_(name != "filter_3d") for name, t in gaussians.tensors()
    }
    reference = reference_projection(OrientedGaussians(**leaves), CAMERA, OPTIONS)
    weights = torch.from_numpy(np.where(screen.visible[:, None], grad_params, 0.0))
    (reference.params * weights).sum().backward()
    grads = RawGradients.zeros(raw)
    project_backward(raw, CAMERA, OPTIONS, screen, grad_params, grads)
    assert (screen.params[screen.visible, 13:16] == 0.0).any()
    for name in TRAINED:
        wanted = leaves[name].grad.numpy()  # type: ignore[union-attr]
        got = getattr(grads, name)
        rows = (len(wanted), -1)
        size = np.abs(wanted.reshape(rows)).max(1)
        error = np.abs(got - wanted).reshape(rows).max(1)
        assert (error <= 1e-10 * (size + 1e-6 * size.max())).all(), name
        assert not got[~screen.visible].any()


def test_backward_adds_and_float32_is_close() -> None:
    gaussians = random_gaussians(100, 2)
    raw = RawArrays.from_gaussians(gaussians)
    screen = project(gaussians)
    grad_params = np.random.default_rng(0).normal(size=(100, 24)).astype(np.float32)
    once, twice = RawGradients.zeros(raw), RawGradients.zeros(raw)
    wide = grad_params.astype(np.float64)
    project_backward(raw, CAMERA, OPTIONS, screen, wide, once)
    for _ in range(2):
        project_backward(raw, CAMERA, OPTIONS, screen, wide, twice)
    narrow = RawArrays(
        **{f.name: getattr(raw, f.name).astype(np.float32) for f in dataclasses.fields(raw)}
    )
    small = RawGradients.zeros(narrow)
    project_backward(narrow, CAMERA, OPTIONS, screen, grad_params, small)
    for name in TRAINED:
        wanted = getattr(once, name)
        np.testing.assert_array_equal(getattr(twice, name), 2.0 * wanted)
        got = getattr(small, name)
        assert got.dtype == np.float32
        assert np.abs(got - wanted).max() <= 1e-4 * np.abs(wanted).max(), name


def test_compact_rows_are_the_dense_ones() -> None:
    gaussians = random_gaussians(300, 4, dtype=torch.float32)
    gaussians = gaussians.replaced(means=gaussians.means * 2.0)
    raw = RawArrays.from_gaussians(gaussians)
    options = RenderOptions(threads=1, sh_degree=1)
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
        for threads in (1, 3):
            chosen = dataclasses.replace(options, threads=threads)
            part = project_backward_visible(
                raw, CAMERA, chosen, screen, grad_params, ids, store.take
            )
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


def wide_camera(gaussians: OrientedGaussians) -> Camera:
    """AXIS moved so that a pixel centre lies on the first mean."""
    u = AXIS.fx * float(gaussians.means[0, 0] / gaussians.means[0, 2])
    v = AXIS.fy * float(gaussians.means[0, 1] / gaussians.means[0, 2])
    return dataclasses.replace(AXIS, cx=32.5 - u, cy=23.5 - v)


@pytest.mark.parametrize("changes", HARD_SHAPES)
def test_hard_shapes_against_sixty_digits(changes: dict[str, object]) -> None:
    gaussians = single(**changes)
    camera = wide_camera(gaussians)
    screen = project(gaussians, camera)
    assert screen.visible.all()
    wanted = np.array([float(v) for v in exact_columns(exact_values(gaussians), camera)])
    got = screen.params[0, EXACT_COLUMNS].astype(np.float64)
    size = np.abs(wanted)
    for block in ((2, 5), (5, 7), (7, 10), (12, 15)):
        size[slice(*block)] = size[slice(*block)].max()
    slack = np.full(len(size), 1e-9)
    # A rounding of the axes by eps turns the gradient of an edge-on disc by eps (1e6)^2.
    slack[[5, 6, 12, 13, 14]] += 1e-15 * np.exp(2.0 * np.ptp(gaussians.log_scales.numpy()))
    assert (np.abs(got - wanted) <= 1e-7 * size + slack).all()
    assert np.isfinite(screen.boxes).all()

    raw = RawArrays.from_gaussians(gaussians)
    grads = RawGradients.zeros(raw)
    project_backward(raw, camera, OPTIONS, screen, np.ones((1, 24)), grads)
    assert all(np.isfinite(getattr(grads, name)).all() for name in TRAINED)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("changes", HARD_SHAPES)
def test_gradients_of_hard_shapes_against_sixty_digits(
    changes: dict[str, object], dtype: torch.dtype
) -> None:
    gaussians = single(**changes)
    camera = wide_camera(gaussians)
    gaussians = OrientedGaussians(**{name: t.to(dtype) for name, t in gaussians.tensors()})
    exact = exact_values(gaussians)
    # Every column counts: weights are those that make the columns' shares of the sum alike.
    columns = np.abs(np.array([float(v) for v in exact_columns(exact, camera)]))
    weights = np.random.default_rng(3).uniform(0.5, 1.5, len(columns)) / (columns + 1e-6)
    weights = weights.astype(np.float32).astype(np.float64)
    raw = RawArrays.from_gaussians(gaussians)
    grad_params = np.zeros((1, 24), raw.means.dtype)
    grad_params[0, EXACT_COLUMNS] = weights
    screen = project(gaussians, camera)
    assert screen.visible.all()
    grads = RawGradients.zeros(raw)
    project_backward(raw, camera, OPTIONS, screen, grad_params, grads)
    wanted = exact_gradient(exact, camera, weights)
    rounding = 2.0**-24 if dtype == torch.float32 else 0.0
    whole = np.linalg.norm(np.concatenate(list(wanted.values())))
    for name, value in wanted.items():
        error = np.linalg.norm(getattr(grads, name)[0] - value)
        assert error <= (1e-13 + rounding) * np.linalg.norm(value) + 1e-13 * whole, name


def test_zero_quaternion_is_the_identity_and_gets_no_gradient() -> None:
    scales = {"log_scales": [-1.0, -2.0, -3.0]}
    zero, unit = single(quats=[0.0] * 4, **scales), single(quats=[1.0, 0.0, 0.0, 0.0], **scales)
    np.testing.assert_array_equal(project(zero, AXIS).params, project(unit, AXIS).params)
    raw = RawArrays.from_gaussians(zero)
    grads = RawGradients.zeros(raw)
    project_backward(raw, AXIS, OPTIONS, project(zero, AXIS), np.ones((1, 24)), grads)
    assert not grads.quats.any()
    assert np.isfinite(grads.log_scales).all()


@pytest.mark.parametrize(
    ("logit", "seen"), [(20.0, True), (800.0, True), (-20.0, False), (-5.6, False), (-5.5, True)]
)
def test_extreme_opacities(logit: float, seen: bool) -> None:
    screen = project(single(opacity_logits=logit), AXIS)
    assert screen.visible[0] == seen
    if seen:
        assert screen.params[0, 11] == np.float32(1.0 / (1.0 + np.exp(-logit)))


def test_filter_dims_and_widens() -> None:
    screen = project(single(filter_3d=0.1, log_scales=[np.log(0.1)] * 3), AXIS)
    assert screen.params[0, 11] == pytest.approx(0.8 * 2.0**-1.5, rel=1e-6)
    assert screen.params[0, 22] == pytest.approx(0.1 * 2.0**0.5, rel=1e-6)
    # A vanishing scale leaves nothing of the opacity and is not visible.
    assert not project(single(filter_3d=0.1, log_scales=[-400.0] * 3), AXIS).visible[0]


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


def test_around_and_behind_the_camera() -> None:
    near = {"log_scales": [0.0] * 3}
    around = project(single(means=[0.0, 0.0, 0.5], **near), AXIS)
    assert around.visible[0]
    np.testing.assert_array_equal(around.boxes[0], [0.0, 0.0, 64.0, 48.0])
    assert np.isinf(around.skews[0])
    for z in (0.2, 0.0, -1.0):
        assert not project(single(means=[0.0, 0.0, z], **near), AXIS).visible[0]
    # Bounded as soon as the ellipsoid at 1/255 clears the camera plane.
    reach = np.sqrt(2.0 * np.log(255.0 * 0.8))
    assert np.isinf(project(single(means=[0.0, 0.0, 0.999 * reach], **near), AXIS).skews[0])
    assert np.isfinite(project(single(means=[0.0, 0.0, 1.001 * reach], **near), AXIS).skews[0])


@pytest.mark.parametrize("seed", range(4))
def test_culling_leaves_out_only_what_is_not_seen(seed: int) -> None:
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
    np.testing.assert_array_equal(screen.visible, wanted)
    assert 100 < wanted.sum() < 2500


def test_off_the_image_or_between_pixel_centres_is_not_visible() -> None:
    assert not project(single(means=[9.0, 0.0, 3.0]), AXIS).visible[0]
    tiny = {"log_scales": [np.log(1e-5)] * 3}
    on_center = project(single(means=[0.0, 0.0, 3.0], **tiny), AXIS)
    assert on_center.visible[0]
    between = dataclasses.replace(AXIS, cx=32.0)
    assert not project(single(means=[0.0, 0.0, 3.0], **tiny), between).visible[0]

# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled projection: columns and boxes against torch, for any threads, memory and neighbours."""

from __future__ import annotations

import dataclasses
import tracemalloc

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection import (
    RawArrays,
    ScreenGaussians,
    allocate_visible,
    project_arrays,
    project_backward_visible,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.reference import reference_projection
from gaussian_wrapping_addon.core.render.types import RenderOptions
from tests.core.render.first_principles import TRAINED
from tests.core.render.projections import CAMERA, OPTIONS, project
from tests.core.render.scenes import random_gaussians


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
    scratch = allocate_visible(raw, 20_000)
    project_backward_visible(raw, CAMERA, OPTIONS, screen, grad_params, ids, scratch)
    tracemalloc.start()
    project_gaussians(raw, CAMERA, OPTIONS, screen)
    project_backward_visible(raw, CAMERA, OPTIONS, screen, grad_params, ids, scratch)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20_000  # bytes: less than one for each Gaussian

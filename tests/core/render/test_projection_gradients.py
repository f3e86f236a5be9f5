# SPDX-License-Identifier: GPL-3.0-or-later
"""Gradient of the compiled projection against autograd, of all or only of visible Gaussians."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection import (
    RawArrays,
    RawGradients,
    allocate_visible,
    project_backward,
    project_backward_visible,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.reference import reference_projection
from gaussian_wrapping_addon.core.render.types import RenderOptions

from .first_principles import TRAINED
from .projections import CAMERA, OPTIONS, project
from .scenes import random_gaussians


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
    scratch = allocate_visible(raw, 300)
    for ids in (seen, seen[3:50], seen[:1], seen[:0], np.arange(300, dtype=np.int32)):
        for name in TRAINED:
            getattr(scratch, name)[:] = np.nan
        for threads in (1, 3):
            chosen = dataclasses.replace(options, threads=threads)
            part = project_backward_visible(raw, CAMERA, chosen, screen, grad_params, ids, scratch)
            assert part.ids is ids
            for name in TRAINED:
                got = getattr(part, name)
                np.testing.assert_array_equal(got, getattr(dense, name)[ids], err_msg=name)
                assert np.isnan(getattr(scratch, name)[len(ids) :]).all()
                assert np.shares_memory(got, getattr(scratch, name)) or not len(ids)
            # Coefficients above the degree used.
            assert not part.sh[:, 4:].any()


def test_scratch_of_another_shape_is_refused() -> None:
    raw = RawArrays.from_gaussians(random_gaussians(9, 4, dtype=torch.float32))
    screen = project_gaussians(raw, CAMERA, OPTIONS)
    ids, grad = np.arange(9, dtype=np.int32), np.zeros((9, 24), np.float32)
    small = allocate_visible(raw, 8)
    other = allocate_visible(dataclasses.replace(raw, sh=raw.sh[:, :4]), 9)
    for scratch in (small, other):
        with pytest.raises(UsageError, match="scratch"):
            project_backward_visible(raw, CAMERA, OPTIONS, screen, grad, ids, scratch)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Bands of tiles respect the budget and do not change results; later renderings reuse memory."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.parallel import ArrayStore
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.render import project_view
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import (
    INTERSECTION_BYTES,
    ViewPass,
    ViewRenderer,
)
from tests.core.render.scenes import isotropic, look_at, random_gaussians
from tests.core.render.test_views import assert_equal, image_gradients, run

CAMERA = look_at((2.2, 1.0, 0.8), width=85, height=70, focal=80.0)
INTERSECTION_ARRAYS = (
    "gaussian ids",
    "intersection slots",
    "masks",
    "intersections",
    "intersection weights",
)
ROUNDED = 2e-6
"""Relative L2 difference that another order of float32 sums of tens of pairs makes."""

WARM_BYTES = 128 * 1024
"""More than the tables of constant size that sorting and threads allocate."""


def scene(count: int = 250) -> OrientedGaussians:
    """Return Gaussians of very different sizes."""
    return random_gaussians(count, 2, dtype=torch.float32, scale=(0.01, 0.4))


@pytest.mark.parametrize("budget_intersections", [1, 150, 400])
def test_budgets_change_gradients_by_rounding_only(budget_intersections: int) -> None:
    whole = run(ViewRenderer(), scene(), CAMERA, statistics=True)
    renderer = ViewRenderer()
    budget = budget_intersections * INTERSECTION_BYTES
    parts = run(renderer, scene(), CAMERA, statistics=True, budget_bytes=budget)
    raw = RawArrays.from_gaussians(scene())
    view = renderer.render(raw, CAMERA, RenderOptions(statistics=True, budget_bytes=budget))
    assert view.bands > 2
    assert parts.keys() == whole.keys()
    for name, exact in whole.items():
        if exact.dtype != np.float32 or name in ("color", "alpha", "depth", "weight_max"):
            np.testing.assert_array_equal(parts[name], exact, err_msg=name)
        else:
            difference = np.linalg.norm(parts[name].astype(np.float64) - exact)
            assert difference <= ROUNDED * np.linalg.norm(exact), name


def test_bands_are_bitwise_the_same_for_any_number_of_threads() -> None:
    options = {"statistics": True, "budget_bytes": 150 * INTERSECTION_BYTES}
    one = run(ViewRenderer(), scene(), CAMERA, threads=1, **options)
    for threads in (2, 4):
        assert_equal(run(ViewRenderer(), scene(), CAMERA, threads=threads, **options), one)


@pytest.mark.parametrize("budget_intersections", [150, 400])
def test_what_grows_with_pairs_stays_within_the_budget(budget_intersections: int) -> None:
    view = project_view(RawArrays.from_gaussians(scene()), CAMERA, RenderOptions(threads=1))
    assert np.diff(view.lists.start).max() < 150
    budget = budget_intersections * INTERSECTION_BYTES
    renderer = ViewRenderer()
    run(renderer, scene(), CAMERA, statistics=True, budget_bytes=budget)
    used = renderer.store.nbytes(*INTERSECTION_ARRAYS)
    assert 0.5 * budget < used <= budget
    # The names are all there are: a rendering without bands takes more under the same names only.
    whole = ViewRenderer()
    run(whole, scene(), CAMERA, statistics=True)
    grown = {
        name
        for name in whole.store.names()
        if whole.store.nbytes(name) > 1.5 * renderer.store.nbytes(name)
    }
    assert grown == set(INTERSECTION_ARRAYS)


def test_a_warm_renderer_allocates_nothing_that_grows() -> None:
    count = 150_000
    gaussians = random_gaussians(count, 4, dtype=torch.float32, scale=(0.004, 0.02), sh_degree=1)
    raw = RawArrays.from_gaussians(gaussians)
    camera = look_at((2.2, 1.0, 0.8), width=220, height=190, focal=200.0)
    grads = image_gradients(camera)
    renderer = ViewRenderer()
    for options in (RenderOptions(threads=2, statistics=True), RenderOptions(threads=2)):

        def iteration(options: RenderOptions = options) -> ViewPass:
            view = renderer.render(raw, camera, options)
            view.backward(grads)
            return view

        iteration()
        iteration()
        tracemalloc.start()
        try:
            view = iteration()
            _, peak_bytes = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        # Less than one byte a Gaussian or a seen one, four a pixel, or one a pair.
        assert peak_bytes < WARM_BYTES
    assert min(count, len(view.ids), 4 * view.alpha.size) > WARM_BYTES
    assert renderer.store.nbytes("intersections") // INTERSECTION_BYTES > WARM_BYTES


def test_lists_of_contributors_end_where_the_light_does() -> None:
    # More layers than contribute: each takes just over 1/255, so 1e-4 is left after about 2300.
    count = 5000
    means = [(0.0, 0.001 * layer, 0.0) for layer in range(count)]
    gaussians = isotropic(means, [3.0] * count, [1.05 / 255.0] * count, torch.float32)
    camera = look_at((0.0, -8.0, 0.0), width=4, height=4, focal=400.0)
    renderer = ViewRenderer()
    view = renderer.render(RawArrays.from_gaussians(gaussians), camera, RenderOptions(threads=1))
    assert len(view.ids) == count
    assert (view.alpha > 1.0 - 1.05e-4).all()
    assert (view.depth > 0.0).all()
    (lists,) = renderer.buffers.lists
    assert 2**20 < lists.nbytes < 13 * 2**20


def test_stored_arrays_keep_their_memory_while_it_is_enough() -> None:
    store = ArrayStore()
    first = store.take("a", (10, 3), np.float32)
    first[:] = 1.0
    assert store.take("a", (4, 6), np.float32).base is first.base
    assert store.take("b", (10, 3), np.float32).base is not first.base
    assert not store.zeros("a", (10, 3), np.float32).any()
    grown = store.take("a", (100, 3), np.float32)
    assert grown.base is not first.base
    assert grown.flags.c_contiguous
    assert store.nbytes("a") >= grown.nbytes
    assert store.take("c", 100, np.int32, 110).base.nbytes == 440
    assert store.take("c", 120, np.int32, 110).base.nbytes == 480

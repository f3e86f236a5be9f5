# SPDX-License-Identifier: GPL-3.0-or-later
"""CUDA kernels, emulated on the host, equal definition and CPU kernels on generic scenes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.render.cuda.device_view import KEPT_BYTES, PASSING_BYTES
from gaussian_wrapping_addon.core.render.reference import render_reference
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import RenderOptions

from ..scenes import look_at, random_gaussians
from .comparison import (
    Outcome,
    assert_bitwise_equal,
    assert_same_gradients,
    assert_same_images,
    depth_weights,
    emulated,
    outcome,
    random_weights,
    relative_l2,
)
from .emulation import EmulatedKernels

BACKGROUND = (0.2, 0.5, 0.1)
# Several tiles, odd sizes, exactly one tile, less than one tile.
SCENES = [(60, 40, 30), (150, 33, 17), (40, 16, 16), (25, 7, 5)]


def scene(count: int, width: int, height: int):  # type: ignore[no-untyped-def]
    gaussians = random_gaussians(count, seed=count, dtype=torch.float32)
    return gaussians, look_at((2.2, 1.0, 0.8), width=width, height=height, focal=1.1 * width)


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("size", SCENES)
def test_images_and_gradients_equal_the_definition(
    emulator_library: Path, size: tuple[int, int, int], depth: bool
) -> None:
    gaussians, camera = scene(*size)
    options = RenderOptions(background=BACKGROUND, depth=depth)
    well = (
        depth_weights(EmulatedKernels(emulator_library), gaussians, camera, options)
        if depth
        else None
    )
    weights = random_weights(camera, options, well)
    found = outcome(
        emulated(EmulatedKernels(emulator_library)), gaussians, camera, options, weights=weights
    )
    exact = outcome(
        render_reference, gaussians, camera, options, weights=weights, dtype=torch.float64
    )
    assert bool(exact.images["depth"].any()) == depth
    assert_same_images(found, exact)
    assert_same_gradients(found, exact)


@pytest.mark.parametrize("size", SCENES)
def test_everything_equals_the_cpu_kernels(
    emulator_library: Path, size: tuple[int, int, int]
) -> None:
    gaussians, camera = scene(*size)
    options = RenderOptions(background=BACKGROUND, statistics=True, threads=1)
    well = depth_weights(EmulatedKernels(emulator_library), gaussians, camera, options)
    weights = random_weights(camera, options, well)
    found = outcome(
        emulated(EmulatedKernels(emulator_library)), gaussians, camera, options, weights=weights
    )
    cpu = outcome(render, gaussians, camera, options, weights=weights)
    assert_same_images(found, cpu)
    assert_same_gradients(found, cpu)
    assert_same_statistics(found, cpu)


def assert_same_statistics(found: Outcome, cpu: Outcome) -> None:
    a, b = found.render.statistics, cpu.render.statistics
    assert a is not None
    assert b is not None
    assert np.array_equal(a.visible, b.visible)
    assert np.allclose(a.radii_px, b.radii_px, rtol=1e-6)
    for name in ("weight_sum", "weight_max", "grad_px", "grad_abs_px"):
        x, y = getattr(a, name), getattr(b, name)
        assert x.dtype == y.dtype
        assert np.abs(x - y).max() <= 1e-4 * np.abs(y).max(), name
    assert a.strongest is not None
    assert b.strongest is not None
    assert a.strongest.dtype == b.strongest.dtype
    # Two equal weights may be ordered either way by rounding.
    assert (a.strongest == b.strongest).mean() > 0.99


def test_screen_gradients_alone_are_those_of_the_cpu(emulator_library: Path) -> None:
    gaussians, camera = scene(150, 33, 17)
    options = RenderOptions(background=BACKGROUND, depth=False, screen_gradients=True)
    weights = random_weights(camera, options)
    kernels = EmulatedKernels(emulator_library)
    found = outcome(emulated(kernels), gaussians, camera, options, weights=weights)
    cpu = outcome(render, gaussians, camera, options, weights=weights)
    a, b = found.render.statistics, cpu.render.statistics
    assert a is not None
    assert b is not None
    assert np.array_equal(a.visible, b.visible)
    assert np.allclose(a.radii_px, b.radii_px, rtol=1e-6)
    for name in ("grad_px", "grad_abs_px"):
        x, y = getattr(a, name), getattr(b, name)
        assert x.dtype == y.dtype
        assert y[b.visible].min() > 0
        assert np.abs(x - y).max() <= 1e-4 * np.abs(y).max(), name
    # The sums of blending weights were not asked for.
    assert len(a.weight_sum) == len(b.weight_sum) == 0
    assert len(a.weight_max) == len(b.weight_max) == 0
    assert a.strongest is None
    assert b.strongest is None
    assert_same_gradients(found, cpu)
    every = dataclasses.replace(options, statistics=True)
    whole = outcome(emulated(kernels), gaussians, camera, every, weights=weights)
    for name in ("visible", "radii_px", "grad_px", "grad_abs_px"):
        assert np.array_equal(getattr(a, name), getattr(whole.render.statistics, name)), name


def test_rows_that_overflow_are_dropped_and_large_ones_have_norms(emulator_library: Path) -> None:
    kernels = EmulatedKernels(emulator_library)
    rows = torch.zeros((5, 24))
    rows[0, [0, 1, 22, 23]] = torch.tensor([3.0, -4.0, 6.0, 8.0])
    rows[1, [0, 22]] = 1e25  # its square overflows float32
    rows[2, 0], rows[2, 5] = 1.0, float("nan")
    rows[3, 0], rows[3, 7] = 1.0, float("-inf")
    rows[4, 4], rows[4, 22] = 7.0, 2.0
    kept, (grad_px, grad_abs_px) = rows.clone(), torch.full((2, 5), -1.0)
    kernels.launch_each("finish_params", 5, 1, kept, grad_px, grad_abs_px)
    assert torch.allclose(grad_px, torch.tensor([5.0, 1e25, 0.0, 0.0, 0.0]))
    assert torch.allclose(grad_abs_px, torch.tensor([10.0, 1e25, 0.0, 0.0, 2.0]))
    wanted = rows.clone()
    wanted[2:4], wanted[:, 22:] = 0.0, 0.0
    assert torch.equal(kept, wanted)
    nothing = torch.empty(0)
    kernels.launch_each("finish_params", 5, 0, rows, nothing, nothing)
    assert torch.equal(rows[:, :22], wanted[:, :22])


def test_lower_harmonics_and_their_gradient(emulator_library: Path) -> None:
    camera = look_at((2.2, 1.0, 0.8), width=20, height=18, focal=24.0)
    for stored, used in ((0, None), (1, None), (3, None), (3, 1), (2, 0)):
        gaussians = random_gaussians(30, seed=9, dtype=torch.float32, sh_degree=stored)
        options = RenderOptions(depth=False, sh_degree=used)
        weights = random_weights(camera, options)
        kernels = EmulatedKernels(emulator_library)
        found = outcome(emulated(kernels), gaussians, camera, options, weights=weights)
        cpu = outcome(render, gaussians, camera, options, weights=weights)
        assert_same_images(found, cpu)
        assert_same_gradients(found, cpu, 3e-5)
        last = (stored if used is None else used) + 1
        assert not found.gradients["sh"][:, last * last :].any()


def test_the_same_bits_in_every_run_and_any_order_of_threads(emulator_library: Path) -> None:
    gaussians = random_gaussians(120, seed=2, dtype=torch.float32, scale=(0.02, 0.25))
    camera = look_at((2.2, 1.0, 0.8), width=50, height=35, focal=60.0)
    options = RenderOptions(statistics=True)
    weights = random_weights(camera, options)
    runs = [
        outcome(
            emulated(EmulatedKernels(emulator_library, backwards=backwards)),
            gaussians, camera, options, weights=weights,
        )
        for backwards in (False, True, False)
    ]  # fmt: skip
    assert_bitwise_equal(runs[1], runs[0])
    assert_bitwise_equal(runs[2], runs[0])


def test_the_hardwares_approximations_stay_within_tolerance(emulator_library: Path) -> None:
    # exp and quotients disturbed by their documented bounds, signs mixed.
    gaussians, camera = scene(150, 33, 17)
    options = RenderOptions(background=BACKGROUND)
    well = depth_weights(EmulatedKernels(emulator_library), gaussians, camera, options)
    weights = random_weights(camera, options, well)
    rough = outcome(
        emulated(EmulatedKernels(emulator_library, ulp=1.0)), gaussians, camera, options,
        weights=weights,
    )  # fmt: skip
    exact = outcome(
        render_reference, gaussians, camera, options, weights=weights, dtype=torch.float64
    )
    assert_same_images(rough, exact)
    assert_same_gradients(rough, exact)


def test_bands_change_only_the_order_of_sums(emulator_library: Path) -> None:
    gaussians = random_gaussians(120, seed=2, dtype=torch.float32, scale=(0.02, 0.25))
    camera = look_at((2.2, 1.0, 0.8), width=50, height=70, focal=60.0)
    options = RenderOptions(statistics=True)
    weights = random_weights(camera, options)
    kernels = EmulatedKernels(emulator_library)
    whole = outcome(emulated(kernels), gaussians, camera, options, weights=weights)
    kept = 2 * KEPT_BYTES * pair_count(whole)
    banded = outcome(emulated(kernels, kept), gaussians, camera, options, weights=weights)
    assert kept // 2 // PASSING_BYTES < pair_count(whole), "the budget asks for several bands"
    for name, image in whole.images.items():
        assert torch.equal(banded.images[name], image), name
    for name, gradient in whole.gradients.items():
        assert relative_l2(banded.gradients[name], gradient) < 1e-5, name
    assert_same_statistics(banded, whole)
    # Two bytes less, and what has to be kept does not fit; much less, and no row of tiles does.
    for budget, words in ((kept - 2, "tile lists of view"), (2000, "One row of tiles of view")):
        with pytest.raises(ResourceError, match=words):
            emulated(kernels, budget)(gaussians, camera, options)


def pair_count(found: Outcome) -> int:
    """Return how many pairs of Gaussian and tile the view has."""
    return len(found.render.color.grad_fn.view.band_lists[0].gaussian_ids)  # type: ignore[union-attr]

# SPDX-License-Identifier: GPL-3.0-or-later
"""Counts of pixel evaluations equal a count pixel by pixel, and the C++ yardstick the kernels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.evaluations import count_evaluations, reached_rows
from benchmarks.kernel_results import Workload
from benchmarks.kernel_speed import KernelVariant, agreement, runs_of
from benchmarks.workload import surface_gaussians, view
from benchmarks.yardstick.build import NO_COMPILER, compilers, host_instruction_sets, yardsticks
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection.projection import RawArrays
from gaussian_wrapping_addon.core.render.raster.blend import Images, RenderBuffers, ScreenView
from gaussian_wrapping_addon.core.render.render import project_view
from gaussian_wrapping_addon.core.render.types.options import RenderOptions

TILE = 16


def prepared(count: int, width: int, height: int, lanes: int) -> ScreenView:
    """Return a small view of the workload."""
    raw = RawArrays.from_gaussians(surface_gaussians(count))
    with runs_of(lanes):
        return project_view(raw, view(width, height), RenderOptions(threads=1))


def kernel_variant(
    gaussians: OrientedGaussians, width: int, height: int, lanes: int
) -> KernelVariant:
    """Return the kernels on one view of any Gaussians, one thread."""
    workload = Workload(len(gaussians), width, height)
    return KernelVariant(RawArrays.from_gaussians(gaussians), workload, lanes, 1, RenderBuffers())


def count_by_pixels(screen: ScreenView) -> tuple[int, int, np.ndarray]:
    """Return pixels inside ellipses, useful ones, and first and last row of each pair."""
    camera, lists = screen.camera, screen.lists
    rows = np.tile(np.array([1, 0], np.uint8), (len(lists.gaussian_ids), 1))
    inside_total, useful_total = 0, 0
    for tile in range(len(lists.start) - 1):
        top, left = tile // lists.tiles_x * TILE, tile % lists.tiles_x * TILE
        y, x = np.mgrid[top : min(top + TILE, camera.height), left : min(left + TILE, camera.width)]
        through = np.ones(x.shape)
        for k in range(lists.start[tile], lists.start[tile + 1]):
            u, v, qa, qb, qc, px, py, r, s, t, _, opacity = (
                float(value) for value in screen.screen.params[lists.gaussian_ids[k], :12]
            )
            dx, dy = x + 0.5 - u, y + 0.5 - v
            num = qa * dx**2 + qb * dx * dy + qc * dy**2
            den = 1.0 + 2.0 * (px * dx + py * dy) + r * dx**2 + s * dx * dy + t * dy**2
            alpha = np.minimum(opacity * np.exp(-0.5 * num / den), 0.99)
            inside = alpha >= 1.0 / 255.0
            useful = inside & (through >= 1e-4)
            through = np.where(useful, through * (1.0 - alpha), through)
            inside_total, useful_total = inside_total + inside.sum(), useful_total + useful.sum()
            if inside.any():
                rows[k] = np.flatnonzero(inside.any(1))[[0, -1]]
    return int(inside_total), int(useful_total), rows


@pytest.mark.parametrize("lanes", [8, 16])
def test_counts_equal_a_count_by_pixels(lanes: int) -> None:
    screen = prepared(400, 75, 50, lanes)
    found = count_evaluations(screen, lanes)
    inside, useful, rows = count_by_pixels(screen)
    # The ellipses, of two pixels each, are widened by 0.02 pixels.
    assert inside <= found.inside <= 1.06 * inside
    assert found.useful == useful
    given = reached_rows(screen)
    reached = rows[:, 0] <= rows[:, 1]
    assert (given[reached, 0] <= rows[reached, 0]).all()
    assert (given[reached, 1] >= rows[reached, 1]).all()
    assert (given != rows).any(1).mean() < 0.06


@pytest.mark.parametrize("lanes", [8, 16])
def test_counts_are_ordered(lanes: int) -> None:
    found = count_evaluations(prepared(1500, 120, 90, lanes), lanes)
    assert found.useful <= found.inside
    assert found.inside <= min(found.runs_8, found.blocks_4x2)
    assert found.blocks_4x2 <= found.blocks_4x4 <= found.nominal
    assert found.runs_8 <= found.halves_8 <= found.rows_16 <= found.nominal == 256 * found.pairs
    # The kernels leave out nothing that is inside, and cull better than whole tiles.
    assert found.inside <= found.own < 0.6 * found.nominal


def test_opaque_rows_are_not_counted() -> None:
    gaussians = surface_gaussians(60)
    stacked = gaussians.replaced(
        means=gaussians.means * 0.02,
        log_scales=gaussians.log_scales * 0.0 + math.log(3.0),
        opacity_logits=gaussians.opacity_logits * 0.0 + 3.0,
    )
    raw = RawArrays.from_gaussians(stacked)
    screen = project_view(raw, view(40, 30), RenderOptions(threads=1))
    found = count_evaluations(screen, 16)
    assert found.useful <= found.rows_16 < 0.4 * found.nominal


@pytest.mark.skipif(not compilers(), reason=NO_COMPILER)
@pytest.mark.parametrize("number", range(len(host_instruction_sets())))
def test_yardstick_equals_the_kernels(number: int) -> None:
    instructions = host_instruction_sets()[number]
    variant = kernel_variant(surface_gaussians(700), 85, 60, instructions.lanes)
    rows = reached_rows(variant.view)
    for ruler in yardsticks(instructions):
        images = Images.allocate(variant.view.camera, variant.flat.options)
        largest, gradients = agreement(ruler, variant, rows, images)
        assert largest <= 1e-6, ruler.name
        assert gradients <= 1e-5, ruler.name
        assert images.alpha.max() > 0.5


@pytest.mark.skipif(not compilers(), reason=NO_COMPILER)
def test_a_yardstick_that_differs_is_refused() -> None:
    instructions = host_instruction_sets()[0]
    variant = kernel_variant(surface_gaussians(700), 85, 60, instructions.lanes)
    rows = reached_rows(variant.view)
    rows[: len(rows) // 2] = (1, 0)
    images = Images.allocate(variant.view.camera, variant.flat.options)
    with pytest.raises(RuntimeError, match="it measures nothing"):
        agreement(yardsticks(instructions)[0], variant, rows, images)

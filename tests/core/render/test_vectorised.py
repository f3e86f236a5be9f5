# SPDX-License-Identifier: GPL-3.0-or-later
"""Kernels compile to packed arithmetic; an edit can silently disable that."""

from __future__ import annotations

import functools
import platform
import re
from typing import Any

import llvmlite.binding
import numba
import pytest
import torch

from gaussian_wrapping_addon.core.render import projection, projection_kernels, raster
from gaussian_wrapping_addon.core.render.depth_query import query_gradient_range
from gaussian_wrapping_addon.core.render.query_kernels import query_range
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.simd import vector_lanes
from gaussian_wrapping_addon.core.render.types import RenderOptions
from tests.core.render.comparisons import leaves
from tests.core.render.query_autograd import query_depth
from tests.core.render.query_scenes import scene
from tests.core.render.scenes import look_at, random_gaussians

PACKED = re.compile(r"\bvfn?m(?:add|sub)\d+ps\b.*%[yz]mm")
SINGLE = re.compile(r"\bvfn?m(?:add|sub)\d+ss\b")


def compiled_anew(kernel: Any, signature: Any) -> str:
    """Compile a kernel, since cached code keeps no listing; return its assembly."""
    options = {k: v for k, v in kernel.targetoptions.items() if k != "nopython"}
    fresh = numba.njit(**options)(kernel.py_func)
    fresh.compile(signature)
    return str(fresh.inspect_asm(fresh.signatures[0]))


@functools.cache
def listing_of(kernel: Any) -> str:
    return compiled_anew(kernel, kernel.signatures[0])


def assert_packed(kernel: Any, least: int) -> None:
    """Count packed and single FMAs of a kernel."""
    listing = listing_of(kernel)
    assert len(PACKED.findall(listing)) >= least
    assert len(SINGLE.findall(listing)) < len(PACKED.findall(listing))


@pytest.fixture(scope="module", autouse=True)
def _compiled() -> None:
    machine = platform.machine().lower()
    if machine not in ("x86_64", "amd64"):
        pytest.skip(f"packed FMA is looked for in x86 code; this machine is {machine}")
    if not llvmlite.binding.get_host_cpu_features().get("fma"):
        pytest.skip("this processor has no FMA instructions")
    gaussians = random_gaussians(20, dtype=torch.float32)
    gaussians = gaussians.replaced(means=gaussians.means.clone().requires_grad_())
    camera = look_at((2.2, 1.0, 0.8), width=16, height=16)
    for depth in (False, True):
        out = render(gaussians, camera, RenderOptions(depth=depth, threads=1))
        (out.color.sum() + out.depth.sum()).backward()


def test_rendering_is_packed() -> None:
    lanes = vector_lanes()
    # Nine channels, six for the exponential, four for the conic and the quadratic.
    assert_packed(raster.forward_kernel(lanes, False, False), 19)
    # Blending in three loops, and the solver's exponential and products.
    assert_packed(raster.forward_kernel(lanes, True, False), 3 * 19 + 9)
    # Two exponentials, the conic, nine products with the loss, and most of the sums.
    assert_packed(raster.backward_kernel(lanes, True, False), 40)


def test_queries_use_packed_arithmetic() -> None:
    gaussians, camera = scene("generic")
    leaf = leaves(gaussians, torch.float32)
    query_depth(leaf, camera, torch.full((1, 2), 20.0)).sum().backward()
    assert_packed(query_range, 30)
    assert_packed(query_gradient_range, 40)


def test_no_reference_is_counted_in_the_inner_loops() -> None:
    # numba's reference counts are atomic and clobber all vector registers; a branch around an
    # inlined helper is enough to bring them back into the loops.
    for kernel in (
        raster.backward_kernel(vector_lanes(), True, False),
        raster.forward_kernel(vector_lanes(), True, False),
    ):
        blocks = re.split(r"^\.L\w+:|^\w+:", listing_of(kernel), flags=re.MULTILINE)
        hot = [block for block in blocks if len(PACKED.findall(block)) >= 10]
        assert hot
        assert not any("NRT_" in block for block in hot)


ARITHMETIC = r"\bv(?:fn?m(?:add|sub)\d+|mul|add|sub|div|sqrt)"
PACKED_DOUBLES = re.compile(ARITHMETIC + r"pd\b.*%[yz]mm")
SINGLE_DOUBLES = re.compile(ARITHMETIC + r"sd\b")
FUSED = re.compile(r"\bvfn?m(?:add|sub)\d+pd\b.*%[yz]mm")
SPILLED = re.compile(r"\bcall\w*\b")


@pytest.mark.parametrize(
    ("kernel", "with_camera", "fused"),
    [
        # Fused operations that the formulas need at least; each stands for a whole block.
        (projection_kernels.activate_block, True, 60),
        (projection_kernels._project_shapes, True, 80),
        (projection._shape_gradients, True, 120),
        (projection._raw_gradients, False, 50),
    ],
)
def test_blocks_are_packed(kernel: Any, with_camera: bool, fused: int) -> None:
    listing = compiled_anew(kernel, (numba.float64[::1],) * (2 if with_camera else 1))
    # The function itself, without the wrappers that Python calls it through.
    body = listing[: listing.index("_ZN7cpython")]
    assert len(FUSED.findall(body)) >= fused
    # A few scalars are computed once per block from the camera; no lane is done alone.
    assert len(SINGLE_DOUBLES.findall(body)) <= 12
    assert len(PACKED_DOUBLES.findall(body)) > 10 * len(SINGLE_DOUBLES.findall(body))
    # A scalar function of the mathematical library would be a call.
    assert not SPILLED.search(body)

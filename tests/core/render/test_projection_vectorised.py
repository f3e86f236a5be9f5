# SPDX-License-Identifier: GPL-3.0-or-later
"""The projection compiles to packed float64 arithmetic; an edit can silently disable that."""

from __future__ import annotations

import platform
import re
from typing import Any

import llvmlite.binding
import numba
import pytest

from gaussian_wrapping_addon.core.render import projection, projection_kernels

ARITHMETIC = r"\bv(?:fn?m(?:add|sub)\d+|mul|add|sub|div|sqrt)"
PACKED = re.compile(ARITHMETIC + r"pd\b.*%[yz]mm")
SINGLE = re.compile(ARITHMETIC + r"sd\b")
FUSED = re.compile(r"\bvfn?m(?:add|sub)\d+pd\b.*%[yz]mm")
SPILLED = re.compile(r"\bcall\w*\b")


@pytest.fixture(scope="module", autouse=True)
def _this_processor() -> None:
    machine = platform.machine().lower()
    if machine not in ("x86_64", "amd64"):
        pytest.skip(f"packed FMA is looked for in x86 code; this machine is {machine}")
    if not llvmlite.binding.get_host_cpu_features().get("fma"):
        pytest.skip("this processor has no FMA instructions")


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
    options = {k: v for k, v in kernel.targetoptions.items() if k != "nopython"}
    fresh = numba.njit(**options)(kernel.py_func)
    values = numba.float64[::1]
    signature = (values, values) if with_camera else (values,)
    fresh.compile(signature)
    # The function itself, without the wrappers that Python calls it through.
    listing = str(fresh.inspect_asm(fresh.signatures[0]))
    body = listing[: listing.index("_ZN7cpython")]
    assert len(FUSED.findall(body)) >= fused
    # A few scalars are computed once per block from the camera; no lane is done alone.
    assert len(SINGLE.findall(body)) <= 12
    assert len(PACKED.findall(body)) > 10 * len(SINGLE.findall(body))
    # A scalar function of the mathematical library would be a call.
    assert not SPILLED.search(body)

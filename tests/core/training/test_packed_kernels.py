# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses and optimiser compile to SIMD arithmetic, which small edits can disable silently."""

from __future__ import annotations

import functools
import platform
import re
from typing import Any

import llvmlite.binding
import numba
import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core import image_metrics
from gaussian_wrapping_addon.core.training import adam, losses
from gaussian_wrapping_addon.core.training.adam import Adam
from gaussian_wrapping_addon.core.training.losses import color_loss, normal_losses
from tests.core.render.scenes import look_at, random_gaussians
from tests.core.render.test_vectorised import PACKED, SINGLE
from tests.core.training.test_adam import all_rates, random_gradients


@functools.cache
def single_precision_listing(kernel: Any) -> str:
    """Compile a kernel anew for float32, as cached code keeps no listing; return its assembly."""
    options = {k: v for k, v in kernel.targetoptions.items() if k != "nopython"}
    fresh = numba.njit(**options)(kernel.py_func)
    double = numba.float64[:, ::1]
    # The third argument is the image that decides the precision.
    signature = next(s for s in kernel.signatures if s[2] != double)
    fresh.compile(signature)
    return str(fresh.inspect_asm(signature))


@pytest.fixture(scope="module", autouse=True)
def _compiled() -> None:
    machine = platform.machine().lower()
    if machine not in ("x86_64", "amd64"):
        pytest.skip(f"packed FMA is looked for in x86 code; this machine is {machine}")
    if not llvmlite.binding.get_host_cpu_features().get("fma"):
        pytest.skip("this processor has no FMA instructions")
    one, three = np.ones((12, 16), np.float32), np.ones((12, 16, 3), np.float32)
    color_loss(three, np.zeros((12, 16, 3), np.uint8), threads=1)
    camera = look_at((2.2, 1.0, 0.8), width=16, height=12)
    normal_losses(one, three, three, one, camera, threads=1)
    adam = Adam(random_gaussians(9, dtype=torch.float32))
    adam.step_rows(random_gradients(adam, 0), all_rates(adam), threads=1)


def test_windows_are_filtered_and_compared_in_packs() -> None:
    listing = single_precision_listing(image_metrics.compare_rows)
    packed, single = len(PACKED.findall(listing)), len(SINGLE.findall(listing))
    # Six products a window along, twelve for two windows across in each of six turns of the ring.
    assert packed >= 2 * 6 + 2 * 6 * 12 - 14
    assert single < packed
    assert "gather" not in listing


def test_normals_are_compared_in_packs() -> None:
    listing = single_precision_listing(losses.agreement_rows)
    assert len(PACKED.findall(listing)) >= 40
    assert re.search(r"\bvr?sqrt(14)?ps\b.*%[yz]mm", listing)
    assert "gather" not in listing


def test_rows_are_stepped_in_packs() -> None:
    listing = single_precision_listing(adam.adam_rows)
    # One run of the small tensors, one of the harmonics; as many pieces as registers are wide.
    for operation in ("sqrt", "div"):
        assert len(re.findall(rf"\bv{operation}ps\b.*%[yz]mm", listing)) >= 2
        assert not re.search(rf"\bv{operation}ss\b", listing)

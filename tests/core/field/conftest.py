# SPDX-License-Identifier: GPL-3.0-or-later
"""Fields of the vacancy on the processor, an emulated device, and a GPU where there is one."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gaussian_wrapping_addon.core.field.cuda_vacancy import CudaVacancyField
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.render.cuda.kernels import Kernels
from tests.core.device_kernels import DEVICES, kernels_of


def on_kernels(kernels: Kernels) -> Callable[..., CudaVacancyField]:
    """Return what makes fields of emulated kernels."""

    def make(arrays, cameras, **options) -> CudaVacancyField:  # type: ignore[no-untyped-def]
        options = {"device_cache_bytes": 1 << 30, "threads": 1, **options}
        return CudaVacancyField(arrays, cameras, device="cpu", kernels=kernels, **options)

    return make


@pytest.fixture(params=DEVICES)
def cuda_field(request: pytest.FixtureRequest) -> Callable[..., CudaVacancyField]:
    """Return what makes a field of the CUDA kernels."""
    kernels = kernels_of(request.param, request)
    return CudaVacancyField if request.param == "cuda" else on_kernels(kernels)


@pytest.fixture(params=["cpu", *DEVICES])
def make_field(request: pytest.FixtureRequest) -> Callable[..., VacancyField]:
    """Return what makes a field."""
    if request.param == "cpu":
        return VacancyField
    kernels = kernels_of(request.param, request)
    return CudaVacancyField if request.param == "cuda" else on_kernels(kernels)

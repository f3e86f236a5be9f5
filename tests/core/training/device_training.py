# SPDX-License-Identifier: GPL-3.0-or-later
"""Trainings on a device, emulated or a GPU, and what they start from."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.cuda.kernels import Kernels
from gaussian_wrapping_addon.core.training.device_backend import DeviceBackend
from tests.core.device_kernels import kernels_of
from tests.core.training.small_scene import sphere_gaussians


def backend_of(device: str, request: pytest.FixtureRequest) -> DeviceBackend:
    """Return the backend of a value of the parameter ``device``; skip where there is none."""
    kernels = kernels_of(device, request)
    return DeviceBackend.of_gpu(0) if device == "cuda" else emulated_backend(kernels)


def emulated_backend(kernels: Kernels, name: str = "emulated") -> DeviceBackend:
    """Return the backend of emulated kernels."""
    return DeviceBackend(name, kernels, torch.device("cpu"), lambda: 1 << 28, 1 << 22)


def perturbed_sphere(
    count: int, seed: int, *, degree: int = 1, factor: float = 1.0, opacity: float = 0.6
) -> OrientedGaussians:
    """Return Gaussians about a sphere of which every value is off by far more than rounding.

    None is round, black, transparent or opaque: no gradient is only rounding, so that the sign of
    Adam's first step, which is as large as the rate for any gradient, is decided by the photos.
    """
    truth, random = sphere_gaussians(count, opacity=opacity), np.random.default_rng(seed)

    def off(tensor: torch.Tensor, share: float) -> torch.Tensor:
        noise = torch.from_numpy(random.normal(size=tuple(tensor.shape))).float()
        return tensor + factor * share * noise

    sh = torch.cat([truth.sh, torch.zeros(count, (degree + 1) ** 2 - 1, 3)], 1)
    return dataclasses.replace(
        truth,
        means=off(truth.means, 0.03),
        log_scales=off(truth.log_scales, 0.2),
        quats=off(truth.quats, 0.1),
        opacity_logits=off(truth.opacity_logits, 0.5),
        sh=off(sh, 0.1),
        orientation=off(truth.orientation, 0.1),
    )

# SPDX-License-Identifier: GPL-3.0-or-later
"""A device checked by a small rendering; whole views on it; which errors are its failures."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from ..errors import DeviceError, ResourceError
from ..gaussians.model import TRAINED, OrientedGaussians
from ..names import CPU
from ..render.cuda.device_renderer import render_with
from ..render.cuda.kernels import Kernels, device_kernels
from ..render.reference import render_reference
from ..render.types import Render, Renderer, RenderOptions
from ..render.view_renderer import ViewRenderer
from ..scene.camera import Camera

# -- Tell a device's failures from others: what another device, or less memory, would not have met

_WORDS = ("CUDA error", "CUDA driver", "cuBLAS", "CUBLAS")
"""What torch's messages of a failing driver or library contain, whatever their type."""


def is_memory_failure(error: Exception) -> bool:
    """Return whether a device's memory did not suffice."""
    return isinstance(error, (ResourceError, torch.OutOfMemoryError))


def is_device_failure(error: Exception) -> bool:
    """Return whether the device failed: its memory, its driver or its compiler."""
    if is_memory_failure(error) or isinstance(error, DeviceError):
        return True
    return isinstance(error, RuntimeError) and any(word in str(error) for word in _WORDS)


# -- Render a few Gaussians with the CUDA kernels and compare with the definition -----------------

TOLERANCE = 1e-3
"""Of images and, relative to their length, of gradients: far above float32 rounding (below 1e-5
here, with the hardware's approximations), far below what a kernel that does not run gives."""

_BUDGET_BYTES = 1 << 24
_OPTIONS = RenderOptions(depth=True)
_COMPARED = ("color", "normal", "alpha", "depth")


def failure_on(device_index: int) -> str:
    """Return why a GPU's kernels give no right result, ``""`` where they do.

    Compiles the kernels on the first call of the process.
    """
    try:
        return check_kernels(device_kernels(device_index), torch.device("cuda", device_index))
    except (DeviceError, ResourceError) as error:
        return error.message
    except RuntimeError as error:  # torch's errors of the driver and of kernels that fail
        lines = str(error).strip().splitlines()
        return f"The test of the GPU's kernels failed: {lines[0] if lines else 'no message'}."


def check_kernels(kernels: Kernels, device: torch.device) -> str:
    """Compare images and gradients of a small scene; return what differs, ``""`` if nothing."""
    camera = _camera()
    definition = _scene(torch.float64, torch.device("cpu"))
    expected = render_reference(definition, camera, _OPTIONS)
    tested = _scene(torch.float32, device)
    found = render_with(kernels, tested, camera, _OPTIONS, _BUDGET_BYTES)
    for name in _COMPARED:
        gap = float((_on_cpu(getattr(found, name)) - _on_cpu(getattr(expected, name))).abs().max())
        if not gap <= TOLERANCE:  # NaN is no match either
            return f"The GPU renders another {name} than the definition: {gap:.1g} off."
    _loss(expected).backward()
    _loss(found).backward()
    for name in TRAINED:
        wanted = getattr(definition, name).grad
        gap = float((_on_cpu(getattr(tested, name).grad) - wanted).norm() / wanted.norm())
        if not gap <= TOLERANCE:
            return f"The GPU gives another gradient of {name} than the definition: {gap:.1g} off."
    return ""


def _on_cpu(tensor: Tensor) -> Tensor:
    return tensor.detach().to("cpu", torch.float64)


def _loss(images: Render) -> Tensor:
    """Return a number that every image contributes to, each pixel differently."""
    height, width = images.alpha.shape
    weights = torch.linspace(0.5, 1.5, height * width, dtype=torch.float64)
    weights = weights.reshape(height, width).to(images.alpha)
    flat = images.alpha + images.depth + images.color.sum(-1) + images.normal.sum(-1)
    return (weights * flat).sum()


def _camera() -> Camera:
    """Return a camera at the origin that looks along z; the image has tiles with a rest."""
    pose = np.concatenate([np.eye(3), np.zeros((3, 1))], axis=1)
    return Camera("check", 20, 18, 20.0, 20.0, 10.0, 9.0, pose)


def _scene(dtype: torch.dtype, device: torch.device) -> OrientedGaussians:
    """Return Gaussians that all pixels see: no rounding decides whether one contributes."""
    rows = {
        "means": [[0.1, 0.0, 3.0], [-0.4, 0.2, 3.5], [0.3, -0.3, 4.0], [0.0, 0.1, 5.0]],
        "log_scales": [[0.3, 0.2, -1.5], [0.4, 0.3, -1.0], [0.5, 0.4, -1.2], [0.9, 0.9, -0.5]],
        "quats": [[1.0, 0.1, 0.0, 0.1], [1.0, 0.0, 0.2, 0.0], [1.0, -0.1, 0.1, 0.0],
                  [1.0, 0.0, 0.0, 0.3]],
        "opacity_logits": [0.0, 0.3, 0.5, 3.0],
        "sh": [[[0.8, 0.1, -0.3]], [[-0.2, 0.6, 0.2]], [[0.1, -0.4, 0.7]], [[0.3, 0.3, 0.1]]],
        "orientation": [[0.0, 0.1, -1.0, 0.8], [0.2, 0.0, -1.0, 0.5], [0.0, -0.3, -1.0, 1.2],
                        [0.1, 0.1, -1.0, 0.9]],
        "filter_3d": [0.01, 0.01, 0.02, 0.02],
    }  # fmt: skip
    tensors = {
        name: torch.tensor(values, dtype=dtype, device=device, requires_grad=name in TRAINED)
        for name, values in rows.items()
    }
    return OrientedGaussians(**tensors)


# -- Whole views on a job's device, or on the processor where that fails. Worker only: loads torch

_logger = logging.getLogger(__name__)

Made = TypeVar("Made")


def with_renderer(device: str, what: str, work: Callable[[Renderer], Made]) -> Made:
    """Return what work makes of the renderer of a device, ``"cpu"`` or ``"cuda:N"``.

    Where the GPU fails, the log says why (``what`` is rendered, a plural that begins a sentence),
    and the work is done again from its beginning with the renderer of the processor; it must keep
    nothing of a call that has failed.
    """
    if device == CPU:
        return work(ViewRenderer())
    from ..render.cuda.device_renderer import device_renderer

    try:
        renderer = device_renderer(device)
        try:
            return work(renderer)
        finally:
            renderer.release()
    except Exception as error:
        if not is_device_failure(error):
            raise
        lines = str(getattr(error, "message", error)).strip().splitlines()
        reason = lines[0] if lines else type(error).__name__
        _logger.warning("%s are rendered on the processor, not on the GPU: %s", what, reason)
    return work(ViewRenderer())

# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendering speed of this machine, relative to the reference machine of the estimate."""

from __future__ import annotations

import logging
import time
from dataclasses import fields

import numpy as np

from ...dataset.camera import Camera
from ...devices.failures import is_device_failure
from ...errors import WrapError
from ...gaussians.model import OrientedGaussians
from ...kernels.compiled import is_ready
from ...render.projection.projection import RawArrays
from ...render.raster.raster_forward import forward_kernel
from ...render.simd.raster_math import vector_lanes
from ...render.types.gradients import ImageGradients
from ...render.types.options import RenderOptions
from ...render.view_renderer import ViewRenderer
from ..optimizer.adam_kernels import adam_rows

_logger = logging.getLogger(__name__)

GAUSSIANS = 4000
SIDE_PX = 160

REFERENCE_S = 0.0060
"""Time of one pass on the machine of the estimate's measurements (2 threads of an AMD EPYC with
AVX-512). One thread took 8.7 ms, the fastest of many passes under load; from that, two threads of
an idle machine are assumed to need 6 ms."""

THREAD_SPEED = 0.4
"""Of one thread relative to the reference machine's two, where no kernel is compiled to time."""

GPU_GAUSSIANS, GPU_SIDE_PX = 100_000, 800
REFERENCE_GPU_S = 0.0047
"""Time of one pass of :func:`gpu_speed` on an NVIDIA H200."""

PASSES = 12
TIME_LIMIT_S = 0.7
"""No pass starts later than this, so that a slow machine is also timed in about a second."""


def renderer_is_compiled() -> bool:
    """Tell whether the training kernels are cached from an earlier run on this machine."""
    renderer = forward_kernel(vector_lanes(), True, False)
    return is_ready(adam_rows) and is_ready(renderer)


def machine_speed(threads: int) -> float:
    """Return how many times faster than the reference machine one fixed view is rendered.

    Forward with depth, and backward, of 4000 Gaussians on 160 x 160 pixels; the median of a few
    passes, since the training would share a busy machine too, excluding the first, which loads the
    kernels.
    """
    gaussians, camera = _scene(GAUSSIANS, SIDE_PX)
    renderer = ViewRenderer()
    options = RenderOptions(sh_degree=1, threads=threads)
    color = np.full((SIDE_PX, SIDE_PX, 3), 1e-3, np.float32)
    depth = np.full((SIDE_PX, SIDE_PX), 1e-3, np.float32)

    def run() -> None:
        renderer.render(gaussians, camera, options).backward(
            ImageGradients(color=color, depth=depth)
        )

    run()
    taken_s: list[float] = []
    begun_s = time.perf_counter()
    for _ in range(PASSES):
        start_s = time.perf_counter()
        run()
        end_s = time.perf_counter()
        taken_s.append(end_s - start_s)
        if end_s - begun_s > TIME_LIMIT_S:
            break
    return REFERENCE_S / float(np.median(taken_s))


def gpu_speed(index: int) -> float:
    """Return how many times faster than the reference GPU a GPU renders one fixed view.

    Forward with depth, and backward, of 100 000 Gaussians on 800 x 800 pixels.

    Raises
    ------
    DeviceError, ResourceError
        The GPU cannot be used, or its memory is full.
    """
    import torch

    from ...render.cuda.cuda_render import free_budget_bytes
    from ...render.cuda.device_view import DeviceView
    from ...render.cuda.kernels import device_kernels

    device = torch.device("cuda", index)
    raw, camera = _scene(GPU_GAUSSIANS, GPU_SIDE_PX)
    tensors = {f.name: torch.from_numpy(getattr(raw, f.name)).to(device) for f in fields(raw)}
    gaussians, options = OrientedGaussians(**tensors), RenderOptions(sh_degree=1)
    kernels, budget = device_kernels(index), free_budget_bytes(device)
    size = (GPU_SIDE_PX, GPU_SIDE_PX)
    color, depth = (torch.full(shape, 1e-3, device=device) for shape in ((*size, 3), size))
    taken_s = []
    for _ in range(PASSES):
        torch.cuda.synchronize(device)
        begun_s = time.perf_counter()
        view = DeviceView(kernels, gaussians, camera, options, budget)
        view.backward([color, None, None, None, depth])
        torch.cuda.synchronize(device)
        taken_s.append(time.perf_counter() - begun_s)
    return REFERENCE_GPU_S / float(np.median(taken_s))


def speeds(threads: int, device: str) -> tuple[float, float]:
    """Return the speeds of the processor and of the GPU that a training runs on (0: of none)."""
    if device != "cpu":
        return THREAD_SPEED * threads, _gpu_speed_or_reference(device)
    return (machine_speed(threads) if renderer_is_compiled() else 1.0), 0.0


def _gpu_speed_or_reference(device: str) -> float:
    """Return a GPU's speed; 1 where it fails, which the training will meet as well, and tell."""
    try:
        return gpu_speed(int(device.partition(":")[2] or 0))
    except (WrapError, RuntimeError) as error:
        if not is_device_failure(error):
            raise
        _logger.warning("%s could not be timed: %s", device, error)
        return 1.0


def _scene(count: int, side_px: int) -> tuple[RawArrays, Camera]:
    """Return flat Gaussians spread over a ball in front of the camera, always the same."""
    random = np.random.Generator(np.random.PCG64(7))
    means = random.normal(size=(count, 3))
    means *= random.uniform(0.8, 1.0, (count, 1)) / np.linalg.norm(means, axis=1, keepdims=True)
    quats = random.normal(size=(count, 4))
    log_scales = np.log(random.uniform(0.01, 0.06, (count, 3)))
    arrays = {
        "means": means,
        "log_scales": log_scales,
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "opacity_logits": random.normal(1.0, 1.5, count),
        "sh": random.normal(0.0, 0.3, (count, 4, 3)),
        "orientation": np.zeros((count, 4)),
        "filter_3d": np.full(count, 0.005),
    }
    cam_from_world = np.eye(4)[:3]
    cam_from_world[2, 3] = 4.0
    camera = Camera(
        "speed", side_px, side_px, 1.6 * side_px, 1.6 * side_px, 0.5 * side_px, 0.5 * side_px,
        cam_from_world,
    )  # fmt: skip
    return RawArrays(**{k: np.ascontiguousarray(v, np.float32) for k, v in arrays.items()}), camera

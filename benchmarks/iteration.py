# SPDX-License-Identifier: GPL-3.0-or-later
"""Time the parts of one training iteration: ``python -m benchmarks.iteration --help``.

Each part is a named callable. The last rows are whole iterations as the trainer runs them, each
followed by its raster kernels alone (forward and backward) and the ratio of both.
CPU time sums over threads and repeats within a few percent even on a busy machine, so it is what
to compare; wall time depends on who else is running. Both columns are the minimum of the repeats.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

# Torch's idle threads otherwise spin for a while and take the cores from the renderer's.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.training_parts import RASTER, WHOLE, iteration_parts, training_parts
from benchmarks.workload import surface_gaussians, view
from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.kernels.parallel import default_threads
from gaussian_wrapping_addon.core.render.projection.projection import (
    RawArrays,
    RawGradients,
    project_backward,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.raster.blend import (
    Images,
    RenderBuffers,
    blend,
    blend_backward,
)
from gaussian_wrapping_addon.core.render.render import project_view, render
from gaussian_wrapping_addon.core.render.simd.raster_math import vector_lanes
from gaussian_wrapping_addon.core.render.tiling.tiles import bin_gaussians
from gaussian_wrapping_addon.core.render.types.gradients import ImageGradients
from gaussian_wrapping_addon.core.render.types.options import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer

Part = tuple[str, Callable[[], object]]


@dataclasses.dataclass(frozen=True)
class Timing:
    """Smallest times of one part, milliseconds."""

    name: str
    cpu_ms: float
    wall_ms: float


def measure(parts: Sequence[Part], repeats: int) -> list[Timing]:
    """Run all parts in turn ``repeats`` times, after one run that compiles and warms up."""
    best = {name: (float("inf"), float("inf")) for name, _ in parts}
    for repeat in range(repeats + 1):
        for name, run in parts:
            wall, cpu = time.perf_counter(), time.process_time()
            run()
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            if repeat:
                best[name] = min(best[name][0], cpu), min(best[name][1], wall)
    return [Timing(name, 1e3 * cpu, 1e3 * wall) for name, (cpu, wall) in best.items()]


def render_parts(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> list[Part]:
    """Return the renderer's parts, each alone, and the whole through autograd."""
    raw = RawArrays.from_gaussians(gaussians)
    gradients = RawGradients.zeros(raw)
    buffers = RenderBuffers()
    prepared = project_view(raw, camera, options)
    flat = dataclasses.replace(prepared, options=dataclasses.replace(options, depth=False))
    weighted = dataclasses.replace(prepared, options=dataclasses.replace(options, statistics=True))
    images = Images.allocate(camera, weighted.options)
    blend(prepared, images, buffers)
    random = np.random.default_rng(0)
    incoming = [
        random.normal(size=image.shape).astype(np.float32)
        for image in (images.color, images.normal, images.geometric, images.alpha, images.depth)
    ]
    grad_params, _, _ = blend_backward(prepared, images, incoming, buffers, absolute=False)
    screen, threads = prepared.screen, prepared.threads
    leaves = gaussians.replaced(
        **{name: t.clone().requires_grad_(name != "filter_3d") for name, t in gaussians.tensors()}
    )
    renderer, grads = ViewRenderer(), ImageGradients(*incoming)
    counted = dataclasses.replace(options, screen_gradients=True)
    weights = [torch.from_numpy(grad) for grad in incoming]

    def iteration(chosen: RenderOptions) -> None:
        out = render(leaves, camera, chosen, buffers)
        outputs = (out.color, out.normal, out.geometric_normal, out.alpha, out.depth)
        loss = sum((image * weight).sum() for image, weight in zip(outputs, weights, strict=True))
        loss.backward()

    return [
        ("projection forward", lambda: project_gaussians(raw, camera, options)),
        ("binning", lambda: bin_gaussians(screen, camera.width, camera.height, threads)),
        ("projection, binning, rows", lambda: project_view(raw, camera, options)),
        ("raster forward, no depth", lambda: blend(flat, images, buffers)),
        ("raster forward + isosurface", lambda: blend(prepared, images, buffers)),
        ("  the same with weights", lambda: blend(weighted, images, buffers)),
        (
            "raster backward, no depth",
            lambda: blend_backward(flat, images, incoming, buffers, absolute=False),
        ),
        (
            "raster backward with depth",
            lambda: blend_backward(prepared, images, incoming, buffers, absolute=False),
        ),
        (
            "  the same with AbsGS",
            lambda: blend_backward(prepared, images, incoming, buffers, absolute=True),
        ),
        (
            "projection backward",
            lambda: project_backward(raw, camera, options, screen, grad_params, gradients),
        ),
        ("render forward + backward", lambda: iteration(options)),
        (
            "  the same without autograd",
            lambda: renderer.render(raw, camera, options).backward(grads),
        ),
        (
            "  and with screen gradients",
            lambda: renderer.render(raw, camera, counted).backward(grads),
        ),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table of milliseconds per part."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=50_000)
    parser.add_argument("--size", default="400x300", help="WIDTHxHEIGHT in pixels")
    parser.add_argument("--threads", type=int, default=0, help="0 uses every core")
    parser.add_argument("--repeats", type=int, default=8)
    chosen = parser.parse_args(arguments)
    width, height = (int(side) for side in chosen.size.lower().split("x"))
    threads = chosen.threads or default_threads()
    torch.set_num_threads(threads)
    gaussians = surface_gaussians(chosen.gaussians)
    camera = view(width, height)
    parts = render_parts(gaussians, camera, RenderOptions(threads=threads))
    parts += training_parts(gaussians, camera, threads)
    parts += iteration_parts(gaussians, camera, threads)
    print(
        f"{chosen.gaussians} Gaussians, {width} x {height} pixels, {threads} threads, "
        f"runs of {vector_lanes()} pixels, minimum of {chosen.repeats}"
    )
    print(f"{'part':<34}{'CPU ms':>10}{'wall ms':>10}")
    whole = None
    for timing in measure(parts, chosen.repeats):
        line = f"{timing.name:<34}{timing.cpu_ms:>10.1f}{timing.wall_ms:>10.1f}"
        if timing.name.startswith(WHOLE):
            whole = timing
        elif whole is not None and timing.name.startswith(f"  {RASTER}"):
            cpu, wall = whole.cpu_ms / timing.cpu_ms, whole.wall_ms / timing.wall_ms
            line += f"   whole / alone: CPU {cpu:.2f}, wall {wall:.2f}"
        print(line)


if __name__ == "__main__":
    main()

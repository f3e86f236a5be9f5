# SPDX-License-Identifier: GPL-3.0-or-later
"""Peak memory of training-like iterations: ``python -m benchmarks.memory --help``.

Holds what a trainer holds: float32 parameters, two Adam moments of each, gradients of the images
and of the seen Gaussians. Runs rendering, backward and one optimiser step on the seen rows, then
prints the highest resident memory of the process so far (VmHWM, Linux) after each stage.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.workload import surface_gaussians, view
from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import TRAINED
from gaussian_wrapping_addon.core.kernels.parallel import default_threads
from gaussian_wrapping_addon.core.render.projection.projection import RawArrays
from gaussian_wrapping_addon.core.render.types.gradients import ImageGradients, VisibleGradients
from gaussian_wrapping_addon.core.render.types.options import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer

_MIB = 2**20
# Rows an optimiser step works on at once: its temporary arrays stay small.
_STEP_ROWS = 65_536


def resident_mib() -> tuple[float, float]:
    """Return the resident memory of this process and its highest value so far (Linux)."""
    values = {}
    for line in Path("/proc/self/status").read_text().splitlines():
        name, _, rest = line.partition(":")
        if name in ("VmRSS", "VmHWM"):
            values[name] = int(rest.split()[0]) / 1024.0
    return values["VmRSS"], values["VmHWM"]


def image_gradients(camera: Camera) -> ImageGradients:
    """Return gradients of all images, C-contiguous float32."""
    random = np.random.default_rng(0)
    one = (camera.height, camera.width)
    shapes = [(*one, 3)] * 3 + [one] * 2
    return ImageGradients(*(random.standard_normal(size, np.float32) for size in shapes))


def step(
    raw: RawArrays, moments: dict[str, tuple[np.ndarray, np.ndarray]], gradients: VisibleGradients
) -> None:
    """Move the seen rows like Adam, at a rate that leaves the workload what it is."""
    for name in TRAINED:
        values, (first, second) = getattr(raw, name), moments[name]
        for begin in range(0, len(gradients.ids), _STEP_ROWS):
            rows = gradients.ids[begin : begin + _STEP_ROWS]
            gradient = getattr(gradients, name)[begin : begin + _STEP_ROWS]
            first[rows] += 0.1 * (gradient - first[rows])
            second[rows] += 0.001 * (gradient * gradient - second[rows])
            values[rows] -= 1e-9 * first[rows] / (np.sqrt(second[rows]) + 1e-15)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print memory and time of some iterations."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--size", default="1600x1200", help="WIDTHxHEIGHT in pixels")
    parser.add_argument("--degree", type=int, default=3, help="of the spherical harmonics")
    parser.add_argument("--threads", type=int, default=0, help="0 uses every core")
    parser.add_argument(
        "--budget", type=int, default=limits.RENDER_BUDGET_BYTES // _MIB, help="MiB"
    )
    parser.add_argument("--repeats", type=int, default=3)
    chosen = parser.parse_args(arguments)
    width, height = (int(side) for side in chosen.size.lower().split("x"))
    threads = chosen.threads or default_threads()
    camera = view(width, height)
    print(
        f"{chosen.gaussians} Gaussians of degree {chosen.degree}, {width} x {height} pixels, "
        f"budget {chosen.budget} MiB, {threads} threads"
    )

    def report(stage: str) -> None:
        now, peak = resident_mib()
        print(f"{stage:<34}now {now:8.0f} MiB   peak {peak:8.0f} MiB", flush=True)

    report("modules imported")
    raw = RawArrays.from_gaussians(surface_gaussians(chosen.gaussians, sh_degree=chosen.degree))
    # Making the workload takes more than the workload: its peak is not that of the training.
    Path("/proc/self/clear_refs").write_text("5")
    moments = {
        name: (np.zeros_like(getattr(raw, name)), np.zeros_like(getattr(raw, name)))
        for name in TRAINED
    }
    for pair in moments.values():
        for moment in pair:
            moment.fill(0.0)
    grads = image_gradients(camera)
    report("parameters, moments, images")
    renderer = ViewRenderer()
    options = RenderOptions(
        threads=threads, budget_bytes=chosen.budget * _MIB, screen_gradients=True
    )
    for _ in range(chosen.repeats):
        began, cpu = time.perf_counter(), time.process_time()
        image = renderer.render(raw, camera, options)
        middle = time.perf_counter()
        gradients = image.backward(grads)
        spent, cpu = time.perf_counter(), time.process_time() - cpu
        step(raw, moments, gradients)
        report(
            f"{len(gradients.ids)} seen, {image.bands} bands, "
            f"{middle - began:.2f} + {spent - middle:.2f} s, {cpu:.2f} CPU s "
        )


if __name__ == "__main__":
    main()

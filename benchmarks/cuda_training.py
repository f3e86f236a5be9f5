# SPDX-License-Identifier: GPL-3.0-or-later
"""A training iteration on a GPU, part by part: ``python -m benchmarks.cuda_training --help``.

First parity: loss and gradients of the GPU against those of the processor for the smallest case.
Then, for each case, the milliseconds of every part of an iteration (between CUDA events, median),
iterations per second, peak memory, the processor's iteration in the same run, and gsplat's where it
can be imported: its rendering of colours alone, the same colour loss, torch's fused Adam. The
Gaussians are those of ``benchmarks.workload``, made smaller the more there are. Without a GPU it
says why and ends with exit code 1.
"""

from __future__ import annotations

import argparse
import importlib
import math
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from gaussian_wrapping_addon.core.gaussians.model import TRAINED, OrientedGaussians
from gaussian_wrapping_addon.core.parallel import default_threads
from gaussian_wrapping_addon.core.render.cuda.kernels import cuda_available
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.training.adam import Adam, add_image_gradients
from gaussian_wrapping_addon.core.training.backend import Backend, Shown, counts_of
from gaussian_wrapping_addon.core.training.device_backend import chosen_backend
from gaussian_wrapping_addon.core.training.device_losses import device_color_loss
from gaussian_wrapping_addon.core.training.multi_view import MultiViewOptions

from .workload import surface_gaussians, view

REFERENCE_COUNT = 50_000
"""The workload's sizes are for this many Gaussians."""
CASES = ("50000/400x300", "300000/800x600", "1000000/1920x1080")
WARM_UP = 5
SH_DEGREE = 3

Parts = dict[str, list[float]]


class Iteration:
    """One training iteration with every loss, on a backend, always of the same view."""

    def __init__(self, backend: Backend, gaussians: OrientedGaussians, camera: Camera) -> None:
        self.backend, self.camera = backend, camera
        self.adam = backend.adopted(Adam(gaussians))
        self.other = view(camera.width, camera.height)
        photos = _Photo(camera)
        self.shown, self.beside = (backend.shown(photos, i, 1, None) for i in (0, 1))
        self.random = np.random.default_rng(0)
        self.gradients: Any = None
        self.loss = 0.0

    def run(self, lap: Callable[[str], None]) -> None:
        """Run it; ``lap`` is called with the name of every part that was queued."""
        backend, adam = self.backend, self.adam
        options = RenderOptions(depth=True, screen_gradients=True)
        image = backend.render(adam, self.camera, options)
        lap("render, with depth")
        value, gradients, squared = backend.compare_colors(
            image, self.shown, 0.2, exposure=None, background=None, over_emptiness=False
        )
        lap("colour loss")
        normal, by_normals = backend.normal_losses(
            image, self.camera, self.shown, lambda_depth_normal=0.05, lambda_normal=0.03
        )
        gradients = add_image_gradients(by_normals, gradients)
        lap("normal losses")
        shared, by_views, other = backend.compare_views(
            image, adam, self.camera, self.shown, self.other, self.beside,
            MultiViewOptions(), self.random,
        )  # fmt: skip
        gradients = add_image_gradients(gradients, by_views)
        lap("multi-view losses")
        found = backend.backward(image, gradients)
        lap("backward")
        backend.add_priors(image, found, adam, 1e-4, 1e-3)
        if other is not None:
            found = backend.merged(found, other, len(adam))
        lap("priors and sums")
        self.gradients = found
        rates = {name: np.full(_columns(adam, name), 1e-6, np.float32) for name in TRAINED}
        backend.step(adam, found, rates, SH_DEGREE)
        lap("Adam")
        self.loss = float(backend.numbers(value + normal + shared, squared)[0])
        lap("waiting")


class _Photo:
    """A photo of noise for the view and one beside it."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        size = (camera.height, camera.width, 3)
        self._photos = np.random.default_rng(1).integers(0, 256, (2, *size), np.uint8)

    def camera(self, index: int, divisor: int = 1) -> Camera:
        return self._camera

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        photo: np.ndarray = self._photos[index]
        return photo

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        return None


def _columns(adam: Adam, name: str) -> int:
    return math.prod(adam.shape(name)[1:])


def case_gaussians(count: int) -> OrientedGaussians:
    """Return the workload's Gaussians, of a size that covers the same area whatever their count."""
    found = surface_gaussians(count, sh_degree=SH_DEGREE)
    shrink = 0.5 * math.log(REFERENCE_COUNT / count)
    return found.replaced(log_scales=found.log_scales + shrink)


def timed_gpu(work: Iteration, repeats: int) -> tuple[Parts, float]:
    """Return milliseconds of each part of every repeat, and the wall seconds of an iteration."""
    parts: Parts = defaultdict(list)
    for repeat in range(WARM_UP + repeats):
        events = [_event()]
        names: list[str] = []

        def lap(name: str, events: list[Any] = events, names: list[str] = names) -> None:
            events.append(_event())
            names.append(name)

        work.run(lap)
        torch.cuda.synchronize()
        if repeat >= WARM_UP:
            for name, begin, end in zip(names, events, events[1:], strict=False):
                parts[name].append(begin.elapsed_time(end))
    torch.cuda.synchronize()
    begun_s = time.perf_counter()
    for _ in range(repeats):
        work.run(lambda _: None)
    torch.cuda.synchronize()
    return parts, (time.perf_counter() - begun_s) / repeats


def timed_cpu(work: Iteration, repeats: int) -> float:
    """Return the smallest wall seconds of an iteration."""
    best = math.inf
    for _ in range(repeats + 1):
        begun_s = time.perf_counter()
        work.run(lambda _: None)
        best = min(best, time.perf_counter() - begun_s)
    return best


def timed_colors(backend: Any, gaussians: OrientedGaussians, camera: Camera, repeats: int) -> float:
    """Return the wall seconds of our iteration with colours alone, as gsplat's below."""
    work = Iteration(backend, gaussians, camera)
    rates = {name: np.full(_columns(work.adam, name), 1e-6, np.float32) for name in TRAINED}
    options = RenderOptions(depth=False, screen_gradients=True)

    def step() -> None:
        image = backend.render(work.adam, camera, options)
        value, gradients, squared = backend.compare_colors(
            image, work.shown, 0.2, exposure=None, background=None, over_emptiness=False
        )
        backend.step(work.adam, backend.backward(image, gradients), rates, SH_DEGREE)
        backend.numbers(value, squared)

    return _wall(step, repeats)


def timed_gsplat(
    backend: Any, gaussians: OrientedGaussians, camera: Camera, repeats: int
) -> float | str:
    """Return the wall seconds of an iteration by gsplat, or why there are none."""
    try:
        rendering = importlib.import_module("gsplat.rendering")
    except Exception as error:
        return f"gsplat cannot be imported: {error}"
    device = torch.device("cuda")
    leaves = {
        name: getattr(gaussians, name).to(device, copy=True).requires_grad_()
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh")
    }
    optimizer = torch.optim.Adam([*leaves.values()], lr=1e-6, fused=True)
    pose = torch.eye(4, device=device)
    pose[:3] = torch.as_tensor(camera.cam_from_world)
    lens = torch.tensor(
        [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]], device=device
    )
    shown: Shown = backend.shown(_Photo(camera), 0, 1, None)
    photo = shown.photo.float() / 255.0
    counts = counts_of(None, camera.height, camera.width)

    def step() -> None:
        color, _, _ = rendering.rasterization(
            leaves["means"], leaves["quats"], leaves["log_scales"].exp(),
            leaves["opacity_logits"].sigmoid(), leaves["sh"], pose[None], lens[None],
            camera.width, camera.height, sh_degree=SH_DEGREE, packed=False, absgrad=True,
        )  # fmt: skip
        value, gradient, _ = device_color_loss(
            backend.kernels, color[0].detach().contiguous(), photo, None,
            lambda_dssim=0.2, counts=counts,
        )  # fmt: skip
        color[0].backward(gradient)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        float(value)

    return _wall(step, repeats)


def _wall(step: Callable[[], None], repeats: int) -> float:
    for _ in range(WARM_UP):
        step()
    torch.cuda.synchronize()
    begun_s = time.perf_counter()
    for _ in range(repeats):
        step()
    torch.cuda.synchronize()
    return (time.perf_counter() - begun_s) / repeats


def _event() -> Any:
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def parity(gpu: Backend, cpu: Backend, gaussians: OrientedGaussians, camera: Camera) -> None:
    """Print how loss and gradients of one iteration differ."""
    found, wanted = Iteration(gpu, gaussians, camera), Iteration(cpu, gaussians, camera)
    for work in (found, wanted):
        work.run(lambda _: None)
    print(f"parity: loss {found.loss:.7f} on the GPU, {wanted.loss:.7f} on the processor")
    rows = wanted.gradients
    for name in TRAINED:
        whole = np.zeros(tuple(getattr(gaussians, name).shape))
        whole[rows.ids] = getattr(rows, name)
        off = found.gradients[name].cpu().double().numpy() - whole
        print(f"  d / d {name:<15} L2-relative {np.linalg.norm(off) / np.linalg.norm(whole):.1e}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=list(CASES), help="GAUSSIANS/WIDTHxHEIGHT")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--cpu-repeats", type=int, default=2, help="0: no processor")
    chosen = parser.parse_args(arguments)
    usable, reason = cuda_available()
    if not usable:
        print(f"No figures: {reason}", file=sys.stderr)
        return 1
    print(f"{reason} Processor: {default_threads()} threads. Median of {chosen.repeats} repeats.")
    gpu: Any = chosen_backend("cuda:0", default_threads())
    cpu = chosen_backend("cpu", default_threads())
    for number, case in enumerate(chosen.cases):
        count, _, size = case.partition("/")
        width, height = (int(side) for side in size.lower().split("x"))
        gaussians, camera = case_gaussians(int(count)), view(width, height)
        if number == 0:
            parity(gpu, cpu, gaussians, camera)
        torch.cuda.reset_peak_memory_stats()
        parts, wall_s = timed_gpu(Iteration(gpu, gaussians, camera), chosen.repeats)
        print(f"\n{count} Gaussians, {width} x {height} pixels")
        for name, values in parts.items():
            print(f"  {name:<20} {statistics.median(values):>9.2f} ms")
        peak = torch.cuda.max_memory_allocated() / 2**30
        print(f"  iteration            {1e3 * wall_s:>9.2f} ms, {1 / wall_s:.0f} a second")
        print(f"  peak memory          {peak:>9.2f} GiB")
        if chosen.cpu_repeats:
            cpu_s = timed_cpu(Iteration(cpu, gaussians, camera), chosen.cpu_repeats)
            print(
                f"  on the processor     {1e3 * cpu_s:>9.1f} ms, {cpu_s / wall_s:.1f} times as long"
            )
        ours_s = timed_colors(gpu, gaussians, camera, chosen.repeats)
        print(f"  with colours alone   {1e3 * ours_s:>9.2f} ms")
        gsplat_s = timed_gsplat(gpu, gaussians, camera, chosen.repeats)
        if isinstance(gsplat_s, str):
            print(f"  {gsplat_s}")
        else:
            print(
                f"  gsplat's             {1e3 * gsplat_s:>9.2f} ms: {ours_s / gsplat_s:.2f} of it"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())

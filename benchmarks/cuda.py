# SPDX-License-Identifier: GPL-3.0-or-later
"""GPU against CPU, time beside error, in one run: ``python -m benchmarks.cuda --help``.

Times are the minimum wall time of the repeats, the GPU idle before and after; per kernel they are
taken between CUDA events. The CPU kernels run on all cores, same scene, same run. Errors are those
of the GPU's images and gradients against the CPU kernels'. Without a GPU it says why and ends
with exit code 1.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from gaussian_wrapping_addon.core.gaussians.model import TRAINED, OrientedGaussians
from gaussian_wrapping_addon.core.parallel import default_threads
from gaussian_wrapping_addon.core.render.cuda.device_renderer import render_with
from gaussian_wrapping_addon.core.render.cuda.kernels import (
    Argument,
    Kernels,
    cuda_available,
    device_kernels,
)
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import Render, RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera

from .workload import surface_gaussians, view

IMAGES = ("color", "normal", "geometric_normal", "alpha", "depth")
BUDGET_BYTES = 4 << 30
CPU_REPEATS = 3

Renderer = Callable[[OrientedGaussians, Camera, RenderOptions], Render]


class TimedKernels(Kernels):
    """Kernels of a GPU between events; ``milliseconds()`` gives the smallest time of each."""

    def __init__(self, inner: Kernels) -> None:
        self._inner = inner
        self._events: dict[str, list[tuple[torch.cuda.Event, torch.cuda.Event]]] = defaultdict(list)

    def launch(self, name: str, blocks: int, *arguments: Argument) -> None:
        """Launch between two events."""
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        begin.record()
        self._inner.launch(name, blocks, *arguments)
        end.record()
        self._events[name].append((begin, end))

    def _run(self, name: str, blocks: int, parameters: object) -> None:
        raise AssertionError("launch() hands everything on")

    def milliseconds(self) -> dict[str, float]:
        """Wait for the GPU and return the smallest time of each kernel."""
        torch.cuda.synchronize()
        return {
            name: min(begin.elapsed_time(end) for begin, end in pairs)
            for name, pairs in self._events.items()
        }


@dataclasses.dataclass(frozen=True)
class Pass:
    """One rendering and its gradient, with smallest times in milliseconds."""

    images: dict[str, Tensor]
    gradients: dict[str, Tensor]
    forward_ms: float
    backward_ms: float


def run(
    renderer: Renderer,
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions,
    device: str,
    repeats: int,
) -> Pass:
    """Render and differentiate ``repeats`` times after one run that compiles and warms up."""
    leaf = gaussians.replaced(
        **{
            name: tensor.to(device, copy=True).requires_grad_(name != "filter_3d")
            for name, tensor in gaussians.tensors()
        }
    )
    generator = torch.Generator().manual_seed(0)
    weights: dict[str, Tensor] = {}
    best = [float("inf"), float("inf")]
    for repeat in range(repeats + 1):
        clocks = [clock(device)]
        out = renderer(leaf, camera, options)
        clocks.append(clock(device))
        names = [name for name in IMAGES if options.depth or name != "depth"]
        if not weights:
            weights = {
                name: torch.randn(getattr(out, name).shape, generator=generator).to(device)
                for name in names
            }
        images = [getattr(out, name) for name in names]
        chosen = [getattr(leaf, name) for name in TRAINED]
        before = clock(device)
        gradients = torch.autograd.grad(images, chosen, [weights[name] for name in names])
        after = clock(device)
        if repeat:
            best[0] = min(best[0], 1e3 * (clocks[1] - clocks[0]))
            best[1] = min(best[1], 1e3 * (after - before))
    return Pass(
        {name: getattr(out, name).detach().cpu() for name in IMAGES},
        {name: grad.cpu() for name, grad in zip(TRAINED, gradients, strict=True)},
        *best,
    )


def clock(device: str) -> float:
    """Return seconds, once the device has nothing left to do."""
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def error_lines(found: Pass, wanted: Pass) -> list[str]:
    """Return the errors of one pass against another, as lines of text."""
    lines = []
    for name in IMAGES[:4]:
        error = (found.images[name].double() - wanted.images[name].double()).abs().max()
        lines.append(f"  {name:<18} largest error {float(error):.1e}")
    a, b = found.images["depth"].double(), wanted.images["depth"].double()
    both = (a > 0) & (b > 0)
    if both.any():
        error = ((a - b).abs() / b)[both]
        lines.append(
            f"  {'depth':<18} relative: 99.9 % below {float(error.quantile(0.999)):.1e}, "
            f"largest {float(error.max()):.1e}; valid on one side only: "
            f"{int(((a > 0) != (b > 0)).sum())} of {int(both.sum())} pixels"
        )
    for name in TRAINED:
        x, y = found.gradients[name].double(), wanted.gradients[name].double()
        lines.append(f"  d / d {name:<12} L2-relative {float((x - y).norm() / y.norm()):.1e}")
    return lines


def report(
    kernels: Kernels,
    gaussians: OrientedGaussians,
    camera: Camera,
    options: RenderOptions,
    device: str,
    repeats: int,
) -> None:
    """Print times and errors of one scene."""

    def gpu(leaf: OrientedGaussians, camera: Camera, options: RenderOptions) -> Render:
        return render_with(kernels, leaf, camera, options, BUDGET_BYTES)

    found = run(gpu, gaussians, camera, options, device, repeats)
    wanted = run(render, gaussians, camera, options, "cpu", min(repeats, CPU_REPEATS))
    print(
        f"\n{len(gaussians)} Gaussians, {camera.width} x {camera.height} pixels, "
        f"depth {'on' if options.depth else 'off'}"
    )
    print(f"  {'whole, ms':<18} {'GPU':>9} {'CPU':>9} {'ratio':>7}")
    for name in ("forward", "backward"):
        a, b = getattr(found, f"{name}_ms"), getattr(wanted, f"{name}_ms")
        print(f"  {name:<18} {a:>9.2f} {b:>9.1f} {b / a:>7.1f}")
    print("\n".join(error_lines(found, wanted)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--gaussians", type=int, nargs="+", default=[50_000, 200_000])
    parser.add_argument("--sizes", nargs="+", default=["400x300", "800x600", "1600x1200"])
    parser.add_argument("--repeats", type=int, default=20)
    chosen = parser.parse_args(arguments)
    usable, reason = cuda_available()
    if not usable:
        print(f"No figures: {reason}", file=sys.stderr)
        return 1
    print(f"{reason} CPU: {default_threads()} threads. Minimum of {chosen.repeats} repeats.")
    begin = time.perf_counter()
    kernels = device_kernels(torch.cuda.current_device())
    print(f"Kernels compiled and loaded in {time.perf_counter() - begin:.1f} s")
    for count in chosen.gaussians:
        gaussians = surface_gaussians(count)
        for size in chosen.sizes:
            width, height = (int(side) for side in size.lower().split("x"))
            camera = view(width, height)
            for depth in (False, True):
                options = RenderOptions(depth=depth)
                report(kernels, gaussians, camera, options, "cuda", chosen.repeats)
            timed = TimedKernels(kernels)
            leaf = gaussians.replaced(**{n: t.cuda() for n, t in gaussians.tensors()})
            leaf.means.requires_grad_()
            for _ in range(chosen.repeats):
                out = render_with(timed, leaf, camera, RenderOptions(), BUDGET_BYTES)
                (out.color.sum() + out.depth.sum()).backward()
            for name, milliseconds in timed.milliseconds().items():
                print(f"  kernel {name:<24} {milliseconds:>8.3f} ms")
    return 0


if __name__ == "__main__":
    sys.exit(main())

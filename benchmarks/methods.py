# SPDX-License-Identifier: GPL-3.0-or-later
"""Speed against error of every method that renders with gradients, on one small scene."""

from __future__ import annotations

import dataclasses
import functools
import math

import torch

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.reference.reference import render_reference
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.simd.raster_math import vector_lanes
from gaussian_wrapping_addon.core.render.types.images import Render
from gaussian_wrapping_addon.core.render.types.options import RenderOptions

from .error_tables import covering
from .exact_gradients import TRAINED, linear_loss
from .kernel_speed import kernel_name, runs_of
from .scene_errors import Exact, Renderer, SceneErrors, compare, leaves
from .tables import Table
from .timing import Part, Timing, measure
from .workload import view

_NOTE = (
    "Projection, images, isosurface depth and all gradients through autograd, one thread, CPU "
    "time. The reference costs pixels x Gaussians, so only this scene is small enough. Errors "
    "against float64 from first principles (images, depth by bisection) and the reference in "
    "float64 (gradients, worst parameter group, L2-relative)."
)


@dataclasses.dataclass(frozen=True)
class Method:
    """Speed and error of one method."""

    name: str
    timing: Timing
    """Forward and backward of all images, with projection and isosurface depth, one thread."""
    errors: SceneErrors

    def worst(self, loss: str) -> float:
        """Return the largest L2-relative error of a parameter group."""
        found = [error.l2 for error in self.errors.gradients[loss].values()]
        return max((value for value in found if not math.isnan(value)), default=float("nan"))


def _kernels(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions, *, lanes: int
) -> Render:
    with runs_of(lanes):
        return render(gaussians, camera, options)


def _reference64(gaussians: OrientedGaussians, camera: Camera, options: RenderOptions) -> Render:
    wide = gaussians.replaced(**{name: t.double() for name, t in gaussians.tensors()})
    return render_reference(wide, camera, options)


def measure_methods(count: int, width: int, height: int, repeats: int, seed: int) -> list[Method]:
    """Return every method on one scene; the reference costs pixels times Gaussians."""
    gaussians, camera = covering(count, seed), view(width, height)
    options = RenderOptions(threads=1, background=(0.2, 0.5, 0.1))
    best = vector_lanes()
    renderers: dict[str, Renderer] = {
        kernel_name(lanes): functools.partial(_kernels, lanes=lanes)
        for lanes in ([16, 8] if best == 16 else [8])
    }
    renderers["torch reference, float32"] = render_reference
    renderers["torch reference, float64"] = _reference64
    exact: Exact | None = None
    errors, parts = {}, list[Part]()
    for name, renderer in renderers.items():
        errors[name], exact = compare(
            name, gaussians, camera, options, renderer, gradients=True, seed=seed, exact=exact
        )
        parts.append((name, functools.partial(_both_ways, gaussians, camera, options, renderer)))
    timings = measure(parts, repeats, budget_s=20.0)
    return [Method(name, timings[name], errors[name]) for name in renderers]


def _both_ways(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions, renderer: Renderer
) -> None:
    leaf = leaves(gaussians, torch.float32)
    out = renderer(leaf, camera, options)
    weights = {
        name: torch.ones_like(getattr(out, name).detach())
        for name in ("color", "normal", "geometric_normal", "alpha", "depth")
    }
    linear_loss(out, weights).backward()
    assert all(getattr(leaf, name).grad is not None for name in TRAINED)


def method_table(methods: list[Method], count: int, width: int, height: int) -> Table:
    """Return speed and error side by side."""
    fastest = methods[0].timing.cpu_ms
    rows = [
        (
            m.name,
            m.timing.cpu_ms,
            m.timing.cpu_ms / fastest,
            m.errors.image_max,
            f"{100.0 * m.errors.depth_within:.3f}",
            m.errors.depth_max,
            m.worst("images"),
            m.worst("depth"),
        )
        for m in methods
    ]
    return Table(
        f"Speed against error: {count} Gaussians, {width} x {height}",
        (
            "method",
            "ms",
            "x",
            "images",
            "depth % below 1e-5",
            "depth",
            "gradients, images",
            "gradients, depth",
        ),
        rows,
        (_NOTE,),
    )

# SPDX-License-Identifier: GPL-3.0-or-later
"""Times of the renderer's kernels and of the C++ yardsticks on one workload, and their agreement.

One process measures one instruction set: numba compiles for the processor that is named when it is
imported. ``python -m benchmarks.kernel_speed SPEC RESULT`` is such a process, for
:func:`measure_in_child`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection.projection import (
    RawArrays,
    RawGradients,
    project_backward,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.raster.blend import (
    Images,
    RenderBuffers,
    ScreenView,
    blend,
    blend_backward,
)
from gaussian_wrapping_addon.core.render.render import project_view
from gaussian_wrapping_addon.core.render.simd.raster_math import vector_lanes
from gaussian_wrapping_addon.core.render.types.options import RenderOptions

from .evaluations import count_evaluations, reached_rows
from .fma_peak import fma_peak
from .kernel_results import (
    BACKWARD,
    BACKWARD_DEPTH,
    FORWARD,
    ISOSURFACE,
    ITERATION,
    PREPARED,
    PROJECTION,
    PROJECTION_BACKWARD,
    Result,
    Workload,
    kernel_name,
)
from .timing import Part, Timing, measure
from .training_step import whole_iteration
from .workload import surface_gaussians, view
from .yardstick.build import AVX2, InstructionSet, Yardstick, host_instruction_sets, yardsticks

_ROOT = Path(__file__).resolve().parents[1]
_CHILD_TIMEOUT_S = 1200
AVX2_CPU = "haswell"
"""LLVM's name of the first processor with AVX2 and FMA."""
_LARGE = 500_000
"""From this many Gaussians on, only the variant that the renderer would choose is timed."""
_IMAGE_TOLERANCE, _GRADIENT_TOLERANCE = 1e-6, 1e-5
_FLIPPED_SHARE, _FLIPPED_GRADIENT = 1e-4, 1e-3


@contextlib.contextmanager
def runs_of(lanes: int) -> Iterator[None]:
    """Make the renderer choose runs of ``lanes`` pixels."""
    prefix = "gaussian_wrapping_addon.core.render."
    modules = [
        module
        for name, module in sys.modules.items()
        if name.startswith(prefix) and hasattr(module, "vector_lanes")
    ]
    kept = [module.vector_lanes for module in modules]
    try:
        for module in modules:
            module.vector_lanes = lambda: lanes
        yield
    finally:
        for module, function in zip(modules, kept, strict=True):
            module.vector_lanes = function


def random_gradients(images: Images, seed: int) -> list[np.ndarray]:
    """Return standard normal loss gradients of the five images, in the order the kernels take."""
    random = np.random.default_rng(seed)
    names = ("color", "normal", "geometric", "alpha", "depth")
    return [
        random.standard_normal(size=getattr(images, name).shape, dtype=np.float32) for name in names
    ]


class KernelVariant:
    """The kernels with runs of one length on one view."""

    def __init__(
        self, raw: RawArrays, workload: Workload, lanes: int, threads: int, buffers: RenderBuffers
    ) -> None:
        self.lanes, self.buffers = lanes, buffers
        camera = view(workload.width, workload.height)
        self.options = RenderOptions(threads=threads)
        with runs_of(lanes):
            self.view: ScreenView = project_view(raw, camera, self.options)
        self.flat = dataclasses.replace(
            self.view, options=dataclasses.replace(self.options, depth=False)
        )
        self.images = Images.allocate(camera, self.options)
        self.run(lambda: blend(self.view, self.images, buffers))()
        self.grads = random_gradients(self.images, workload.seed)

    def run(self, function: Callable[[], object]) -> Callable[[], object]:
        """Return the function under this variant's run length."""

        def with_lanes() -> object:
            with runs_of(self.lanes):
                return function()

        return with_lanes

    def backward(self, prepared: ScreenView) -> np.ndarray:
        """Return the gradient on params."""
        found = blend_backward(prepared, self.images, self.grads, self.buffers, absolute=False)
        return found[0]

    def parts(self) -> list[tuple[str, Callable[[], object]]]:
        """Return the raster kernels as parts."""
        return [
            (FORWARD, self.run(lambda: blend(self.flat, self.images, self.buffers))),
            (ISOSURFACE, self.run(lambda: blend(self.view, self.images, self.buffers))),
            (BACKWARD, self.run(lambda: self.backward(self.flat))),
            (BACKWARD_DEPTH, self.run(lambda: self.backward(self.view))),
        ]


def _projection_parts(
    raw: RawArrays, variant: KernelVariant
) -> list[tuple[str, Callable[[], object]]]:
    camera, options = variant.view.camera, variant.options
    gradients = RawGradients.zeros(raw)
    grad_params = variant.run(lambda: variant.backward(variant.view))()
    return [
        (PROJECTION, lambda: project_gaussians(raw, camera, options)),
        (PREPARED, variant.run(lambda: project_view(raw, camera, options))),
        (
            PROJECTION_BACKWARD,
            lambda: project_backward(
                raw, camera, options, variant.view.screen, grad_params, gradients
            ),
        ),
    ]


def agreement(
    yardstick: Yardstick, variant: KernelVariant, rows: np.ndarray, images: Images
) -> tuple[float, float]:
    """Compare a yardstick with the kernels; it is not timed unless they agree.

    Returns
    -------
    images : float
        Largest absolute difference.
    gradients : float
        Largest L2-relative difference of a column of params.

    Raises
    ------
    RuntimeError
        If images differ by more than 1e-6 or gradients by more than 1e-5. Rounding decides some
        thresholds the other way, as between the kernels' own variants: one value of 10 000 and one
        Gaussian of 10 000 may be off, and where a value is, the other gradients by 1e-3.
    """
    variant.run(lambda: blend(variant.flat, variant.images, variant.buffers))()
    yardstick.blend(variant.flat, rows, images)
    largest, off, values = 0.0, 0, 0
    for name in ("color", "normal", "geometric", "alpha"):
        difference = np.abs(getattr(images, name) - getattr(variant.images, name))
        largest = max(largest, float(difference.max()))
        off += int((difference > _IMAGE_TOLERANCE).sum())
        values += difference.size
    wanted = variant.run(lambda: variant.backward(variant.flat))()
    found = yardstick.blend_backward(variant.flat, rows, images, variant.grads, variant.buffers)
    lengths = np.linalg.norm(wanted.astype(np.float64), axis=0)
    differences = np.linalg.norm((found - wanted).astype(np.float64), axis=0)
    gradients = float((differences[lengths > 0] / lengths[lengths > 0]).max(initial=0.0))
    kept = _without_flipped(found, wanted, lengths)
    tolerance = _FLIPPED_GRADIENT if off else _GRADIENT_TOLERANCE
    good = off <= _FLIPPED_SHARE * values and kept <= tolerance
    if not good or differences[lengths == 0].any():
        raise RuntimeError(
            f"{yardstick.name} differs from the kernels by {largest:.1e} in the images ({off} of "
            f"{values} values) and by {kept:.1e} in the gradients: it measures nothing."
        )
    return largest, gradients


def _without_flipped(found: np.ndarray, wanted: np.ndarray, lengths: np.ndarray) -> float:
    """Return the L2-relative difference without the one Gaussian of 10 000 that differs most."""
    used = lengths > 0
    relative = np.abs(found - wanted)[:, used] / lengths[used]  # (n, columns)
    flipped = int(_FLIPPED_SHARE * len(relative))
    order = np.argsort(relative.max(1, initial=0.0))[: len(relative) - flipped]
    return float(np.linalg.norm(relative[order], axis=0).max(initial=0.0))


def measure_workload(
    workload: Workload,
    *,
    threads: int,
    repeats: int,
    budget_s: float,
    gaussians: OrientedGaussians | None = None,
) -> Result:
    """Time all variants that this process has on one workload, in turn.

    Parameters
    ----------
    workload : Workload
    threads : int
        Also timed with this many threads, if it is not 1.
    repeats : int
        Rounds at most.
    budget_s : float
        Of each of the two measurements; at least two rounds are timed.
    gaussians : OrientedGaussians, optional
        The scene, if it exists already.
    """
    gaussians = gaussians or surface_gaussians(workload.count, workload.seed)
    raw = RawArrays.from_gaussians(gaussians)
    large = workload.count >= _LARGE
    best = vector_lanes()
    lanes = [best] if large or best == 8 else [16, 8]
    buffers = RenderBuffers()
    variants = [KernelVariant(raw, workload, n, 1, buffers) for n in lanes]
    first = variants[0]
    rows = reached_rows(first.view)
    counts = dataclasses.asdict(count_evaluations(first.view, best, rows))
    own = {
        kernel_name(variant.lanes): count_evaluations(variant.view, variant.lanes, rows).own
        for variant in variants
    }
    images = Images.allocate(first.view.camera, first.flat.options)
    agreed, parts = {}, []
    rulers = yardsticks(own_instructions())[: 1 if large else None]
    for variant in variants:
        parts += [((kernel_name(variant.lanes), name), run) for name, run in variant.parts()]
    for ruler in rulers:
        agreed[ruler.name] = agreement(ruler, first, rows, images)
        parts += [((ruler.name, n), r) for n, r in _yardstick_parts(ruler, first, rows, images)]
    parts += [((kernel_name(best), name), run) for name, run in _projection_parts(raw, first)]
    step = whole_iteration(gaussians, view(workload.width, workload.height), 1)
    parts.append(((kernel_name(best), ITERATION), step))
    one = _measured(parts, repeats, budget_s)
    several: dict[str, dict[str, Timing]] = {}
    if threads > 1:
        shared = KernelVariant(raw, workload, best, threads, buffers)
        parts = [((kernel_name(best), name), run) for name, run in shared.parts()]
        parts += [((kernel_name(best), name), run) for name, run in _projection_parts(raw, shared)]
        for ruler in rulers[:1]:
            timed = _yardstick_parts(ruler, shared, rows, images)
            parts += [((ruler.name, name), run) for name, run in timed]
        several = _measured(parts, repeats, budget_s)
    return Result(workload, best, one, several, threads, counts, own, fma_peak(best), agreed)


def own_instructions() -> InstructionSet:
    """Return what the kernels of this process are compiled for."""
    if os.environ.get("NUMBA_CPU_NAME") == AVX2_CPU:
        return AVX2
    return host_instruction_sets()[0]


def _yardstick_parts(
    ruler: Yardstick, variant: KernelVariant, rows: np.ndarray, images: Images
) -> list[tuple[str, Callable[[], object]]]:
    return [
        (FORWARD, lambda: ruler.blend(variant.flat, rows, images)),
        (
            BACKWARD,
            lambda: ruler.blend_backward(
                variant.flat, rows, images, variant.grads, variant.buffers
            ),
        ),
    ]


def _measured(
    parts: list[tuple[tuple[str, str], Callable[[], object]]], repeats: int, budget_s: float
) -> dict[str, dict[str, Timing]]:
    flat: list[Part] = [(f"{variant}\0{name}", run) for (variant, name), run in parts]
    timings = measure(flat, repeats, budget_s=budget_s)
    tables: dict[str, dict[str, Timing]] = {}
    for (variant, name), _ in parts:
        tables.setdefault(variant, {})[name] = timings[f"{variant}\0{name}"]
    return tables


def measure_in_child(
    workloads: list[Workload], *, threads: int, repeats: int, budget_s: float
) -> list[Result]:
    """Measure in a process whose kernels are compiled for AVX2, on this same machine."""
    spec = {
        "workloads": [dataclasses.asdict(workload) for workload in workloads],
        "threads": threads,
        "repeats": repeats,
        "budget_s": budget_s,
    }
    with tempfile.TemporaryDirectory() as folder:
        question, answer = Path(folder, "spec.json"), Path(folder, "result.json")
        question.write_text(json.dumps(spec))
        subprocess.run(
            [sys.executable, "-m", "benchmarks.kernel_speed", str(question), str(answer)],
            env={**os.environ, "NUMBA_CPU_NAME": AVX2_CPU},
            cwd=_ROOT,
            check=True,
            timeout=_CHILD_TIMEOUT_S,
        )
        return [Result.from_json(values) for values in json.loads(answer.read_text())]


def main() -> None:
    """Measure what the first argument's file asks for; write the results to the second."""
    question, answer = map(Path, sys.argv[1:])
    spec = json.loads(question.read_text())
    results = [
        measure_workload(
            Workload(**workload),
            threads=spec["threads"],
            repeats=spec["repeats"],
            budget_s=spec["budget_s"],
        ).to_json()
        for workload in spec["workloads"]
    ]
    answer.write_text(json.dumps(results))


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: GPL-3.0-or-later
"""Speed of the renderer and of a training iteration: ``python -m benchmarks.kernels``.

Each part alone and whole iterations as the trainer runs them, for several scenes, image sizes and
numbers of threads. The figures are kept in ``benchmarks/records/kernels.json``, and
its page in ``docs/benchmarks`` is written from them. Errors of the kernels are held by tests
(``tests/core/render``). ``--print`` measures one scene and shows it, without record and page.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

# Torch's idle threads otherwise spin for a while and take the cores from the renderer's.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import torch

from gaussian_wrapping_addon.core.gaussians.model import TRAINED, OrientedGaussians, mip_filter
from gaussian_wrapping_addon.core.parallel import ArrayStore, default_threads
from gaussian_wrapping_addon.core.render.projection import (
    RawArrays,
    RawGradients,
    project_backward,
    project_gaussians,
)
from gaussian_wrapping_addon.core.render.raster import (
    Images,
    RenderBuffers,
    blend,
    write_intersection_gradients,
)
from gaussian_wrapping_addon.core.render.render import project_view
from gaussian_wrapping_addon.core.render.simd import ROW_VALUES, vector_lanes
from gaussian_wrapping_addon.core.render.tiles import TileBinning
from gaussian_wrapping_addon.core.render.types import ImageGradients, RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewPass, ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.training.adam import Adam
from gaussian_wrapping_addon.core.training.density import DensityStatistics
from gaussian_wrapping_addon.core.training.losses import color_loss, normal_losses

from .provenance import (
    DOCUMENTS,
    RECORDS,
    code_of_tree,
    read_figures,
    said_origin,
    write_figures,
    write_page,
)
from .tables import Row, Table, table_of
from .workload import surface_gaussians, view

COMMAND = "python -m benchmarks.kernels"
RECORD, PAGE = "kernels.json", "kernels.md"
WORKLOADS = ((10_000, 400, 300), (50_000, 400, 300), (50_000, 800, 600), (300_000, 800, 600))
"""Gaussians, width and height in pixels."""
RASTER = "raster kernels alone"
WHOLE = "whole iteration"
_BUDGET_S = 20.0
"""Of one workload with one number of threads."""

Part = tuple[str, Callable[[], object]]
"""Name and function; names are unique within one measurement."""


@dataclasses.dataclass(frozen=True)
class Timing:
    """Times of one part, milliseconds."""

    cpu_ms: float
    """Smallest processor time of all threads of the process."""
    wall_ms: float
    """Smallest time on the clock."""
    spread: float
    """Median processor time over the smallest, less 1."""
    repeats: int


def measure(
    parts: Sequence[Part], repeats: int, *, budget_s: float = float("inf"), at_least: int = 2
) -> dict[str, Timing]:
    """Run all parts in turn, after one run that compiles and warms up, and time each.

    Interleaved, so that a slow spell of the machine meets all parts alike, and a part is never
    helped by its own data in the cache.

    Parameters
    ----------
    repeats : int
        Rounds that are timed.
    budget_s : float
        No round begins after this many seconds, once ``at_least`` rounds are done.
    """
    for _, run in parts:
        run()
    cpu_s = np.zeros((repeats, len(parts)))
    wall_s = np.zeros((repeats, len(parts)))
    begun, done = time.perf_counter(), 0
    for turn in range(repeats):
        if turn >= at_least and time.perf_counter() - begun > budget_s:
            break
        for i, (_, run) in enumerate(parts):
            wall, cpu = time.perf_counter(), time.process_time()
            run()
            cpu_s[turn, i] = time.process_time() - cpu
            wall_s[turn, i] = time.perf_counter() - wall
        done = turn + 1
    cpu_s, wall_s = cpu_s[:done], wall_s[:done]
    return {
        name: Timing(
            1e3 * float(cpu_s[:, i].min()),
            1e3 * float(wall_s[:, i].min()),
            float(np.median(cpu_s[:, i]) / max(cpu_s[:, i].min(), 1e-9) - 1.0),
            done,
        )
        for i, (name, _) in enumerate(parts)
    }


def render_parts(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> list[Part]:
    """Return the renderer's parts, each alone, and the whole."""
    raw = RawArrays.from_gaussians(gaussians)
    gradients, buffers = RawGradients.zeros(raw), RenderBuffers()
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
    screen, threads = prepared.screen, prepared.threads
    renderer, grads = ViewRenderer(), ImageGradients(*incoming)
    grad_params = ViewRenderer().render(raw, camera, options).params_gradient(grads)
    intersections = np.zeros((len(prepared.lists.gaussian_ids), ROW_VALUES), np.float32)

    def backward(prepared: Any, absolute: bool) -> Callable[[], object]:
        return lambda: write_intersection_gradients(
            prepared, images, incoming, buffers, intersections, depth=True, absolute=absolute
        )

    def binning() -> object:
        found = TileBinning(screen, camera.width, camera.height, threads, ArrayStore())
        return found.lists(0, len(found.tile_counts))

    return [
        ("projection forward", lambda: project_gaussians(raw, camera, options)),
        ("binning", binning),
        ("projection, binning, rows", lambda: project_view(raw, camera, options)),
        ("raster forward, no depth", lambda: blend(flat, images, buffers)),
        ("raster forward, isosurface", lambda: blend(prepared, images, buffers)),
        ("the same with weights", lambda: blend(weighted, images, buffers)),
        ("raster backward, no depth", backward(flat, False)),
        ("raster backward, isosurface", backward(prepared, False)),
        ("the same with AbsGS", backward(prepared, True)),
        (
            "projection backward",
            lambda: project_backward(raw, camera, options, screen, grad_params, gradients),
        ),
        (
            "render forward and backward",
            lambda: renderer.render(raw, camera, options).backward(grads),
        ),
    ]


class Iteration:
    """Training iterations of one view, as the trainer runs them.

    Learning rates are so small that the Gaussians stay what they are, so that each repeat has the
    same work.

    Parameters
    ----------
    depth : bool
        Isosurface depth and both normal losses.
    statistics : bool
        The screen gradients that density control asks for, in the first part of a training.
    """

    def __init__(
        self,
        gaussians: OrientedGaussians,
        camera: Camera,
        threads: int,
        *,
        depth: bool = False,
        statistics: bool = False,
    ) -> None:
        self.camera, self.threads, self.depth = camera, threads, depth
        self.options = RenderOptions(depth=depth, threads=threads, screen_gradients=statistics)
        self.adam, self.renderer, self.store = Adam(gaussians), ViewRenderer(), ArrayStore()
        self.statistics = DensityStatistics.zeros(len(gaussians))
        columns = {name: self.adam.array(name)[:1].size for name in TRAINED}
        self.rates = {name: np.full(count, 1e-12, np.float32) for name, count in columns.items()}
        color = self.forward().color
        noise = np.random.default_rng(0).normal(size=color.shape)
        self.photo = np.clip(255 * (color + 0.1 * noise), 0, 255).astype(np.uint8)

    def forward(self) -> ViewPass:
        """Project, bin and blend."""
        raw = RawArrays.from_gaussians(self.adam.gaussians())
        return self.renderer.render(raw, self.camera, self.options)

    def losses(self, image: ViewPass) -> ImageGradients:
        """Return what the losses say about the images."""
        threads, store = self.threads, self.store
        _, by_color, _ = color_loss(image.color, self.photo, threads=threads, store=store)
        if not self.depth:
            return ImageGradients(color=by_color)
        normals = (image.depth, image.geometric_normal, image.normal, image.alpha)
        _, gradients = normal_losses(*normals, self.camera, threads=threads, store=store)
        return dataclasses.replace(gradients, color=by_color)

    def run(self) -> None:
        """Run one whole iteration."""
        image = self.forward()
        seen = image.backward(self.losses(image))
        if image.statistics is not None:
            self.statistics.add(image.statistics, self.camera.width, self.camera.height)
        self.adam.step_rows(seen, self.rates, threads=self.threads)

    def raster(self) -> Callable[[], None]:
        """Return the forward and backward raster kernels of this iteration, nothing else."""
        image = self.forward()
        grads = self.losses(image)
        incoming = []
        for name in ("color", "normal", "geometric_normal", "alpha", "depth"):
            grad = getattr(grads, name)
            incoming.append(np.zeros_like(getattr(image, name)) if grad is None else grad)
        view = project_view(image.gaussians, self.camera, self.options)
        images, buffers = Images.allocate(self.camera, self.options), RenderBuffers()
        intersections = np.zeros((len(view.lists.gaussian_ids), ROW_VALUES), np.float32)
        absolute = image.statistics is not None

        def run() -> None:
            blend(view, images, buffers)
            write_intersection_gradients(
                view, images, incoming, buffers, intersections, depth=self.depth, absolute=absolute
            )

        return run


def training_parts(gaussians: OrientedGaussians, camera: Camera, threads: int) -> list[Part]:
    """Return losses with their gradients, Adam, the 3D filter, and whole iterations."""
    whole = Iteration(gaussians, camera, threads, depth=True)
    image = whole.forward()
    seen = image.backward(whole.losses(image))
    normals = (image.depth, image.geometric_normal, image.normal, image.alpha)
    shared: dict[str, Any] = {"threads": threads, "store": ArrayStore()}
    means = gaussians.means.numpy()
    parts: list[Part] = [
        ("L1 + SSIM and gradient", lambda: color_loss(image.color, whole.photo, **shared)),
        ("both normal losses, gradient", lambda: normal_losses(*normals, camera, **shared)),
        ("Adam, seen Gaussians", lambda: whole.adam.step_rows(seen, whole.rates, threads=threads)),
        ("3D filter, 50 cameras", lambda: mip_filter(means, [camera] * 50, threads=threads)),
    ]
    for name, depth, statistics in (
        ("colour", False, False),
        ("colour, AbsGS", False, True),
        ("depth and normals", True, False),
    ):
        one = Iteration(gaussians, camera, threads, depth=depth, statistics=statistics)
        alone = Iteration(gaussians, camera, threads, depth=depth, statistics=statistics)
        parts += [(f"{WHOLE}, {name}", one.run), (f"{RASTER}, {name}", alone.raster())]
    return parts


def measure_workload(
    workload: tuple[int, int, int], threads: int, repeats: int, budget_s: float = _BUDGET_S
) -> dict[str, Any]:
    """Return scene, threads and the times of all parts, as plain values."""
    count, width, height = workload
    gaussians, camera = surface_gaussians(count), view(width, height)
    torch.set_num_threads(threads)
    parts = render_parts(gaussians, camera, RenderOptions(threads=threads))
    parts += training_parts(gaussians, camera, threads)
    timings = measure(parts, repeats, budget_s=budget_s)
    return {
        "workload": [count, width, height],
        "threads": threads,
        "parts": {name: dataclasses.asdict(timing) for name, timing in timings.items()},
    }


def name_of(workload: Sequence[int]) -> str:
    """Return a short name for tables."""
    count, width, height = workload
    return f"{f'{count // 1000}k' if count >= 1000 else count}, {width}x{height}"


def part_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the processor time of each part with one thread, a column a scene."""
    single = [row for row in rows if row["threads"] == 1]
    names = list(single[0]["parts"]) if single else []
    cells: list[Row] = [
        {
            "part": name,
            **{name_of(r["workload"]): float(r["parts"][name]["cpu_ms"]) for r in single},
        }
        for name in names
    ]
    spread = max((p["spread"] for r in single for p in r["parts"].values()), default=0.0)
    return table_of(
        "One thread, processor time in ms",
        cells,
        "Smallest of the interleaved runs; the median lies at most "
        f"{100 * spread:.0f} % above. A whole iteration is rendering, losses, gradients and Adam.",
    )


def thread_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return times on the clock of each number of threads, with the gain over one."""
    single = {tuple(r["workload"]): r["parts"] for r in rows if r["threads"] == 1}
    shown = (
        "raster forward, isosurface", "raster backward, isosurface", "projection, binning, rows",
        f"{WHOLE}, colour", f"{WHOLE}, depth and normals",
    )  # fmt: skip
    cells: list[Row] = []
    for row in rows:
        one = single.get(tuple(row["workload"]))
        cell: Row = {"scene": name_of(row["workload"]), "threads": row["threads"]}
        for name in shown:
            wall = float(row["parts"][name]["wall_ms"])
            cell[f"{name}, ms"] = wall
            cell[f"{name}, gain"] = f"{one[name]['wall_ms'] / wall:.2f}" if one else None
        cells.append(cell)
    return table_of("Threads, time on the clock", cells, "Gain: over one thread.")


def write_document(record: Mapping[str, Any], out: Path = DOCUMENTS) -> Path:
    """Write the page of a record into a folder."""
    lines = [
        said_origin(COMMAND, record),
        "",
        f"Scenes of `benchmarks/workload.py`; runs of {record['lanes']} pixels.",
        "",
        part_table(record["rows"]).markdown(),
        thread_table(record["rows"]).markdown(),
    ]
    return write_page(out / PAGE, "Kernels", [record["code"]["commit"]], lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, keep the figures and write the page."""
    parser = argparse.ArgumentParser(
        prog=COMMAND, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    most = default_threads()
    doubled = [2**k for k in range(most.bit_length()) if 2**k <= most]
    parser.add_argument("--threads", type=int, nargs="+", default=sorted({*doubled, most}))
    parser.add_argument("--repeats", type=int, default=12, help="timed rounds at most")
    parser.add_argument("--print", metavar="COUNT/WIDTHxHEIGHT", help="one scene, nothing is kept")
    parser.add_argument("--document", action="store_true", help="measure nothing, write the page")
    chosen = parser.parse_args(arguments)
    if chosen.print:
        count, width, height = map(int, chosen.print.lower().replace("/", "x").split("x"))
        for threads in chosen.threads:
            row = measure_workload((count, width, height), threads, chosen.repeats)
            print(part_table([{**row, "threads": 1}]).markdown())
        return 0
    if not chosen.document:
        code = code_of_tree()
        rows = [
            measure_workload(workload, threads, chosen.repeats)
            for workload in WORKLOADS
            for threads in chosen.threads
        ]
        figures = {"lanes": vector_lanes(), "rows": rows}
        write_figures(RECORDS / RECORD, figures, max(chosen.threads), code)
    print(write_document(read_figures(RECORDS / RECORD)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

# SPDX-License-Identifier: GPL-3.0-or-later
"""Tables of the kernels' speed: against the C++ yardstick, the processor's limit, and threads."""

from __future__ import annotations

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
)
from .tables import Cell, Table

FORWARD_FLOPS, BACKWARD_FLOPS = 57, 97
"""Per pixel evaluation, counted by hand: a multiply-add is 2, a division, comparison, minimum or
select 1, the exponential 17, each feature 2 forward and 4 backward."""


def raster_table(results: list[Result], instructions: str) -> Table:
    """Return the raster kernels and the yardsticks of one instruction set, one thread."""
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        clang = result.clang()
        for variant, parts in result.one.items():
            forward, backward = parts[FORWARD], parts[BACKWARD]
            both = forward.cpu_ms + backward.cpu_ms
            deep, deep_backward = parts.get(ISOSURFACE), parts.get(BACKWARD_DEPTH)
            ratio: Cell = None
            if clang:
                ruler = result.one[clang]
                ratio = f"{both / (ruler[FORWARD].cpu_ms + ruler[BACKWARD].cpu_ms):.2f}"
            number = result.own_evaluations(variant)
            rows.append(
                (
                    result.workload.name,
                    variant,
                    forward.cpu_ms,
                    backward.cpu_ms,
                    f"{both:.1f}",
                    ratio,
                    deep.cpu_ms if deep else None,
                    f"{100.0 * (deep.cpu_ms / forward.cpu_ms - 1.0):.0f}" if deep else None,
                    deep_backward.cpu_ms if deep_backward else None,
                    f"{number / forward.cpu_ms / 1e6:.2f}",
                    f"{number / backward.cpu_ms / 1e6:.2f}",
                    f"{_share(number, forward.cpu_ms, FORWARD_FLOPS, result):.0f}",
                    f"{_share(number, backward.cpu_ms, BACKWARD_FLOPS, result):.0f}",
                    f"{100.0 * result.evaluations['useful'] / max(number, 1):.0f}",
                    f"{100.0 * max(forward.spread, backward.spread):.0f}",
                    forward.repeats,
                )
            )
    return Table(
        f"Raster kernels, {instructions}, one thread",
        (
            "scene",
            "variant",
            "fwd ms",
            "bwd ms",
            "sum ms",
            "/ clang",
            "fwd+iso ms",
            "iso %",
            "bwd+iso ms",
            "fwd G/s",
            "bwd G/s",
            "fwd peak %",
            "bwd peak %",
            "useful %",
            "spread %",
            "runs",
        ),
        rows,
        (
            (
                "CPU time, smallest of the interleaved runs; spread: median over smallest, less 1, "
                "the worse of the two. Nine features and alpha; backward with the sum over pairs. "
                "iso: with isosurface depth, and what it adds to forward. G/s: pixel evaluations "
                "per second; peak: of the multiply-add peak measured in the same process at "
                f"{FORWARD_FLOPS} flops an evaluation forward and {BACKWARD_FLOPS} backward; "
                "useful: share of the evaluated lanes with alpha >= 1/255 and T >= 1e-4. / clang: "
                "forward + backward over the clang yardstick of the same run and instruction set."
            ),
        ),
    )


def _share(number: int, ms: float, flops: int, result: Result) -> float:
    return 100.0 * number * flops / (1e-3 * ms) / result.peak


def evaluation_table(results: list[Result]) -> Table:
    """Return how many pixels each layout evaluates."""
    columns = {
        "rows of 16": "rows_16",
        "halves of 8": "halves_8",
        "exact runs of 8": "runs_8",
        "blocks 4x4": "blocks_4x4",
        "blocks 4x2": "blocks_4x2",
        "inside": "inside",
        "useful": "useful",
        "kernels": "own",
    }
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        counts = result.evaluations
        rows.append(
            (
                result.workload.name,
                counts["pairs"],
                f"{counts['nominal'] / 1e6:.1f}",
                *(f"{counts[key] / 1e6:.2f}" for key in columns.values()),
            )
        )
    return Table(
        "Pixel evaluations of one forward pass, millions",
        ("scene", "pairs", "nominal", *columns),
        rows,
        (
            (
                "Nominal: pairs of tile and Gaussian times 256. Rows: from the first to the last "
                "row that the ellipse alpha >= 1/255 reaches; halves: those that its box reaches; "
                "exact runs and blocks: those with a pixel inside. Rows that are opaque are left "
                "out. Counted from the ellipses; the last column from the kernels' own masks."
            ),
        ),
    )


def other_table(results: list[Result]) -> Table:
    """Return projection, binning and the whole iteration, one thread."""
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        parts = next(iter(result.one.values()))
        raster = parts[FORWARD].cpu_ms + parts[BACKWARD].cpu_ms
        projection = parts[PROJECTION].cpu_ms
        rows.append(
            (
                result.workload.name,
                projection,
                parts[PROJECTION_BACKWARD].cpu_ms,
                max(parts[PREPARED].cpu_ms - projection, 0.0),
                raster,
                parts[ITERATION].cpu_ms,
                f"{parts[ITERATION].cpu_ms / raster:.2f}",
            )
        )
    return Table(
        "Around the raster kernels, one thread, ms",
        (
            "scene",
            "projection fwd",
            "projection bwd",
            "binning and masks",
            "raster fwd + bwd",
            "whole iteration",
            "iteration / raster",
        ),
        rows,
        (
            (
                "Whole iteration: projection, binning, raster without depth, L1 + SSIM, all "
                "gradients and the optimiser, as training runs it."
            ),
        ),
    )


def thread_table(results: list[Result]) -> Table | None:
    """Return times on the clock with several threads; None if only one was measured."""
    rows: list[tuple[Cell, ...]] = []
    threads = 1
    for result in results:
        threads = max(threads, result.threads)
        for variant, parts in result.several.items():
            cells: list[Cell] = [result.workload.name, variant]
            for name in (FORWARD, BACKWARD, ISOSURFACE, BACKWARD_DEPTH, PREPARED):
                timing = parts.get(name)
                if timing is None:
                    cells += [None, None]
                    continue
                single = result.one[variant][name].wall_ms
                cells += [timing.wall_ms, f"{single / timing.wall_ms:.2f}"]
            single = sum(result.one[variant][name].wall_ms for name in (FORWARD, BACKWARD))
            both = sum(parts[name].wall_ms for name in (FORWARD, BACKWARD))
            rows.append((*cells, f"{single / both:.2f}"))
    if not rows:
        return None
    return Table(
        f"{threads} threads, time on the clock",
        (
            "scene",
            "variant",
            "fwd ms",
            "x",
            "bwd ms",
            "x",
            "fwd+iso ms",
            "x",
            "bwd+iso ms",
            "x",
            "prepare ms",
            "x",
            "fwd+bwd x",
        ),
        rows,
        ("x: time on the clock of one thread over that of all, smallest of each.",),
    )


def acceptance_lines(results: list[Result], scenes: tuple[str, ...]) -> list[str]:
    """Return the figures that a release is judged by, in words."""
    lines = []
    for result in results:
        if result.workload.name not in scenes:
            continue
        variant, parts = next(iter(result.one.items()))
        both = parts[FORWARD].cpu_ms + parts[BACKWARD].cpu_ms
        words = f"{result.workload.name}, {variant}: forward + backward {both:.1f} ms"
        if clang := result.clang():
            ruler = result.one[clang]
            ratio = both / (ruler[FORWARD].cpu_ms + ruler[BACKWARD].cpu_ms)
            words += f", {ratio:.2f} x {clang}"
        surcharge = parts[ISOSURFACE].cpu_ms / parts[FORWARD].cpu_ms - 1.0
        words += f"; isosurface depth adds {100.0 * surcharge:.0f} % to forward"
        if several := result.several.get(variant):
            names = (FORWARD, BACKWARD)
            single = sum(parts[name].wall_ms for name in names)
            shared = sum(several[name].wall_ms for name in names)
            words += f"; {single / shared:.2f} x faster on {result.threads} threads"
        words += f"; whole iteration {parts[ITERATION].cpu_ms / both:.2f} x the raster kernels"
        lines.append(words + ".")
    return lines

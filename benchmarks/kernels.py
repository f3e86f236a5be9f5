# SPDX-License-Identifier: GPL-3.0-or-later
"""Speed against error of the renderer in one run: ``python -m benchmarks.kernels``.

Times of the kernels, of the torch reference and of a C++ yardstick that is compiled on the spot,
their share of what the processor can do, and the errors of images, depth and gradients against
float64. Prints the tables and writes them with a plot to ``docs/benchmarks``.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import os
import time
from collections.abc import Sequence
from pathlib import Path

# Torch's idle threads otherwise spin for a while and take the cores from the renderer's.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import torch

from gaussian_wrapping_addon.core.evaluation.report.plot import Panel, Series, write_svg
from gaussian_wrapping_addon.core.kernels.parallel import default_threads
from gaussian_wrapping_addon.core.machine import processor_name

from .error_tables import (
    backward_table,
    generic_errors,
    gradient_tables,
    hard_errors,
    image_table,
)
from .hard_scenes import hard_scenes
from .kernel_results import BACKWARD, FORWARD, Result, Workload
from .kernel_speed import measure_in_child, measure_workload, own_instructions
from .methods import Method, measure_methods, method_table
from .speed_tables import (
    acceptance_lines,
    evaluation_table,
    other_table,
    raster_table,
    thread_table,
)
from .tables import Table, versions
from .yardstick.build import AVX2, AVX512, NO_COMPILER, compilers, host_instruction_sets

DOCS = Path(__file__).resolve().parents[1] / "docs" / "benchmarks"
_COUNTS = (10_000, 50_000, 200_000, 1_000_000)
_SIZES = ((400, 300), (800, 600), (1600, 1200))
_ACCEPTANCE = ("50k, 400x300", "50k, 800x600")
_ERROR_SIZES = [(10_000, 200, 150), (50_000, 400, 300)]
_METHOD_SCENE = (1500, 60, 44)
_MADE_BY = (
    "Made by `python -m benchmarks.kernels`; the scenes are those of `benchmarks/workload.py` and "
    "`benchmarks/hard_scenes.py`."
)
PARTS = ("speed", "error", "methods")


@dataclasses.dataclass(frozen=True)
class Plan:
    """How much one run measures."""

    workloads: list[Workload]
    threads: int
    repeats: int
    budget_s: float
    error_sizes: list[tuple[int, int, int]]
    parts: tuple[str, ...]
    seed: int


def plan(chosen: argparse.Namespace) -> Plan:
    """Return the full run, or a quick one of about two minutes."""
    counts, sizes = (_COUNTS[:2], _SIZES[:1]) if chosen.quick else (_COUNTS, _SIZES)
    workloads = [
        Workload(count, width, height, chosen.seed) for count in counts for width, height in sizes
    ]
    return Plan(
        workloads,
        chosen.threads or default_threads(),
        chosen.repeats or (5 if chosen.quick else 12),
        3.0 if chosen.quick else 9.0,
        [(2_000, 80, 60)] if chosen.quick else _ERROR_SIZES,
        tuple(chosen.only or PARTS),
        chosen.seed,
    )


def measure_speed(wanted: Plan) -> dict[str, list[Result]]:
    """Return the results of each instruction set, the machine's own first."""
    own = own_instructions()
    results = {
        own.name: [
            measure_workload(
                workload, threads=wanted.threads, repeats=wanted.repeats, budget_s=wanted.budget_s
            )
            for workload in wanted.workloads
        ]
    }
    if own == AVX512 and AVX2 in host_instruction_sets():
        results[AVX2.name] = measure_in_child(
            wanted.workloads, threads=1, repeats=wanted.repeats, budget_s=0.5 * wanted.budget_s
        )
    return results


def speed_sections(results: dict[str, list[Result]]) -> tuple[list[str], list[Table]]:
    """Return sentences and tables of the times."""
    own = next(iter(results.values()))
    words = [f"Multiply-add peak of one core: {own[0].peak / 1e9:.1f} GFLOP/s, measured."]
    if not compilers():
        words.append(NO_COMPILER)
    differences = [pair for some in results.values() for r in some for pair in r.agreement.values()]
    if differences:
        images, gradients = (max(pair[i] for pair in differences) for i in range(2))
        words.append(
            "The yardsticks agree with the kernels: images differ by at most "
            f"{images:.1e}, gradients by {gradients:.1e} (L2-relative, worst column; larger "
            "where rounding decided a threshold the other way)."
        )
    tables = []
    for instructions, some in results.items():
        words += acceptance_lines(some, _ACCEPTANCE)
        tables.append(raster_table(some, instructions))
    tables.append(evaluation_table(own))
    tables.append(other_table(own))
    threads = thread_table(own)
    return words, tables + ([threads] if threads else [])


def panels(results: dict[str, list[Result]], methods: list[Method]) -> list[Panel]:
    """Return time against the number of Gaussians, and error against time."""
    found = []
    if results:
        sizes = sorted({r.workload.width for some in results.values() for r in some})
        width = sizes[len(sizes) // 2]
        lines: dict[str, list[tuple[float, float]]] = {}
        for instructions, some in results.items():
            for result in some:
                if result.workload.width != width:
                    continue
                for variant, parts in result.one.items():
                    name = variant if "C++" in variant else f"{variant}, {instructions}"
                    both = parts[FORWARD].cpu_ms + parts[BACKWARD].cpu_ms
                    lines.setdefault(name, []).append((float(result.workload.count), both))
        title = f"Forward + backward, {width} pixels wide"
        series = [Series(name, points) for name, points in lines.items()]
        found.append(Panel(title, "Gaussians", "CPU ms, one thread", series))
    if methods:
        series = [Series(m.name, [(m.timing.cpu_ms, m.worst("images"))], False) for m in methods]
        title = "Gradient error against time, small scene"
        found.append(Panel(title, "CPU ms, one thread", "L2-relative, worst group", series, True))
    return found


def header(wanted: Plan, seconds: float) -> list[str]:
    """Return what the figures were measured on."""
    compiled = "; ".join(f"{c.name}: {c.version}" for c in compilers()) or "none"
    today = datetime.datetime.now(datetime.UTC).date()
    machine = f"{processor_name()}, {default_threads()} cores; {today}; {versions()}"
    chosen = f"seed {wanted.seed}; {', '.join(wanted.parts)}; {seconds:.0f} s"
    return [f"{machine}; C++ compilers: {compiled}; {chosen}.", _MADE_BY]


def run(wanted: Plan, out: Path) -> str:
    """Measure, write ``kernels.md`` and ``kernels.svg``, and return the text."""
    begun = time.perf_counter()
    torch.set_num_threads(1)
    words: list[str] = []
    tables: list[Table] = []
    results: dict[str, list[Result]] = {}
    methods: list[Method] = []
    if "speed" in wanted.parts:
        results = measure_speed(wanted)
        more, some = speed_sections(results)
        words += more
        tables += some
    if "methods" in wanted.parts:
        methods = measure_methods(*_METHOD_SCENE, min(wanted.repeats, 5), wanted.seed)
        tables.append(method_table(methods, *_METHOD_SCENE))
    if "error" in wanted.parts:
        generic, hard = generic_errors(wanted.error_sizes, wanted.seed), hard_errors(hard_scenes())
        tables.append(image_table([*generic, *hard]))
        tables += gradient_tables(generic, hard)
        tables.append(backward_table(wanted.seed))
    out.mkdir(parents=True, exist_ok=True)
    pictures = panels(results, methods)
    if pictures:
        write_svg(pictures, out / "kernels.svg")
    head = header(wanted, time.perf_counter() - begun)
    lines = ["# Kernels: speed against error", "", *_paragraphs(head)]
    lines += ["![](kernels.svg)", ""] if pictures else []
    lines += _paragraphs(words) + [table.markdown() for table in tables]
    text = "\n".join(lines)
    (out / "kernels.md").write_text(text, encoding="utf-8")
    return text


def _paragraphs(sentences: list[str]) -> list[str]:
    return [line for sentence in sentences for line in (sentence, "")]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="10k and 50k at 400x300 only")
    parser.add_argument("--only", action="append", choices=PARTS, help="may be given repeatedly")
    parser.add_argument("--out", type=Path, default=DOCS, help="folder of kernels.md")
    parser.add_argument("--threads", type=int, default=0, help="0 uses every core")
    parser.add_argument("--repeats", type=int, default=0, help="timed rounds at most")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    print(run(plan(chosen), chosen.out))


if __name__ == "__main__":
    main()

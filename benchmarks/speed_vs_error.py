# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure speed against error and write the report: ``python -m benchmarks.speed_vs_error``.

Every run is a job through the command line, on photos of scenes whose surface is known exactly
(``benchmarks/scenes``). It writes ``README.md``, ``speed-vs-error.svg`` and pictures into
``docs/benchmarks``.
"""

from __future__ import annotations

import argparse
import datetime
import logging
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.kernels.parallel import default_threads

from .scenes import ensure_scene
from .speed_error.document import write_document
from .speed_error.plan import Plan, Run, full_plan, quick_plan
from .speed_error.results import Outcome, Result, is_plain
from .speed_error.runs import ROOT, Settings, judged_by, measured, run_variant, run_wrap, warm_up

_logger = logging.getLogger("benchmarks")

CACHE = ROOT / ".cache" / "speed_vs_error"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="Draft alone, fewer and smaller photos"
    )
    parser.add_argument("--out", type=Path, help="folder of the report")
    parser.add_argument("--threads", type=int, default=0, help="0 uses every core")
    parser.add_argument(
        "--reuse", action="store_true", help="keep finished runs: only if the code is the same"
    )
    parser.add_argument("--scenes", nargs="+", help="only runs of these scenes")
    options = parser.parse_args(arguments)
    plan = quick_plan() if options.quick else full_plan()
    known = {run.scene for run in plan.runs}
    if unknown := set(options.scenes or ()) - known:
        parser.error(f"unknown scenes {sorted(unknown)}; there are {', '.join(sorted(known))}")
    if options.scenes and not options.out:
        parser.error("--scenes makes a part of the report: name its folder with --out")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    logging.getLogger("PIL").setLevel(logging.WARNING)
    kind = "quick" if options.quick else "full"
    settings = Settings(CACHE / kind, options.threads or default_threads(), options.reuse)
    out = options.out or (CACHE / "quick-report" if options.quick else ROOT / "docs/benchmarks")
    out.mkdir(parents=True, exist_ok=True)
    begun_s = time.monotonic()
    outcome = carry_out(plan, settings, options.scenes)
    words = sys.argv[1:] if arguments is None else list(arguments)
    facts = {
        "command": " ".join(["python -m benchmarks.speed_vs_error", *words]),
        "date": datetime.date.today().isoformat(),
        "photos": plan.photos,
        "runs": settings.folder,
    }
    write_document(out, outcome, facts)
    _logger.info("report after %.0f minutes: %s", (time.monotonic() - begun_s) / 60, out)


def carry_out(plan: Plan, settings: Settings, only: Sequence[str] | None = None) -> Outcome:
    """Render, run and score everything that is planned."""
    runs = [run for run in plan.runs if not only or run.scene in only]
    photos = plan.photos
    folders = {}
    for name in dict.fromkeys(run.scene for run in runs):
        begun_s = time.monotonic()
        folders[name] = ensure_scene(
            name, photos=photos.count, width=photos.width, height=photos.height
        )
        _logger.info("scene %s: %.0f s", name, time.monotonic() - begun_s)
    warm_up(next(iter(folders.values())), settings)
    results = []
    for number, run in enumerate(runs):
        results += carry_out_run(run, folders[run.scene], settings)
        _log(f"{number + 1}/{len(runs)} {run.identity}", results[-1 - len(run.variants)])
    poses, ceilings, kernels = {}, {}, {}
    for name, scene in folders.items():
        path = settings.folder / f"{name}-truth.json"
        ceilings[name] = judged_by("score", [str(scene), str(path)], path, settings)
        if name in plan.pose_scenes:
            path = settings.folder / f"{name}-poses" / "poses.json"
            arguments = [str(scene), str(path.parent)]
            poses[name] = judged_by("poses", arguments, path, settings)
            _logger.info("poses of %s: %.0f s", name, poses[name]["seconds"])
    for run in runs:
        if run.scene in plan.pose_scenes and run.preset == "draft" and is_plain(run):
            folder = settings.folder / run.identity
            path = folder / "vacancy-kernel.json"
            arguments = [str(folders[run.scene]), str(folder / "out"), str(path)]
            kernels[run.scene] = judged_by("vacancy_kernel", arguments, path, settings)
    return Outcome(folders, results, poses, ceilings, kernels)


def carry_out_run(run: Run, scene: Path, settings: Settings) -> list[Result]:
    """Return the result of a run and those of its variants."""
    folder = run_wrap(run, scene, settings)
    job = ["--job", str(folder / "out")]
    path = folder / "scores.json"
    arguments = [str(scene), str(path), "--mesh", str(folder / "mesh"), *job, "--stages"]
    scores = judged_by("score", arguments, path, settings)
    results = [Result(run, None, measured(folder), scores)]
    for variant in run.variants:
        made = run_variant(variant, folder, scene, settings)
        path = made / "scores.json"
        arguments = [str(scene), str(path), "--mesh", str(made / "mesh"), *job]
        judged = judged_by("score", arguments, path, settings)
        results.append(Result(run, variant, measured(made), {**scores, **judged}))
        _log(f"  {variant.name} {variant.parameter}", results[-1])
    return results


def _log(name: str, result: Result) -> None:
    _logger.info(
        "%s: %.0f s, F1 %s, mesh %.2f dB",
        name,
        result.wall_s,
        " ".join(f"{value:.3f}" for value in result.surface("uniform", "f1")),
        math.nan if result.texture_psnr is None else result.texture_psnr,
    )


if __name__ == "__main__":
    main()

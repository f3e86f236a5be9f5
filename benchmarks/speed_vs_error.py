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
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.parallel import default_threads

from .scenes import ensure_scene
from .speed_error.document import write_document
from .speed_error.plan import Plan, full_plan, quick_plan
from .speed_error.poses import pose_scores
from .speed_error.results import Result
from .speed_error.runs import ROOT, Settings, measured, run_variant, run_wrap, score

_logger = logging.getLogger("benchmarks")

CACHE = ROOT / ".cache" / "speed_vs_error"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer, smaller photos; no Fine")
    parser.add_argument("--out", type=Path, help="folder of the report")
    parser.add_argument("--threads", type=int, default=0, help="0 uses every core")
    parser.add_argument(
        "--reuse", action="store_true", help="keep finished runs: only if the code is the same"
    )
    parser.add_argument("--scenes", nargs="+", help="only runs of these scenes")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    logging.getLogger("PIL").setLevel(logging.WARNING)
    kind = "quick" if options.quick else "full"
    settings = Settings(CACHE / kind, options.threads or default_threads(), options.reuse)
    out = options.out or (CACHE / "quick-report" if options.quick else ROOT / "docs/benchmarks")
    out.mkdir(parents=True, exist_ok=True)
    plan = quick_plan() if options.quick else full_plan()
    begun_s = time.monotonic()
    folders, results, poses = carry_out(plan, settings, options.scenes)
    facts = {
        "command": f"python -m benchmarks.speed_vs_error{' --quick' if options.quick else ''}",
        "date": datetime.date.today().isoformat(),
        "minutes": (time.monotonic() - begun_s) / 60.0,
        "reused": options.reuse,
        "photos": plan.photos,
        "runs": settings.folder,
    }
    write_document(out, results, poses, folders, facts)
    _logger.info("report: %s", out / "README.md")


def carry_out(
    plan: Plan, settings: Settings, only: Sequence[str] | None = None
) -> tuple[dict[str, Path], list[Result], dict[str, dict[str, Any]]]:
    """Render, run and score everything; return the scenes' folders, results and pose errors."""
    runs = [run for run in plan.runs if not only or run.scene in only]
    names = dict.fromkeys(run.scene for run in runs)
    photos = plan.photos
    folders = {}
    for name in names:
        _logger.info("scene %s", name)
        folders[name] = ensure_scene(
            name, photos=photos.count, width=photos.width, height=photos.height
        )
    results = []
    for number, run in enumerate(runs):
        scene = folders[run.scene]
        folder = run_wrap(run, scene, settings)
        scores = score(folder, scene, settings, stages=True)
        results.append(Result(run, None, measured(folder), scores))
        _log(f"{number + 1}/{len(runs)} {run.identity}", results[-1])
        for variant in run.variants:
            made = run_variant(variant, folder, scene, settings)
            judged = score(made, scene, settings, stages=False)
            results.append(Result(run, variant, measured(made), {**scores, **judged}))
            _log(f"  {variant.name} {variant.parameter}", results[-1])
    poses = {}
    for name in plan.pose_scenes:
        if name in folders:
            poses[name] = pose_scores(name, folders[name], settings)
            _logger.info("poses of %s: %.0f s", name, poses[name]["seconds"])
    return folders, results, poses


def _log(name: str, result: Result) -> None:
    _logger.info(
        "%s: %.0f s, F1 %s, mesh %.2f dB",
        name,
        result.wall_s,
        " ".join(f"{value:.3f}" for value in result.surface("uniform", "f1")),
        result.scores["texture"]["psnr"],
    )


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure what each part of training costs and gains: ``python -m benchmarks.training``.

Every run is a job through the command line, on photos of scenes whose surface is known exactly
(``benchmarks/scenes``) and on real photos. It writes ``training.md``, plots and pictures into
``docs/benchmarks``; with ``--acceptance`` the targets of training into ``training-acceptance.md``.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.kernels.parallel import default_threads

from .speed_error.runs import ROOT, Settings
from .training_study.acceptance import acceptance_plan
from .training_study.carry_out import carry_out
from .training_study.document import write_acceptance, write_study
from .training_study.plan import Plan, full_plan, quick_plan

_logger = logging.getLogger("benchmarks")

CACHE = ROOT / ".cache" / "training_study"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the command line asks for; return 1 where a run failed, else 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--quick", action="store_true", help="few iterations on small photos")
    kinds.add_argument("--acceptance", action="store_true", help="the targets instead of the study")
    parser.add_argument("--data", type=Path, help="folder with real sets: fox/, flowerpot/")
    parser.add_argument("--out", type=Path, help="folder of the report")
    parser.add_argument("--threads", type=int, default=0, help="0 uses every core")
    parser.add_argument("--minutes", type=float, help="begin no run after this; 0: no limit")
    parser.add_argument(
        "--reuse", action="store_true", help="keep finished runs: only if the code is the same"
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD",
        help="make only runs of these parts, scenes, presets, rows; with --reuse show the others",
    )  # fmt: skip
    options = parser.parse_args(arguments)
    plan, kind = _plan(options)
    known = {word for case in plan.cases for word in case.words}
    if unknown := set(options.only) - known:
        parser.error(f"nothing is called {sorted(unknown)}; there are {', '.join(sorted(known))}")
    if options.only and not options.out and not options.reuse:
        parser.error("--only makes a part of the report: name its folder with --out, or --reuse")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    logging.getLogger("PIL").setLevel(logging.WARNING)
    settings = Settings(CACHE / kind, options.threads or default_threads(), options.reuse)
    out = options.out or (CACHE / "quick-report" if options.quick else ROOT / "docs/benchmarks")
    out.mkdir(parents=True, exist_ok=True)
    begun_s = time.monotonic()
    outcome = carry_out(plan, settings, options.data, options.only)
    for name, reason in outcome.missing:
        _logger.info("not measured: %s: %s", name, reason)
    if not outcome.runs:
        _logger.error("nothing was measured, no report was written")
        return 1
    words = sys.argv[1:] if arguments is None else list(arguments)
    facts = {
        "command": " ".join(["python -m benchmarks.training", *_without_folders(words)]),
        "date": datetime.date.today().isoformat(),
    }
    write = write_acceptance if options.acceptance else write_study
    path = write(out, outcome, facts)
    _logger.info("report after %.0f minutes: %s", (time.monotonic() - begun_s) / 60, path)
    return int(outcome.failed)


def _plan(options: argparse.Namespace) -> tuple[Plan, str]:
    """Return the plan that the options ask for, and the name of the folder of its runs."""
    if options.acceptance:
        plan, kind = acceptance_plan(), "acceptance"
    elif options.quick:
        plan, kind = quick_plan(), "quick"
    else:
        plan, kind = full_plan(), "full"
    minutes = plan.minutes if options.minutes is None else options.minutes
    return dataclasses.replace(plan, minutes=minutes), kind


def _without_folders(words: Sequence[str]) -> list[str]:
    """Return the arguments with folders' names only, for the record."""
    return [Path(word).name if "/" in word or "\\" in word else word for word in words]


if __name__ == "__main__":
    raise SystemExit(main())

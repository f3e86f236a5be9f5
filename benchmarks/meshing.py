# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure meshing, speed against error: ``python -m benchmarks.meshing --data DIR``.

Each scene is trained once through the command line. Then marching tetrahedra on two and nine
pivots, primal adaptive meshing with uniform and adaptive spacing, and TSDF fusion of rendered depth
maps mesh it, each in a process of its own. ``meshing.md`` and its plots go into
``docs/benchmarks``: the targets of meshing with what was measured, and all figures.
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

from .meshing_study.carry_out import carry_out
from .meshing_study.document import write_document
from .meshing_study.plan import full_plan, quick_plan
from .speed_error.runs import ROOT, Settings

_logger = logging.getLogger("benchmarks")

CACHE = ROOT / ".cache" / "meshing_study"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the command line asks for; return 1 where something failed, else 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one scene, few iterations and points")
    parser.add_argument(
        "--data", type=Path, help="folder with real sets: fox/, flowerpot/, banana/"
    )
    parser.add_argument("--out", type=Path, help="folder of the report")
    parser.add_argument("--threads", type=int, default=0, help="0 uses every core")
    parser.add_argument("--minutes", type=float, help="begin nothing after this; 0: no limit")
    parser.add_argument(
        "--reuse", action="store_true", help="keep all that is finished: only for the same code"
    )
    parser.add_argument(
        "--keep-trainings", action="store_true", help="keep finished trainings, mesh them anew"
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD",
        help="make only these scenes, methods, meshes; with --reuse show the others",
    )  # fmt: skip
    options = parser.parse_args(arguments)
    plan, kind = (quick_plan(), "quick") if options.quick else (full_plan(), "full")
    if options.minutes is not None:
        plan = dataclasses.replace(plan, minutes=options.minutes)
    if unknown := set(options.only) - plan.words:
        known = ", ".join(sorted(plan.words))
        parser.error(f"nothing is called {sorted(unknown)}; there are {known}")
    if options.only and not options.out and not options.reuse:
        parser.error("--only makes a part of the report: name its folder with --out, or --reuse")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    threads = options.threads or default_threads()
    settings = Settings(CACHE / kind, threads, options.reuse)
    out = options.out or (CACHE / "quick-report" if options.quick else ROOT / "docs/benchmarks")
    out.mkdir(parents=True, exist_ok=True)
    begun_s = time.monotonic()
    outcome = carry_out(
        plan, settings, options.data, options.only, keep_trainings=options.keep_trainings
    )
    for name, reason in outcome.missing:
        _logger.info("not measured: %s: %s", name, reason)
    if not outcome.made and outcome.vacancy is None:
        _logger.error("nothing was measured, no report was written")
        return 1
    words = sys.argv[1:] if arguments is None else list(arguments)
    facts = {
        "command": " ".join(["python -m benchmarks.meshing", *_without_folders(words)]),
        "date": datetime.date.today().isoformat(),
        "threads": threads,
    }
    path = write_document(out, outcome, facts)
    _logger.info("report after %.0f minutes: %s", (time.monotonic() - begun_s) / 60, path)
    return int(outcome.failed)


def _without_folders(words: Sequence[str]) -> list[str]:
    """Return the arguments with folders' names only, for the record."""
    return [Path(word).name if "/" in word or "\\" in word else word for word in words]


if __name__ == "__main__":
    raise SystemExit(main())

# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure meshing, speed against error: ``python -m benchmarks.meshing --data DIR``.

Each scene is trained once through the command line. Then marching tetrahedra on two and nine
pivots, primal adaptive meshing with uniform and adaptive spacing, and TSDF fusion of rendered depth
maps mesh it, each in a process of its own. The figures are kept in
``benchmarks/records/meshing.json``; a page and its plots go into ``docs/benchmarks``: the
targets of meshing with what was measured, and all figures.
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
import sys
import time
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.parallel import default_threads

from .meshing_runs import Made, Outcome, Plan, carry_out, full_plan, quick_plan
from .meshing_tables import (
    SHOWN,
    acceptance_table,
    cost_table,
    isosurface_table,
    solid_table,
    training_table,
    truth_table,
    write_plots,
)
from .provenance import (
    RECORDS,
    ROOT,
    UNKNOWN,
    Code,
    code_of_tree,
    read_figures,
    write_figures,
    write_page,
)
from .runs import Settings
from .tables import missing_table

PAGE = "meshing"
"""Name of the page and of the record."""


def write_document(out: Path, outcome: Outcome, facts: dict[str, Any]) -> Path:
    """Write the page and its plots into a folder.

    Parameters
    ----------
    out : Path
        Must exist.
    outcome : Outcome
    facts : dict
        ``command``, ``date``, ``threads``, ``machine`` and ``versions``.
    """
    made = outcome.made
    plots = out / f"{PAGE}.svg"
    plots.unlink(missing_ok=True)
    write_plots(made, plots)
    tables = [
        cost_table(made),
        isosurface_table(made),
        truth_table(made),
        solid_table(made),
        training_table(outcome.trainings),
        missing_table(outcome.missing),
    ]
    targets = acceptance_table(outcome)
    lines = [
        *_made_by(outcome, facts),
        "",
        *_photos(outcome),
        "",
        *([targets.markdown()] if targets.rows else []),
        *([f"![Plots]({PAGE}.svg)", "", _plot_words(), ""] if plots.is_file() else []),
        "## Tables",
        "",
        *(table.markdown() for table in tables if table.rows),
    ]
    codes = {m.figures["code"].split()[0] for m in made}
    codes |= {str(run.get("code", UNKNOWN)).split()[0] for run in outcome.trainings.values()}
    return write_page(out / f"{PAGE}.md", "Meshing: speed against error", sorted(codes), lines)


def _made_by(outcome: Outcome, facts: dict[str, Any]) -> list[str]:
    """Return command, date, machine, versions, code, load and time, as lines."""
    made = outcome.made
    trained = sorted({run.get("code", "not recorded") for run in outcome.trainings.values()})
    codes = sorted({m.figures["code"] for m in made})
    loads = [m.figures["load_before"] for m in made if m.figures["load_before"] is not None]
    seconds = sum(m.figures["wall_s"] + m.scores["seconds_scoring"] for m in made)
    seconds += sum(run["wall_s"] for run in outcome.trainings.values())
    load = f"{max(loads):.1f}" if loads else "not recorded"
    return [
        f"`{facts['command']}`, {facts['date']}. {facts['machine']}, {facts['threads']} threads;",
        f"{facts['versions']}, Open3D {_open3d()}.",
        f"Code of the meshes: {', '.join(codes) or 'none'}; of the trainings:",
        f"{', '.join(trained) or 'none'}. {len(made)} meshes; they, their scores and the trainings",
        f"took {seconds / 60:.0f} minutes (references not counted); largest load average before a",
        f"mesh: {load}.",
    ]


def _photos(outcome: Outcome) -> list[str]:
    subjects = {m.subject.name: m.subject for m in outcome.made}.values()
    sizes = dict.fromkeys(s.photos for s in subjects if s.photos is not None)
    lines = [
        f"Rendered scenes: {p.count} photos of {p.width} x {p.height} pixels, exact cameras, true "
        "surface known."
        for p in sizes
    ]
    if any(s.photos is None for s in subjects):
        lines.append("Real photos: as they are, with the cameras of their COLMAP model; no truth.")
    presets = sorted({s.run.preset for s in subjects})
    return [*lines, f"Trained by preset {', '.join(presets)}, seed 0. Methods of a scene share it."]


def _plot_words() -> str:
    scenes = ", ".join(SHOWN)
    return (
        f"Of {scenes}, where measured. Numbers beside points: points asked for, pivots a Gaussian, "
        "voxels along the diagonal."
    )


def _open3d() -> str:
    try:
        return metadata.version("open3d")
    except metadata.PackageNotFoundError:
        return "is not installed"


def keep(path: Path, outcome: Outcome, facts: dict[str, Any], code: Code) -> None:
    """Write the record of a study."""
    made = [
        {"scene": m.subject.name, "method": m.method.identity, "figures": m.figures,
         "scores": m.scores}
        for m in outcome.made
    ]  # fmt: skip
    figures = {
        "command": facts["command"], "made": made, "trainings": outcome.trainings,
        "vacancy": outcome.vacancy, "missing": outcome.missing,
    }  # fmt: skip
    write_figures(path, figures, facts["threads"], code)


def kept(path: Path, plan: Plan) -> tuple[Outcome, dict[str, Any]]:
    """Return outcome and facts of a record, as far as the plan still has its scenes."""
    record = read_figures(path)
    subjects = {subject.name: subject for subject in plan.subjects}
    made = []
    for row in record["made"]:
        subject = subjects.get(row["scene"])
        for method in subject.methods if subject else ():
            if method.identity == row["method"]:
                made.append(Made(subject, method, row["figures"], row["scores"]))
    missing = [(name, reason) for name, reason in record["missing"]]
    facts = {name: record[name] for name in ("command", "threads", "machine", "versions")}
    outcome = Outcome(made, record["trainings"], record["vacancy"], missing, False)
    return outcome, {**facts, "date": record["date"][:10]}


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
    begun_s, code = time.monotonic(), code_of_tree()
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
        "threads": threads,
    }
    record = out / f"{PAGE}.json" if options.out or options.quick else RECORDS / f"{PAGE}.json"
    keep(record, outcome, facts, code)
    path = write_document(out, *kept(record, plan))
    _logger.info("report after %.0f minutes: %s", (time.monotonic() - begun_s) / 60, path)
    return int(outcome.failed)


def _without_folders(words: Sequence[str]) -> list[str]:
    """Return the arguments with folders' names only, for the record."""
    return [Path(word).name if "/" in word or "\\" in word else word for word in words]


if __name__ == "__main__":
    raise SystemExit(main())

# SPDX-License-Identifier: GPL-3.0-or-later
"""What single parts of the method are worth, and what deciding costs, on scenes of the zoo.

``python -m benchmarks.zoo.parts parts --only SCENE ...`` leaves one part of the method out at a
time, with several seeds. ``python -m benchmarks.zoo.parts decisions --only SCENE ...`` runs
``auto`` beside fixed combinations of the settings that it decides. What has a record is not made
again; ``--document`` writes the page.
"""

from __future__ import annotations

import argparse
import logging
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.errors import WrapError
from gaussian_wrapping_addon.core.settings import MODEL_SELECTION

from ..provenance import DOCUMENTS, RECORDS, write_page
from ..study import (
    Case,
    Record,
    carry_out,
    commits,
    f1_middle,
    f1_seen,
    made_by,
    read_records,
    reading,
    view_psnr,
)
from ..tables import AT, Row, Table, table_of, three, two
from .catalogue import SCENES
from .study import find_scene, floaters, make_one, scene_photos

_logger = logging.getLogger("benchmarks")

STUDY = "zoo-parts"
PAGE = "zoo-parts.md"
COMMAND = "python -m benchmarks.zoo.parts"
PRESET = "draft"
SEEDS = (0, 1, 2)

WHOLE = "whole"
PARTS: dict[str, tuple[str, ...]] = {
    WHOLE: (),
    "sparse_start": ("--dense-start", "off"),
    "no_depth_loss": ("--lambda-depth-prior", "0"),
    "no_free_space": ("--free-views", "0"),
    "no_opacity_prior": ("--lambda-opacity", "0"),
    "no_footprint": ("--overlap-price", "0"),
}
"""Arguments that leave a part out, by the name of the run."""

FULLEST, LEAST = "all_on", "all_off"
DECISIONS: dict[str, tuple[str, ...]] = {
    WHOLE: (),
    FULLEST: ("--needs", "all"),
    LEAST: ("--needs", "none"),
    **{
        f"on_but_{name}": ("--needs", "all", f"--{name.replace('_', '-')}", "off")
        for name in MODEL_SELECTION
    },
}
"""``auto``, whose runs are those of the whole method, and combinations that decide nothing."""

STUDIES = {"parts": (PARTS, SEEDS), "decisions": (DECISIONS, SEEDS[:1])}


def planned(study: str, scenes: Sequence[str], seeds: Sequence[int] = ()) -> list[Case]:
    """Return the runs of a study, seed by seed, so that what is there can be compared."""
    variants, its_seeds = STUDIES[study]
    return [
        Case(STUDY, scene, name, seed, PRESET, arguments, photos=scene_photos(scene))
        for scene in scenes
        for seed in seeds or its_seeds
        for name, arguments in variants.items()
    ]


def main(given: Sequence[str] | None = None) -> int:
    """Run the command line, return the exit code."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument("study", choices=tuple(STUDIES), nargs="?", default="parts")
    parser.add_argument("--only", nargs="+", default=[], metavar="SCENE", choices=tuple(SCENES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[], metavar="SEED")
    parser.add_argument("--runs", type=int, default=0, help="make at most so many; 0: no limit")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--document", action="store_true", help="write the page, make no run")
    options = parser.parse_args(given)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    failed = 0
    try:
        if not options.document:
            failed = carry_out(
                planned(options.study, options.only, options.seeds), threads=options.threads,
                runs=options.runs, maker=make_one, find_scene=find_scene,
            )  # fmt: skip
        path = write_document(DOCUMENTS)
        _logger.info("%s", path or "there is no record yet, so no page")
    except WrapError as error:
        _logger.error("%s", error)
        return error.exit_code
    return int(failed > 0)


def parts_table(records: Sequence[Record]) -> Table:
    """Return one row a scene and part: means and standard deviations over seeds."""
    rows: list[Row] = []
    for scene in SCENES:
        for name in PARTS:
            mine = [r for r in records if (r.case.scene, r.case.name) == (scene, name)]
            if not mine:
                continue
            views = [v for r in mine if (v := view_psnr(r)) is not None]
            rows.append(
                {
                    "scene": scene,
                    "run": name.replace("_", " "),
                    "seeds": str(len(mine)),
                    f"seen F1 {AT}": _spread([f1_seen(r) for r in mine]),
                    f"whole F1 {AT}": _spread([f1_middle(r) for r in mine]),
                    "floaters": _spread([floaters(r) for r in mine]),
                    "test dB": _spread(views, 2) if views else None,
                    "processor s": f"{statistics.mean(r.spent_s for r in mine):.0f}",
                }
            )
    return table_of("Parts", rows, "Mean ± standard deviation over the seeds.")


def _spread(values: Sequence[float], digits: int = 3) -> str:
    spread = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):.{digits}f}{spread}"


def decisions_table(records: Sequence[Record]) -> Table:
    """Return one row a scene: ``auto`` beside the best and the fullest fixed combination."""
    rows: list[Row] = []
    for scene in SCENES:
        mine = {r.case.name: r for r in records if (r.case.scene, r.case.seed) == (scene, 0)}
        fixed = {n: r for n, r in mine.items() if n in DECISIONS and n != WHOLE}
        if not fixed or WHOLE not in mine:
            continue
        auto = mine[WHOLE]
        best = max(fixed, key=lambda name: f1_seen(fixed[name]))
        full = fixed.get(FULLEST)
        rows.append(
            {
                "scene": scene,
                "combinations": f"{len(fixed)} of {len(DECISIONS) - 1}",
                f"auto: seen F1 {AT}": three(f1_seen(auto)),
                "best": best.replace("_", " "),
                f"best: seen F1 {AT}": three(f1_seen(fixed[best])),
                "lost": three(max(f1_seen(fixed[best]) - f1_seen(auto), 0.0)),
                "auto: test dB": two(view_psnr(auto)),
                "best: test dB": two(view_psnr(fixed[best])),
                "auto: processor s": f"{auto.spent_s:.0f}",
                "all on: processor s": None if full is None else f"{full.spent_s:.0f}",
                "saved": None if full is None else two(1.0 - auto.spent_s / full.spent_s),
            }
        )
    return table_of(
        "Decisions", rows,
        "Fixed combinations: all settings that auto decides on, all off, all but one on. Saved: "
        "share of the processor seconds of all on.",
    )  # fmt: skip


def write_document(folder: Path, root: Path = RECORDS) -> Path | None:
    """Write the page and return its path; ``None`` if there is no record."""
    scenes = sorted({p.name.rpartition("-seed")[0] for p in (root / STUDY).glob("*.json")})
    shown = [s for s in SCENES if any(name.startswith(f"{s}-") for name in scenes)]
    cases = {c.identity: c for study in STUDIES for c in planned(study, shown)}
    records = list(read_records(cases.values(), root).values())
    if not records:
        return None
    begun = {(r.case.scene, r.case.name in PARTS, r.case.seed) for r in records}
    awaited = [c for c in cases.values() if (c.scene, c.name in PARTS, c.seed) in begun]
    lines = reading("zoo-parts")
    lines += made_by(COMMAND, records, awaited)
    lines += ["", f"Preset {PRESET}.", ""]
    lines += [parts_table(records).markdown(), "", decisions_table(records).markdown()]
    title = "Parts of the method, and decisions"
    return write_page(folder / PAGE, title, commits(records), lines)


if __name__ == "__main__":
    sys.exit(main())

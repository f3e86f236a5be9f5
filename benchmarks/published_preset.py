# SPDX-License-Identifier: GPL-3.0-or-later
"""The preset Paper beside Standard on one scene: ``python -m benchmarks.published_preset``.

30 000 iterations on whole photos take days on a processor, so Paper runs with fewer of them here:
its milestones are shares of them, so every phase of the schedule takes place. It is run with and
without wrapping. Each run leaves a record in ``benchmarks/records/published_preset``; runs with a
record are not made again without ``--again``. ``docs/benchmarks/published-preset.md`` is written
from the records and the reading beside it.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.settings import preset

from .judged_run import SHARES, judged_run
from .scenes import ensure_scene
from .speed_error.plan import Run
from .speed_error.runs import ROOT
from .tables import Table

_logger = logging.getLogger("benchmarks")

SCENE = "wheel"
LONG_SIDE_PX = 240
PAPER_ITERATIONS = 1500
_COMMON = ("--max-image-px", str(LONG_SIDE_PX), "--holdout", "0", "--texture-size", "256")
_FEWER = ("--iterations", str(PAPER_ITERATIONS))

RUNS = (
    Run(SCENE, "standard", 0, "decided", _COMMON),
    Run(SCENE, "paper", 0, "wrapping", (*_COMMON, *_FEWER)),
    Run(SCENE, "paper", 0, "plain", (*_COMMON, *_FEWER, "--wrapping", "off")),
)
"""Standard lets the photos decide; Paper has wrapping on, or off."""

LABELS = {
    "decided": "Standard",
    "wrapping": "Paper",
    "plain": "Paper, wrapping off",
}
RECORDS = ROOT / "benchmarks" / "records" / "published_preset"
DOCUMENT = ROOT / "docs" / "benchmarks" / "published-preset.md"
READING = DOCUMENT.with_name("published-preset-reading.md")


_PROTOCOL = (
    f"Scene `{SCENE}`: 40 photos of 640 x 480 pixels with exact cameras, trained at a long side of "
    f"{LONG_SIDE_PX} pixels, seed 0. Every phase of the published schedule takes place, in fewer "
    "iterations."
)

_NOTE = (
    "PSNR of eight test views that no run was given. F1 over the whole true surface at shares of "
    "the crop volume's diagonal; thin recall on parts thinner than 1.5 % of it; normals: mean "
    "absolute cosine between corresponding normals."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the runs that have no record, then write the document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--again", action="store_true", help="make runs anew that have a record")
    parser.add_argument("--document", action="store_true", help="write the document only")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    for run in () if options.document else RUNS:
        path = _path(run)
        if options.again or not path.is_file():
            scene = ensure_scene(run.scene)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, {**judged_run(run, scene, scene, options.threads), "run": run.name})
            _logger.info("%s", path.name)
    DOCUMENT.write_text(document(), encoding="utf-8")
    return 0


def _cells(of: dict[str, Any]) -> tuple[str | float | int | None, ...]:
    """Return one row of the table."""
    iterations, spent_s = of["iterations"], of["train_processor_s"]
    published = preset("paper").training.iterations
    return (
        LABELS[of["run"]],
        iterations,
        f"{100 * iterations / published:.0f} %" if of["run"] != "decided" else "",
        of["gaussians"],
        None if spent_s is None else round(spent_s),
        None if spent_s is None else f"{spent_s / iterations:.2f}",
        f"{of['psnr']:.2f}",
        *(f"{value:.3f}" for value in of["f1"].values()),
        "" if of["thin_recall"] is None else f"{of['thin_recall']:.3f}",
        f"{of['normals']:.3f}",
    )


def document() -> str:
    """Return the document from all records."""
    records = [read_json(p) for run in RUNS if (p := _path(run)).is_file()]
    header = (
        "preset",
        "iterations",
        "of the published",
        "Gaussians",
        "training processor s",
        "s an iteration",
        "PSNR dB",
        *(f"F1 {share}" for share in SHARES),
        "thin recall 0.5 %",
        "normals",
    )
    table = Table("Presets", header, [_cells(of) for of in records], (_NOTE,))
    facts = sorted({f"code {of['code']}, {of['date']}, {of['machine']}" for of in records})
    lines = [
        "# The published settings beside Standard",
        "",
        f"`python -m benchmarks.published_preset`; {'; '.join(facts)}, 1 thread.",
        "",
        _PROTOCOL,
        "",
        READING.read_text(encoding="utf-8") if READING.is_file() else "",
        table.markdown(),
    ]
    return "\n".join(lines)


def _path(run: Run) -> Path:
    return RECORDS / f"{run.scene}-{run.name}.json"


if __name__ == "__main__":
    raise SystemExit(main())

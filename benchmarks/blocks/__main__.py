# SPDX-License-Identifier: GPL-3.0-or-later
"""Blocks against one training, on photos of a street: ``python -m benchmarks.blocks``.

Each step (the whole training; the coarse one with its plan; each block; joining; meshes) runs in a
process of its own, blocks two at a time with one thread, the others alone with two. Both results
have the same limit of Gaussians. A step that has its figures is not run again. The street is as
long as it has photos: comparisons of 50, 100, 200 and 400 photos make the curve of cost.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from gaussian_wrapping_addon.core.training.blocks.block_settings import BlockSettings

from .comparison import COARSE, JOINED, TURNS, WHOLE, Comparison
from .document import PAPER_MACHINES, PAPER_PHOTOS, paper_plan, write_document
from .record import make_record, read_records, write_record
from .road import StepFailed, walk
from .street import make_scene

PHOTOS_PER_BLOCK = 100
DOCUMENTS = Path(__file__).resolve().parents[2] / "docs" / "benchmarks"


def main(given: Sequence[str] | None = None, say: Callable[[str], object] = print) -> int:
    """Do what the command line asks for; return 1 where a step failed, else 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blocks", description=__doc__)
    parser.add_argument(
        "folder", type=Path, nargs="?", help="photos and results, made if missing; without it the "
        "page is written from the records",
    )  # fmt: skip
    parser.add_argument(
        "--plan", type=int, nargs=2, metavar=("PHOTOS", "MACHINES"),
        help=f"print the plan on paper; the page has that of {PAPER_PHOTOS} on {PAPER_MACHINES}",
    )  # fmt: skip
    parser.add_argument("--photos", type=int, default=400)
    parser.add_argument("--width", type=int, default=640, help="of photos, pixels")
    parser.add_argument("--blocks", type=int, default=0, help="0: one for 100 photos")
    parser.add_argument("--turns", type=float, default=TURNS, help="iterations for each photo")
    parser.add_argument("--max-image-px", type=int, default=640, help="photos are trained at")
    parser.add_argument("--dense-start", choices=("auto", "on", "off"), default="auto")
    parser.add_argument("--margin", type=float, default=BlockSettings.margin)
    parser.add_argument("--polish", type=float, default=BlockSettings.polish_iterations)
    parser.add_argument("--label", default="", help="name of other settings, beside the usual ones")
    parser.add_argument("--meshes", nargs="*", default=[WHOLE, JOINED, COARSE], metavar="STEP")
    parser.add_argument("--step", help=argparse.SUPPRESS)  # the child process of one step
    parser.add_argument("--threads", type=int, default=2, help=argparse.SUPPRESS)
    words = list(sys.argv[1:] if given is None else given)
    asked = parser.parse_args(words)
    if asked.plan or asked.folder is None:
        return _on_paper(asked.plan, say)
    source = make_scene(asked.folder, asked.photos, asked.width, asked.threads)
    count = asked.blocks or max(1, asked.photos // PHOTOS_PER_BLOCK)
    blocks = BlockSettings(count, margin=asked.margin, polish_iterations=asked.polish)
    folder = asked.folder / f"{asked.photos}{asked.label and '-' + asked.label}"
    comparison = Comparison.of_street(
        folder, source, asked.photos, blocks, turns=asked.turns, max_image_px=asked.max_image_px,
        dense_start=asked.dense_start,
    )  # fmt: skip
    if asked.step:
        comparison.step(asked.step, asked.threads)
        return 0
    try:
        walk(comparison, ["benchmarks.blocks", *words], asked.meshes, say)
    except StepFailed as failed:
        say(f"{failed} failed")
        return 1
    say(str(write_record(make_record(comparison, asked.threads), asked.label)))
    return 0


def _on_paper(plan: Sequence[int] | None, say: Callable[[str], object]) -> int:
    """Write the page, or print the plan of a scene, from the records there are."""
    records = read_records()
    if plan is None:
        say(str(write_document(DOCUMENTS, records) or "there is no record yet, so no page"))
        return 0
    table = paper_plan(records, *plan)
    if table is None:
        say("A plan needs records of two streets.")
        return 1
    say(table.markdown())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

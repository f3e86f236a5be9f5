# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line that all studies share: make missing runs, then write the document."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.errors import UsageError

from ..speed_error.runs import ROOT
from .case import Case, named
from .making import Maker, SceneFinder, carry_out, make, rendered_scene
from .mesh_based import fill_in
from .record import Record, read_records

_logger = logging.getLogger("benchmarks")

DOCUMENTS = ROOT / "docs" / "benchmarks"

Writer = Callable[[Path, Mapping[str, Record], Sequence[Case]], Path]
"""Writes the document of the records into a folder and returns its page."""


def run_study(
    arguments: Sequence[str] | None,
    description: str | None,
    cases: Sequence[Case],
    write_document: Writer,
    maker: Maker = make,
    draw: Callable[[Path], None] | None = None,
    find_scene: SceneFinder = rendered_scene,
) -> int:
    """Do what the command line asks for; return 1 where a run failed or nothing is there, else 0.

    Parameters
    ----------
    cases : sequence of Case
        The whole plan, in the order in which it is made.
    maker : callable
        Makes one case and writes its record.
    draw : callable, optional
        Draws pictures of kept runs into the document's folder.
    find_scene : callable
        Where kernels are compiled on, before the first run.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--runs", type=int, default=0, help="make at most so many; 0: no limit")
    parser.add_argument("--again", action="store_true", help="make runs that have a record, too")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD",
        help="make runs of these scenes, names and seeds (seed0) only",
    )  # fmt: skip
    parser.add_argument(
        "--mbr", action="store_true",
        help="make no run: mesh-based rendering of the kept meshes whose record lacks it",
    )  # fmt: skip
    parser.add_argument("--document", action="store_true", help="make no run, write the document")
    if draw is not None:
        parser.add_argument(
            "--pictures", action="store_true", help="draw kept runs beside the document"
        )
    parser.add_argument("--out", type=Path, default=DOCUMENTS, help="folder of the document")
    options = parser.parse_args(arguments)
    try:
        chosen = named(cases, options.only)
    except UsageError as error:
        parser.error(str(error))
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    logging.getLogger("PIL").setLevel(logging.WARNING)
    failed = 0
    if options.mbr:
        failed = fill_in(chosen, threads=options.threads, runs=options.runs, again=options.again)
    elif not options.document:
        failed = carry_out(
            chosen, threads=options.threads, again=options.again, runs=options.runs, maker=maker,
            find_scene=find_scene,
        )  # fmt: skip
    records = read_records(cases)
    if not records:
        _logger.error("there is no record yet, so no document")
        return 1
    if draw is not None and options.pictures:
        draw(options.out)
    _logger.info("%s", write_document(options.out, records, cases))
    return int(failed > 0)

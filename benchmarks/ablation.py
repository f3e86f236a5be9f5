# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure what multi-view terms, orientation and clones gain: ``python -m benchmarks.ablation``.

Every run is a job through the command line on photos of a scene whose surface is known exactly
(``benchmarks/scenes``), with three seeds. Each leaves a record in ``benchmarks/records/ablation``;
a run that has one is not made again, so that the study may take several sittings: stop the command
whenever you like. At the end, or with ``--document``, ``docs/benchmarks/ablation.md`` and its plot
are written from the records alone.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.errors import UsageError

from .ablation_study.document import write_document
from .ablation_study.plan import plan
from .study.case import named
from .study.making import carry_out
from .study.record import read_records

DOCUMENTS = Path(__file__).resolve().parents[1] / "docs" / "benchmarks"

_logger = logging.getLogger("benchmarks")


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line asks for; return 1 where a run failed, else 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--runs", type=int, default=0, help="make at most so many; 0: no limit")
    parser.add_argument("--again", action="store_true", help="make runs that have a record, too")
    parser.add_argument("--only", nargs="+", default=[], help="these scenes, cells or seedN")
    parser.add_argument("--document", action="store_true", help="make no run, write the document")
    parser.add_argument("--out", type=Path, default=DOCUMENTS, help="folder of the document")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    cases = plan()
    try:
        chosen = named(cases, options.only)
    except UsageError as error:
        parser.error(str(error))
    failed = 0
    if not options.document:
        failed = carry_out(chosen, threads=options.threads, again=options.again, runs=options.runs)
    records = read_records(cases)
    if not records:
        _logger.error("there is no record yet, so no document")
        return 1
    _logger.info("%s", write_document(options.out, records, cases))
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())

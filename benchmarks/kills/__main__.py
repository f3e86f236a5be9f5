# SPDX-License-Identifier: GPL-3.0-or-later
"""Interrupt jobs and compare what they end in after a resume: ``python -m benchmarks.kills``.

A small job is ended by SIGKILL at random moments of every stage, cancelled, run on disks and in
address spaces that are too small, and left by its caller. Each time it is resumed, and its result
is compared bit for bit with that of the job without interruption. Outcomes are kept in
``benchmarks/records/kills``: what has one is not tried again, so that the command may be stopped at
any time. At the end ``docs/benchmarks/kills.md`` is written. Linux only: processes are found in
``/proc``, and small disks are mounted, which root may do.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ..study.command import DOCUMENTS
from .document import write_document
from .interruptions import carry_out
from .outcomes import read_outcomes, write_outcomes
from .small_job import make_reference
from .trials import WAYS, draw

_logger = logging.getLogger("benchmarks")


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the trials that have no outcome; return 1 where anything was not as it should be."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.kills",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--n", type=int, default=100, help="kills; other ways in proportion")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ways", nargs="+", choices=tuple(WAYS), default=list(WAYS))
    parser.add_argument("--again", action="store_true", help="forget the outcomes so far")
    parser.add_argument("--document", action="store_true", help="try nothing, write the page")
    parser.add_argument("--out", type=Path, default=DOCUMENTS, help="folder of the page")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    options.out.mkdir(parents=True, exist_ok=True)  # before hours of trials, not after
    outcomes = {} if options.again else read_outcomes()
    trials = draw(options.n, options.seed, tuple(options.ways))
    missing = [trial for trial in trials if trial.identity not in outcomes]
    if missing and not options.document:
        with tempfile.TemporaryDirectory(prefix="kills-") as folder:
            place = Path(folder)
            make_reference(place / "warm")  # compiles kernels
            reference = make_reference(place / "reference")
            _logger.info(
                "undisturbed: %s; %.1f MB on the disk, address space %.2f to %.2f GB",
                ", ".join(f"{k} {v:.1f} s" for k, v in reference.stage_seconds.items()),
                reference.disk_bytes / 1e6, reference.packages_bytes / 1e9,
                reference.peak_bytes / 1e9,
            )  # fmt: skip
            for trial in missing:
                outcome = carry_out(trial, reference, place)
                outcomes[trial.identity] = outcome
                write_outcomes(outcomes)
                _logger.info(
                    "%s at %s: code %s, %s", trial.identity, outcome.hit or "its end",
                    outcome.code, "; ".join(outcome.faults) or "as it should be",
                )  # fmt: skip
    path = write_document(options.out, outcomes, options.n)
    _logger.info("%s", path)
    return int(any(outcome.faults for outcome in outcomes.values()))


if __name__ == "__main__":
    raise SystemExit(main())

# SPDX-License-Identifier: GPL-3.0-or-later
"""Fuzz for as long as one likes.

    python -m tests.hostile.fuzz --seconds 60 [--seed N] [--only TARGET]

``--seconds`` is the time for each target. A failure names the options that repeat it.
"""

from __future__ import annotations

import argparse
import logging
import sys

from tests.hostile.fuzz.campaign import fuzz
from tests.hostile.fuzz.targets import TARGETS

_logger = logging.getLogger("tests.hostile.fuzz")


def main() -> int:
    """Run the campaigns; return 1 where one found a failure."""
    parser = argparse.ArgumentParser(prog="python -m tests.hostile.fuzz", description="Fuzz.")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each target")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=[target.name for target in TARGETS])
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--inputs", type=int, help="number of inputs, instead of seconds")
    options = parser.parse_args()
    _logger.addHandler(logging.StreamHandler(sys.stdout))
    _logger.setLevel(logging.INFO)
    failed = 0
    for target in TARGETS:
        if options.only in (None, target.name):
            report = fuzz(
                target, options.seed, first=options.first, inputs=options.inputs,
                seconds=options.seconds,
            )  # fmt: skip
            ended = ", ".join(f"{count} {name}" for name, count in report.ended.most_common())
            _logger.info("%-14s %7d inputs: %s", target.name, report.inputs, ended)
            for failure in report.failures:
                _logger.error("FAILED %s", failure)
            failed += len(report.failures)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

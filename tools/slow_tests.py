#!/usr/bin/env python3
# SPDX-License-Identifier: GPL-3.0-or-later
"""Write ``tests/slow_tests.txt`` from the durations of a whole run.

    python -m pytest --durations=0 > durations.log
    python tools/slow_tests.py durations.log [--limit SECONDS] [--setup-limit SECONDS]

A test (all its parameters together) that takes longer than ``--limit`` is listed. A fixture that
takes longer than ``--setup-limit`` lists its whole file: without its first test, the next one would
wait for the same fixture. ``make quick`` leaves out what is listed.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections import Counter
from pathlib import Path

TARGET = Path(__file__).resolve().parents[1] / "tests" / "slow_tests.txt"
HEADER = """\
# Left out of `make quick` (marker `slow`): seconds, file or file::test.
# Made by tools/slow_tests.py: tests of more than {limit:g} s,
# and files with a fixture of more than {setup:g} s.
"""
_LINE = re.compile(r"\s*([0-9.]+)s (call|setup|teardown)\s+(tests/[^:]+\.py)::([^\[\s]+)")


def durations(log: str) -> tuple[Counter[str], Counter[str], dict[str, float]]:
    """Return seconds by file, seconds by file::test, and each file's longest setup."""
    files: Counter[str] = Counter()
    tests: Counter[str] = Counter()
    setups: dict[str, float] = {}
    for line in log.splitlines():
        if match := _LINE.match(line):
            seconds, phase, file, test = float(match[1]), match[2], match[3], match[4]
            files[file] += seconds
            tests[f"{file}::{test}"] += seconds
            if phase == "setup":
                setups[file] = max(setups.get(file, 0.0), seconds)
    return files, tests, setups


def slow_entries(
    log: str, limit_s: float, setup_limit_s: float
) -> tuple[list[tuple[float, str]], float]:
    """Return the entries, slowest first, and the seconds of everything that is not listed."""
    files, tests, setups = durations(log)
    entries = [(files[f], f) for f, longest in setups.items() if longest > setup_limit_s]
    whole = {file for _, file in entries}
    entries += [
        (seconds, test)
        for test, seconds in tests.items()
        if seconds > limit_s and test.partition("::")[0] not in whole
    ]
    left = sum(files.values()) - sum(seconds for seconds, _ in entries)
    return sorted(entries, key=lambda entry: (-entry[0], entry[1])), left


def main() -> int:
    """Read a log and write the list."""
    parser = argparse.ArgumentParser(description="Write tests/slow_tests.txt.")
    parser.add_argument("log", type=Path, help="output of pytest --durations=0")
    parser.add_argument("--limit", type=float, default=0.2, metavar="SECONDS")
    parser.add_argument("--setup-limit", type=float, default=1.0, metavar="SECONDS")
    options = parser.parse_args()
    entries, left_s = slow_entries(
        options.log.read_text(encoding="utf-8"), options.limit, options.setup_limit
    )
    if not entries:
        sys.stderr.write(f"{options.log} holds no durations. Run pytest with --durations=0.\n")
        return 1
    lines = [f"{seconds:.1f} {name}\n" for seconds, name in entries]
    header = HEADER.format(limit=options.limit, setup=options.setup_limit)
    TARGET.write_text(header + "".join(lines), encoding="utf-8")
    sys.stdout.write(f"{len(entries)} entries; all other tests took {left_s:.0f} s\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

# SPDX-License-Identifier: GPL-3.0-or-later
"""Run the hostile suite and write ``docs/hostile-input.md``.

    python -m tests.hostile.table

Run it from the root of the repository after a case was added or a message changed. Nothing is
written where a row does not end as its case says, or takes longer than the limit.
"""

from __future__ import annotations

import atexit
import datetime
import logging
import os
import platform
import re
import shutil
import sys
import tempfile
from pathlib import Path

# As in tests/conftest.py: the worker that the person has set up is not seen.
if "GAUSSIAN_WRAPPING_DATA" not in os.environ:
    _private = tempfile.mkdtemp(prefix="gwrap-data-")
    os.environ["GAUSSIAN_WRAPPING_DATA"] = _private
    atexit.register(shutil.rmtree, _private, ignore_errors=True)

from gaussian_wrapping_addon.core.machine import describe_machine
from tests.hostile.all_cases import GROUPS, cases
from tests.hostile.case import Case, Variant, Way
from tests.hostile.run_case import LIMIT_S, MEMORY_LIMIT_BYTES, Outcome, run_variant

TARGET = Path(__file__).resolve().parents[2] / "docs" / "hostile-input.md"
COMMAND = "python -m tests.hostile.table"
COLUMNS = ("input", "command", "exit code", "message", "seconds")
SHOWN = 260
"""Characters of a message that the table shows; the middle of longer ones is left out."""
_logger = logging.getLogger("tests.hostile.table")

_HEAD = """\
# Hostile input

What the commands do with files that are broken, made up, or in unusual places: a message that names
the file, the place in it and the next step, and an [exit code](command-line.md#exit-codes); or the
work goes on with a warning that counts what was left out.

`{command}` runs each row and writes this page; do not edit it. `make test` runs the same rows
(`tests/hostile/test_cases.py`) and asserts for each: exit code and message as here, no traceback,
no control characters, at most {memory} MB of memory, no file made, changed or removed but the
command's own, no file of somebody else read, no program started that the command does not need.

{rows} rows of {numbers} cases: all as stated, in {total:.0f} s together, the slowest in
{slowest:.1f} s (*{slowest_row}*); none may take longer than {limit:.0f} s. {machine}, {date}, as
{user}. Rows marked with ▸ ran in a process of their own, the others in one that has its modules
loaded. `…` stands for the folder of the row. *Loading* is the first stage of `wrap`. Under the
tables: tests of what no single command line shows.

Fuzzers change good files by chance as well, for as long as one likes (`CONTRIBUTING.md`).
"""


def shown(text: str, place: Path) -> str:
    """Return a message for the table: without the folder of its row, not too long, one cell."""
    text = text.replace(os.path.realpath(place / "case"), "…").replace(str(place / "case"), "…")
    text = re.sub(r"(\S)\1{39,}", lambda found: found[1] * 3 + "⋯", text)
    text = re.sub(r"\d{40,}", lambda found: found[0][:3] + "⋯", text)
    if len(text) > SHOWN:
        text = f"{text[: SHOWN // 2]} ⋯ {text[-SHOWN // 2 :]}"
    return text.strip()


def cell(text: str) -> str:
    """Return text as code of one Markdown cell; ``tests/hostile/test_table.py`` reads it back."""
    return f"`{text}`".replace("|", r"\|") if "`" not in text else text.replace("|", r"\|")


def command_of(variant: Variant) -> str:
    """Return the command line for the table."""
    if variant.way is Way.LOADING:
        return "loading"
    mark = "▸ " if variant.way in (Way.PROCESS, Way.TERMINAL) else ""
    words = " ".join(variant.words).encode("unicode_escape").decode()
    words = re.sub(r"(\S)\1{39,}", lambda found: found[1] * 3 + "⋯", words)
    return f"{mark}{cell(words) if words else '(nothing)'}"


def row_of(variant: Variant, ended: Outcome, place: Path) -> tuple[str, ...]:
    """Return the cells of a row."""
    message = shown(ended.line(variant.says), place)
    return (variant.name, command_of(variant), str(variant.code), cell(message),
            f"{ended.seconds:.1f}")  # fmt: skip


def wrong(variant: Variant, ended: Outcome) -> list[str]:
    """Return what is not as the case says."""
    found = [f"left {one}" for one in ended.left] + ended.outside
    if not variant.starts:
        found += [f"started {one}" for one in ended.started]
    if ended.code != variant.code:
        found.append(f"exit code {ended.code}")
    if not ended.line(variant.says):
        found.append(f"no such message: {ended.output}")
    if ended.errors:
        found.append(ended.errors)
    if ended.seconds > LIMIT_S:
        found.append(f"{ended.seconds:.1f} s")
    return found


def line_of_tests(case: Case) -> str:
    """Return the line that names the tests elsewhere."""
    names = ", ".join(f"`{node}`" for node in case.tests)
    return f"Tests: {names}.\n" if names else ""


def table() -> tuple[str, int]:
    """Run all rows; return the content of the file and the number of rows that are wrong."""
    parts, bad, seconds = [], 0, {}
    root = Path(tempfile.mkdtemp(prefix="hostile-"))
    try:
        for group in GROUPS:
            parts.append(f"\n## {group.title}\n")
            for case in group.cases:
                parts.append(f"\n### {case.number:02d} {case.title}\n\n")
                lines = []
                for variant in case.variants:
                    if variant.needs is not None and not variant.needs.met():
                        continue
                    place = root / f"{len(seconds)}"
                    ended = run_variant(variant, place)
                    for problem in wrong(variant, ended):
                        _logger.error("%02d %s: %s", case.number, variant.name, problem)
                        bad += 1
                    seconds[f"{case.number:02d} {variant.name}"] = ended.seconds
                    lines.append(f"| {' | '.join(row_of(variant, ended, place))} |\n")
                if lines:
                    parts.append(f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|\n")
                    parts += [*lines, "\n"] if case.tests else lines
                parts.append(line_of_tests(case))
    finally:
        shutil.rmtree(root, ignore_errors=True)
    slowest = max(seconds, key=lambda row: seconds[row])
    head = _HEAD.format(
        command=COMMAND, rows=len(seconds), numbers=len(cases()), total=sum(seconds.values()),
        slowest=seconds[slowest], slowest_row=slowest, limit=LIMIT_S,
        memory=MEMORY_LIMIT_BYTES // 2**20, machine=_machine(),
        date=datetime.date.today().isoformat(), user=_user(),
    )  # fmt: skip
    return head + "".join(parts), bad


def _machine() -> str:
    described = describe_machine(1)
    processor = described.get("processor") or platform.processor() or platform.machine()
    return f"{processor}, {platform.system()}, Python {platform.python_version()}"


def _user() -> str:
    return "root" if hasattr(os, "geteuid") and os.geteuid() == 0 else "a user"


def main() -> int:
    """Write the file; return 1 where a row is wrong."""
    _logger.addHandler(logging.StreamHandler(sys.stdout))
    _logger.setLevel(logging.INFO)
    content, bad = table()
    if bad:
        _logger.error("%d problems: nothing is written", bad)
        return 1
    TARGET.write_text(content, encoding="utf-8", newline="\n")
    _logger.info("%s written", TARGET)
    return 0


if __name__ == "__main__":
    sys.exit(main())

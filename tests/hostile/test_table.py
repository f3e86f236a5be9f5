# SPDX-License-Identifier: GPL-3.0-or-later
"""``docs/hostile-input.md`` shows the cases as they are: rows, exit codes, messages and tests."""

from __future__ import annotations

import re

from tests.hostile.all_cases import cases
from tests.hostile.case import Needs, row_id
from tests.hostile.run_case import LIMIT_S
from tests.hostile.table import COLUMNS, TARGET, command_of, line_of_tests

TEXT = TARGET.read_text(encoding="utf-8")
AGAIN = "run: python -m tests.hostile.table"


def rows_shown() -> dict[str, list[str]]:
    """Return the cells of the table's rows by the ids of the rows."""
    found, number = {}, ""
    for line in TEXT.splitlines():
        heading = re.match(r"### (\d\d) ", line)
        if heading:
            number = heading[1]
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if len(cells) == len(COLUMNS) and cells[0] not in (COLUMNS[0], "---"):
            found[f"{number} {cells[0]}"] = [cell.replace(r"\|", "|") for cell in cells]
    return found


def test_every_row_is_shown_with_its_command_and_exit_code() -> None:
    shown = rows_shown()
    wanted = {
        row_id(case, variant): [command_of(variant).replace(r"\|", "|"), str(variant.code)]
        for case in cases()
        for variant in case.variants
        if row_id(case, variant) in shown or variant.needs is not Needs.USER  # made by root
    }
    assert {row: cells[1:3] for row, cells in shown.items()} == wanted, AGAIN


def test_messages_are_those_of_the_cases() -> None:
    shown = rows_shown()
    other = [
        row_id(case, variant)
        for case in cases()
        for variant in case.variants
        if row_id(case, variant) in shown
        and "⋯" not in (message := shown[row_id(case, variant)][3].strip("`"))  # not shortened
        and not re.search(variant.says, message)
    ]
    assert other == [], AGAIN


def test_no_row_took_longer_than_the_limit() -> None:
    assert max(float(cells[4]) for cells in rows_shown().values()) <= LIMIT_S


def test_titles_and_tests_are_those_of_the_cases() -> None:
    for case in cases():
        assert f"\n### {case.number:02d} {case.title}\n" in TEXT, AGAIN
        assert line_of_tests(case) in TEXT, AGAIN

# SPDX-License-Identifier: GPL-3.0-or-later
"""The list of cases itself: no number or row twice, and the tests that it names exist."""

from __future__ import annotations

import ast
import functools
from collections import Counter
from pathlib import Path

from tests.hostile.all_cases import cases
from tests.hostile.case import row_id

ROOT = Path(__file__).resolve().parents[2]
NUMBERS = range(1, 75)


def test_every_number_is_there_once_and_has_a_row_or_a_test() -> None:
    found = cases()
    assert sorted(case.number for case in found) == list(NUMBERS)
    assert [case.number for case in found if not case.variants and not case.tests] == []


def test_no_row_is_there_twice() -> None:
    counted = Counter(row_id(case, variant) for case in cases() for variant in case.variants)
    assert [row for row, count in counted.items() if count > 1] == []


def test_messages_of_failures_are_checked_by_more_than_a_word() -> None:
    """An expression that any message satisfies would let every change pass."""
    weak = [
        row_id(case, variant)
        for case in cases()
        for variant in case.variants
        if variant.code and len(variant.says.replace(".*", "")) < 12
    ]
    assert weak == []


@functools.cache
def names_of(path: Path) -> frozenset[str]:
    """Return the names of the test functions of a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return frozenset(
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    )


def test_the_tests_elsewhere_exist() -> None:
    missing = []
    for case in cases():
        for node in case.tests:
            file, _, name = node.partition("::")
            path = ROOT / file
            found = names_of(path) if path.is_file() else frozenset()
            if not found if name == "*" else name not in found:
                missing.append(f"{case.number}: {node}")
    assert missing == []

# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of the page of parts and decisions."""

from __future__ import annotations

from pathlib import Path

from benchmarks.study import write_record
from benchmarks.zoo.parts import (
    DECISIONS,
    FULLEST,
    LEAST,
    PAGE,
    PARTS,
    WHOLE,
    planned,
    write_document,
)
from gaussian_wrapping_addon.core.settings import MODEL_SELECTION
from tests.benchmarks.invented_records import invented


def test_parts_are_planned_seed_by_seed() -> None:
    cases = planned("parts", ["thin-d3"])
    assert len(cases) == 3 * len(PARTS)
    assert [c.seed for c in cases[: len(PARTS)]] == [0] * len(PARTS)
    assert len({c.identity for c in cases}) == len(cases)


def test_fixed_combinations_leave_out_each_setting_that_auto_decides() -> None:
    expected = {f"on_but_{name}" for name in MODEL_SELECTION} | {WHOLE, FULLEST, LEAST}
    assert set(DECISIONS) == expected
    # A whole run serves both studies.
    assert planned("parts", ["thin-d3"], [0])[0] == planned("decisions", ["thin-d3"])[0]


def test_page_has_spreads_of_parts(tmp_path: Path) -> None:
    for case in planned("parts", ["thin-d3"]):
        level = 0.7 + 0.01 * case.seed - (0.2 if case.name != WHOLE else 0.0)
        write_record(invented(case, level), tmp_path)
    page = write_document(tmp_path, tmp_path)
    assert page == tmp_path / PAGE
    rows = [line for line in page.read_text().splitlines() if line.startswith("| thin-d3")]
    assert len(rows) == len(PARTS)
    assert "0.811 ± 0.010" in rows[0]  # seen F1 at 0.5 %: level + 0.1 + 0.001 of the second share
    assert "0.611 ± 0.010" in rows[1]


def test_page_has_what_auto_loses_and_saves(tmp_path: Path) -> None:
    best = f"on_but_{MODEL_SELECTION[0]}"
    for case in planned("decisions", ["thin-d3"]):
        level = {WHOLE: 0.7, best: 0.72}.get(case.name, 0.6)
        spent_s = {"train": 60.0 if case.name == WHOLE else 80.0}
        write_record(invented(case, level, processor_s=spent_s), tmp_path)
    page = write_document(tmp_path, tmp_path)
    assert page is not None
    text = page.read_text()
    # The whole run belongs to the parts, too, whose others are not there.
    assert f"{len(PARTS) - 1} of" in text
    (cells,) = (
        [cell.strip() for cell in line.split("|")]
        for line in text.splitlines()
        if best.replace("_", " ") in line
    )
    assert "0.020" in cells
    assert "0.25" in cells


def test_no_record_makes_no_page(tmp_path: Path) -> None:
    assert write_document(tmp_path, tmp_path) is None

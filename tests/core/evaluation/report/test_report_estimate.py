# SPDX-License-Identifier: GPL-3.0-or-later
"""The report compares what a training took with what was estimated."""

from __future__ import annotations

import pytest

from gaussian_wrapping_addon.core.evaluation.report.report import estimate_lines

EXPECTED = {"seconds_low": 60.0, "seconds_high": 120.0, "memory_bytes": 2**30}


@pytest.mark.parametrize(
    ("took", "words"), [(59.0, "below it"), (60.0, "within it"), (121.0, "above it")]
)
def test_the_comparison_says_where_the_time_lay(took: float, words: str) -> None:
    text = " ".join(estimate_lines({"estimate": EXPECTED, "seconds_training": took}))
    assert words in text


@pytest.mark.parametrize("training", [{}, {"seconds_training": 5.0}, {"estimate": EXPECTED}])
def test_without_both_figures_nothing_is_said(training: dict) -> None:
    assert estimate_lines(training) == []


def test_the_report_says_where_the_photos_were() -> None:
    photos = {"photos": 400, "all_bytes": 6 * 2**30, "budget_bytes": 3 * 2**30}
    told = {"estimate": {**EXPECTED, "photos": photos}, "seconds_training": 70.0}
    text = " ".join(estimate_lines(told))
    assert text.endswith("read on demand: 6.00 GiB decoded, 3.00 GiB of memory for them.")
    photos["all_bytes"] = 2**29
    assert " ".join(estimate_lines(told)).endswith("All photos fitted into memory (512 MiB).")
    photos["all_bytes"] = "much"
    assert " ".join(estimate_lines(told)).endswith("within it.")

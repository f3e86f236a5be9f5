# SPDX-License-Identifier: GPL-3.0-or-later
"""The report compares what a training took with what was estimated."""

from __future__ import annotations

import pytest

from gaussian_wrapping_addon.core.evaluation.report.estimate_section import estimate_lines

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

# SPDX-License-Identifier: GPL-3.0-or-later
"""Report section: estimated and actual time and memory of the training."""

from __future__ import annotations

from typing import Any

from .text import bytes_text, duration, measured, part


def estimate_lines(training: dict[str, Any]) -> list[str]:
    """Return the comparison as Markdown lines; none if nothing was estimated."""
    expected = part(training, "estimate")
    low, high = measured(expected.get("seconds_low")), measured(expected.get("seconds_high"))
    took = measured(training.get("seconds_training"))
    if low is None or high is None or took is None:
        return []
    where = "within it" if low <= took <= high else ("below it" if took < low else "above it")
    return [
        "",
        (
            f"Estimated before the start: {duration(low)} to {duration(high)}, "
            f"{bytes_text(expected.get('memory_bytes'))} of memory. It took {duration(took)}, "
            f"{where}.{_photos(part(expected, 'photos'))}"
        ),
    ]


def _photos(photos: dict[str, Any]) -> str:
    """Return where the photos were, as a sentence; nothing if the report is older."""
    whole, budget = measured(photos.get("all_bytes")), measured(photos.get("budget_bytes"))
    if whole is None or budget is None:
        return ""
    if whole <= budget:
        return f" All photos fitted into memory ({bytes_text(whole)})."
    return (
        f" Photos were read on demand: {bytes_text(whole)} decoded, {bytes_text(budget)} of memory "
        "for them."
    )

# SPDX-License-Identifier: GPL-3.0-or-later
"""Progress spans and cancellation."""

from __future__ import annotations

import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.progress import Progress, ProgressEvent


def test_spans_nest() -> None:
    events: list[ProgressEvent] = []
    inner = Progress("mesh", events.append).span(0.5, 1.0).span(0.0, 0.5)
    inner.update(0.0)
    inner.update(1.0, "done", points=3.0)
    inner.update(7.0)
    assert [e.fraction for e in events] == [0.5, 0.75, 0.75]
    assert events[1].figures == {"points": 3.0}
    assert events[1].seconds_left is not None


def test_cancelling_raises_after_the_report() -> None:
    events: list[ProgressEvent] = []
    progress = Progress("train", events.append, lambda: True)
    with pytest.raises(Cancelled):
        progress.update(0.1)
    assert len(events) == 1

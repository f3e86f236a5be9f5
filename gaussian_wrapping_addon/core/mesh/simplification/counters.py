# SPDX-License-Identifier: GPL-3.0-or-later
"""Counters and return codes of the collapse kernels."""

from __future__ import annotations

HEAP_SIZE, SEQUENCE, FACES_LEFT, VERTICES_LEFT, LAST_MARK = 0, 1, 2, 3, 4
"""Indices into ``counts``, (5,) int64: heap entries in use, number of the next entry, remaining
faces and used vertices, last mark given (see :mod:`.link_condition`)."""

COUNTERS = 5
"""Length of ``counts``."""

DONE, EMPTY, FULL, PAUSED = 0, 1, 2, 3
"""Why a collapse kernel returned: target reached, heap empty, heap full, budget spent."""

HEAP_ROOM = 128
"""Free heap entries required before a collapse: more than one collapse adds."""

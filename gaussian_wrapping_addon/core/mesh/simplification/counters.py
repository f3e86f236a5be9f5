# SPDX-License-Identifier: GPL-3.0-or-later
"""What the kernels count while they collapse edges, and why they return."""

from __future__ import annotations

HEAP_SIZE, SEQUENCE, FACES_LEFT, VERTICES_LEFT, LAST_MARK = 0, 1, 2, 3, 4
"""Places in ``counts``, (5,) int64: entries of the heap in use, number of the next entry, faces and
used vertices that are left, last mark given (see :mod:`.link_condition`)."""

COUNTERS = 5
"""Length of ``counts``."""

DONE, EMPTY, FULL, PAUSED = 0, 1, 2, 3
"""Why a collapse kernel returned: target reached, heap empty, heap full, budget spent."""

HEAP_ROOM = 128
"""Entries that must be free in the heap before a collapse: more than one collapse adds."""

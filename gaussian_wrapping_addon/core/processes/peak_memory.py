# SPDX-License-Identifier: GPL-3.0-or-later
"""The largest memory that this process and its helper processes have held."""

from __future__ import annotations

import sys
from pathlib import Path

_largest_helper_bytes = 0


def own_peak_bytes() -> int:
    """Return the largest resident size of this process so far; 0 where it is not known.

    Linux tells it of the program that runs now (``VmHWM``). ``ru_maxrss`` is not asked there: it
    begins at the size of the process that started this one. macOS has nothing else, so that its
    figure may be the parent's; Windows tells none.
    """
    if sys.platform == "win32":
        return 0
    if sys.platform.startswith("linux"):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
        return 0
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def peak_memory_bytes() -> dict[str, int]:
    """Return the largest resident size so far of this process and of its largest helper.

    Empty where the system does not tell.
    """
    own_bytes = own_peak_bytes()
    return {"worker": own_bytes, "largest_helper": largest_helper_bytes()} if own_bytes else {}


def record_helper_peak(peak_bytes: int) -> None:
    """Keep what a helper process says of itself, where it is the largest so far."""
    global _largest_helper_bytes
    _largest_helper_bytes = max(_largest_helper_bytes, peak_bytes)


def largest_helper_bytes() -> int:
    """Return the peak of the largest helper so far; 0 where none ran, or none ended in order."""
    return _largest_helper_bytes

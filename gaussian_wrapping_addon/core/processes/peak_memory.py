# SPDX-License-Identifier: GPL-3.0-or-later
"""Peak memory of this process and of its helper processes."""

from __future__ import annotations

import sys
from pathlib import Path

_largest_helper_bytes = 0


def own_peak_bytes() -> int:
    """Return the peak resident size of this process so far; 0 if unknown.

    On Linux it is ``VmHWM`` of the current program, not ``ru_maxrss``, which starts at the size of
    the parent process. macOS has only ``ru_maxrss``, so that the figure may be the parent's;
    on Windows it is unknown.
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
    """Return the peak resident size so far of this process and of its largest helper.

    Empty if unknown.
    """
    own_bytes = own_peak_bytes()
    return {"worker": own_bytes, "largest_helper": largest_helper_bytes()} if own_bytes else {}


def record_helper_peak(peak_bytes: int) -> None:
    """Record the peak reported by a helper process if it is the largest so far."""
    global _largest_helper_bytes
    _largest_helper_bytes = max(_largest_helper_bytes, peak_bytes)


def largest_helper_bytes() -> int:
    """Return the peak of the largest helper so far; 0 if none exited normally."""
    return _largest_helper_bytes

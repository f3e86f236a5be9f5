# SPDX-License-Identifier: GPL-3.0-or-later
"""Limits of a process's address space; Linux only, elsewhere there are none."""

from __future__ import annotations

import sys


def limit_address_space(most_bytes: int) -> None:
    """Allow this process and those that it starts no more than this; a lower limit stays."""
    if not sys.platform.startswith("linux"):
        return
    import resource

    limits = resource.getrlimit(resource.RLIMIT_AS)
    lowered = [
        most_bytes if limit == resource.RLIM_INFINITY else min(limit, most_bytes)
        for limit in limits
    ]
    resource.setrlimit(resource.RLIMIT_AS, (lowered[0], lowered[1]))


def is_limited_below(wanted_bytes: int) -> bool:
    """Tell whether this process was given a lower limit than one that it wants to set."""
    if not sys.platform.startswith("linux"):
        return False
    import resource

    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return soft != resource.RLIM_INFINITY and soft < wanted_bytes

# SPDX-License-Identifier: GPL-3.0-or-later
"""What the report says of the machine: processor, versions, peak memory."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

from ..peak_memory import largest_helper_bytes, own_peak_bytes

PACKAGES = (
    "numpy", "torch", "numba", "scipy", "pycolmap", "xatlas", "shull", "pillow", "trimesh",
    "libigl",
)  # fmt: skip


def describe_machine(threads: int) -> dict[str, Any]:
    """Return processor, cores, memory, Python and package versions as plain JSON values."""
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "missing"
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": threads,
        "memory_bytes": _memory_bytes(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": versions,
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def _memory_bytes() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 0


def peak_memory_bytes() -> dict[str, int]:
    """Return the largest resident size so far of this process and of its largest helper.

    Empty where the system does not tell; see :mod:`~.peak_memory`.
    """
    own_bytes = own_peak_bytes()
    return {"worker": own_bytes, "largest_helper": largest_helper_bytes()} if own_bytes else {}

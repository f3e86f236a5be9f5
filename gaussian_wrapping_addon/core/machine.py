# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties of this machine: memory (container limits included), processors, versions.

Standard library only. On Linux a container's memory limit is read from its control groups (cgroup
v1 and v2): the group of this process and its ancestors are read, the smallest limit applies.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PACKAGES = (
    "numpy", "torch", "numba", "scipy", "pycolmap", "xatlas", "shull", "pillow", "trimesh",
    "libigl", "av",
)  # fmt: skip

HELPER_MEMORY_SHARE = 0.9
"""Of the machine's memory: a helper process that wants more is ended before the system chooses."""
MIN_HELPER_MEMORY_BYTES = 8 << 30
"""A limit includes reserved address space; below this a helper's threads may not start."""

_PROC = Path("/proc")
_GROUPS = Path("/sys/fs/cgroup")


@dataclass(frozen=True)
class _GroupFiles:
    """File names of a control group, for one cgroup version."""

    limit: str
    used: str
    reclaimable: str
    """Key in ``memory.stat`` of file pages that the system drops before memory runs out."""


_V1 = _GroupFiles("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_V2 = _GroupFiles("memory.max", "memory.current", "inactive_file")


def processor_count() -> int:
    """Return the number of processors available to this process, at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return max(1, os.cpu_count() or 1)


def processor_name() -> str:
    """Return the processor's name, or ``"unknown"``."""
    try:
        for line in (_PROC / "cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"


def total_memory_bytes() -> int:
    """Return the total memory of this machine or its container; 0 if unknown."""
    installed = _installed_bytes()
    return min([installed, *(limit for limit, _ in _groups())]) if installed else 0


def helper_memory_limit_bytes() -> int | None:
    """Return the memory limit of helper processes on foreign input; ``None`` where unknown."""
    total = total_memory_bytes()
    return max(int(HELPER_MEMORY_SHARE * total), MIN_HELPER_MEMORY_BYTES) if total else None


def available_memory_bytes() -> int:
    """Return the memory available without swapping; 0 if unknown.

    In a container, at most what its limit leaves.
    """
    try:
        lines = (_PROC / "meminfo").read_text().splitlines()
    except OSError:
        return total_memory_bytes()
    for line in lines:
        if line.startswith("MemAvailable:"):
            try:
                free = int(line.split()[1]) * 1024
            except (ValueError, IndexError):
                break
            return min([free, *(max(0, limit - used) for limit, used in _groups())])
    return 0


def _installed_bytes() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 0


def _groups() -> Iterator[tuple[int, int]]:
    """Yield (limit, bytes in use that cannot be dropped) of each control group with a limit."""
    for folder, files in _group_folders():
        limit = _number(folder / files.limit)
        # Version 1 writes "no limit" as the largest number of pages.
        if limit is None or limit >= 1 << 60:
            continue
        used = _number(folder / files.used) or 0
        yield limit, max(0, used - _reclaimable(folder, files.reclaimable))


def _group_folders() -> Iterator[tuple[Path, _GroupFiles]]:
    """Yield the folder of this process's memory group and of its ancestors, of both versions.

    Inside a container the group may be named by its path outside, of which only the root, the
    container's own group, is visible.
    """
    try:
        lines = (_PROC / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if number == "0" and not controllers:
            top, files = _GROUPS, _V2
        elif "memory" in controllers.split(","):
            top, files = _GROUPS / "memory", _V1
        else:
            continue
        parts = [part for part in path.split("/") if part not in ("", "..")]
        for depth in range(len(parts), -1, -1):
            yield top.joinpath(*parts[:depth]), files


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):  # version 2 writes "max" where there is no limit
        return None


def _reclaimable(folder: Path, key: str) -> int:
    try:
        for line in (folder / "memory.stat").read_text().splitlines():
            name, _, value = line.partition(" ")
            if name == key:
                return int(value)
    except (OSError, ValueError):
        pass
    return 0


def describe_machine(threads: int) -> dict[str, Any]:
    """Return processor, cores, memory, Python and package versions as plain JSON values."""
    return {
        "processor": processor_name(), "cores": os.cpu_count(), "threads": threads,
        "memory_bytes": total_memory_bytes(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
    }  # fmt: skip


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"

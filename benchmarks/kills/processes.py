# SPDX-License-Identifier: GPL-3.0-or-later
"""Processes of a job, found in ``/proc`` by their command lines."""

from __future__ import annotations

import time
from pathlib import Path

from gaussian_wrapping_addon.core.jobs.client import WORKER_MODULE

POLL_S = 0.02


def processes_of(folder: Path) -> list[int]:
    """Return the processes whose command line names a folder or something in it."""
    name = str(folder).encode()
    return [pid for pid, line in _command_lines() if name in line]


def worker_of(folder: Path) -> int:
    """Return the process number of a job's worker; 0 where there is none."""
    names = (WORKER_MODULE.encode(), str(folder).encode())
    found = (
        pid for pid, line in _command_lines() if all(name in line.split(b"\0") for name in names)
    )
    return next(found, 0)


def wait_until_gone(folder: Path, longest_s: float) -> tuple[float, list[int]]:
    """Wait until no process names a folder; return the seconds, and which are left."""
    begun_s = time.monotonic()
    while left := processes_of(folder):
        if time.monotonic() - begun_s > longest_s:
            break
        time.sleep(POLL_S)
    return time.monotonic() - begun_s, left


def peak_address_space(pid: int) -> int:
    """Return the largest address space that a process has had, in bytes; 0 if it has ended."""
    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    sizes = [line.split()[1] for line in text.splitlines() if line.startswith("VmPeak:")]
    return int(sizes[0]) * 1024 if sizes else 0


def _command_lines() -> list[tuple[int, bytes]]:
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            line = (path / "cmdline").read_bytes()
        except OSError:  # it has ended meanwhile
            continue
        if line:  # a zombie has none
            found.append((int(path.name), line))
    return found

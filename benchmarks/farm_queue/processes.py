# SPDX-License-Identifier: GPL-3.0-or-later
"""Processes of a queue, found in ``/proc`` by a variable that all of them inherit."""

from __future__ import annotations

import os
import time
from pathlib import Path

MARK = "GW_QUEUE_BENCHMARK"
"""Environment variable that marks a queue and everything that it starts."""
POLL_S = 0.05


def marked_processes(mark: str) -> dict[int, list[str]]:
    """Return the command lines of living processes that have inherited a mark."""
    wanted = f"{MARK}={mark}".encode()
    found = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if wanted not in (path / "environ").read_bytes().split(b"\0"):
                continue
            words = (path / "cmdline").read_bytes().decode(errors="replace").split("\0")
        except OSError:  # it has ended meanwhile
            continue
        if any(words):  # a zombie has none
            found[int(path.name)] = words
    return found


def queue_process(mark: str, module: str) -> int:
    """Return the process that holds scheduler and client; 0 where there is none.

    Parameters
    ----------
    module : str
        Its module; the processes of single jobs have the same.
    """
    lines = marked_processes(mark).items()
    return next((pid for pid, line in lines if module in line and '"jobs"' in line[-2]), 0)


def parent_of(pid: int) -> int:
    """Return the parent of a process; 0 if it has ended."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return 0
    return int(text.rsplit(")", 1)[1].split()[1])


def wait_until_gone(mark: str, longest_s: float) -> tuple[float, dict[int, list[str]]]:
    """Wait until no marked process is left; return the seconds, and which are left."""
    begun_s = time.monotonic()
    while (left := marked_processes(mark)) and time.monotonic() - begun_s < longest_s:
        time.sleep(POLL_S)
    return time.monotonic() - begun_s, left


def marked_environment(mark: str, temporary: Path) -> dict[str, str]:
    """Return the environment of a marked queue whose temporary files lie in a folder."""
    return {**os.environ, MARK: mark, "TMPDIR": str(temporary)}

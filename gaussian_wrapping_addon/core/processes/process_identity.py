# SPDX-License-Identifier: GPL-3.0-or-later
"""Which process is meant: place, pid and start time; and the caller, with which a child ends.

A pid alone is used again. A parent alone says nothing to a child that starts when its caller is
dead already: it has another parent from the start. So each child is told who called it.
"""

from __future__ import annotations

import contextlib
import os
import platform
import sys
from functools import cache
from pathlib import Path

CALLER_OPTION = "gwrap_caller"
"""``-X`` option of children: pid and start time of the process that started them."""
MAX_PID = 2**31 - 1
FIRST_PID = 1
"""Of the process that starts all others: it is always alive, and none of ours."""


def process_start_ticks(pid: int) -> int:
    """Return the start time of a process in system ticks; 0 if unknown, as outside Linux."""
    fields = _linux_stat(pid)
    return int(fields[19]) if fields else 0


@cache
def host_and_pid_namespace() -> str:
    """Return a text that is equal only for processes that see each other's process ids."""
    parts = [platform.node()]
    for read in (
        lambda: Path("/proc/sys/kernel/random/boot_id").read_text().strip(),
        lambda: os.readlink("/proc/self/ns/pid"),
    ):
        with contextlib.suppress(OSError, AttributeError):  # outside Linux: the host name alone
            parts.append(read())
    return " ".join(parts)


def is_here(place: str) -> bool:
    """Return whether a record's process ids are ours; one without a place is taken for ours."""
    return place in ("", host_and_pid_namespace())


def process_alive(pid: int, started: int) -> bool:
    """Tell whether the process started at ``started`` still runs (a zombie does not)."""
    if not 0 < pid <= MAX_PID:
        return False
    if sys.platform.startswith("linux"):
        fields = _linux_stat(pid)
        return bool(fields) and fields[0] not in ("Z", "X") and started in (0, int(fields[19]))
    if sys.platform == "win32":
        return _alive_windows(pid)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def owner_alive(pid: int, started: int) -> bool:
    """Tell whether the process that a lock or a status names runs, and can have written it.

    On Linux every process of ours knows its start time: a record without one is of somebody else,
    and would hold a folder as long as any process has that pid. Elsewhere only the first process of
    the system is known not to be one of ours.
    """
    if sys.platform.startswith("linux"):
        return started > 0 and process_alive(pid, started)
    return pid > FIRST_PID and process_alive(pid, started)


def _linux_stat(pid: int) -> list[str]:
    """Return the fields of ``/proc/PID/stat`` from the state on; empty if there is no process."""
    if not sys.platform.startswith("linux"):
        return []
    try:
        text = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError:
        return []
    # The command name, in parentheses, may contain spaces.
    return text.rsplit(")", 1)[1].split()


def _alive_windows(pid: int) -> bool:
    import ctypes

    query_limited_information, still_active = 0x1000, 259
    kernel32 = ctypes.windll.kernel32  # type: ignore[attr-defined,unused-ignore]
    handle = kernel32.OpenProcess(query_limited_information, False, pid)
    if not handle:
        return False
    code = ctypes.c_ulong()
    kernel32.GetExitCodeProcess(handle, ctypes.byref(code))
    kernel32.CloseHandle(handle)
    return code.value == still_active


def caller_option() -> str:
    """Return the value of ``-X`` by which a child of this process knows its caller."""
    pid = os.getpid()
    return f"{CALLER_OPTION}={pid}:{process_start_ticks(pid)}"


class Caller:
    """The process that started this one, and its parent, as they are when this is made.

    They differ where Python is started through a launcher (``python.exe`` of a virtual environment
    on Windows): the launcher is the parent.
    """

    def __init__(self) -> None:
        self._parent = os.getppid()
        pid, _, started = str(sys._xoptions.get(CALLER_OPTION) or "").partition(":")
        told = pid.isdecimal() and started.isdecimal()
        self._pid, self._started = (int(pid), int(started)) if told else (0, 0)

    def ended(self) -> bool:
        """Return whether the caller or the parent has ended."""
        if os.getppid() != self._parent:
            return True
        return bool(self._pid) and not process_alive(self._pid, self._started)

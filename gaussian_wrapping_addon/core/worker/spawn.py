# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes: started, named, told to end, and ended with their parent."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import IO, Any

# -- Start child processes in groups of their own and end them with their descendants -------------

_THREADING = {
    # Idle OpenMP threads of torch wait instead of spinning: spinning threads occupy the cores that
    # our own threads compute on (measured: rendering took twice the processor time).
    "OMP_WAIT_POLICY": "PASSIVE",
    # numpy's linear algebra stays in the calling thread: it is asked for thousands of tiny systems,
    # and OpenBLAS lets its threads meet for each. On two busy cores 2000 systems of 12 x 12 took
    # 3 to 18 s instead of 3 ms, and a training stood still.
    "OPENBLAS_NUM_THREADS": "1",
}


def child_environment() -> dict[str, str]:
    """Return the environment for a child, without variables that configure Python.

    Variables that decide about threads of libraries are set unless the user has set them.
    """
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    return {**_THREADING, **kept}


def group_options() -> dict[str, Any]:
    """Return the options of ``Popen`` that make a child the leader of a new process group.

    A signal to the group ends the child with its descendants, and Ctrl-C in the parent's terminal
    does not reach it. On Windows no console window opens.
    """
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    return {"start_new_session": True}


def spawn(
    command: list[str], *, stdin: int | IO[Any] | None = subprocess.DEVNULL,
    stdout: int | IO[Any] | None = subprocess.PIPE, stderr: int | IO[Any] | None = subprocess.PIPE,
    environment: dict[str, str] | None = None, folder: Path | None = None,
) -> subprocess.Popen[bytes]:  # fmt: skip
    """Start a child in a new process group; it inherits no open files. Raises OSError.

    ``command``: without a shell; our own Python is started isolated (``-I``). By default a child
    has no input, and :func:`child_environment`.
    """
    return subprocess.Popen(
        command, stdin=stdin, stdout=stdout, stderr=stderr, cwd=folder,
        env=child_environment() if environment is None else environment, **group_options(),
    )  # fmt: skip


def run_to_end(command: list[str], deadline_s: float) -> tuple[int, str, str]:
    """Start a child and wait for it; return its exit code, and the text of stdout and stderr.

    Raises OSError: it does not start; subprocess.TimeoutExpired: the deadline passed, it was ended.
    """
    process = spawn(command)
    try:
        output, error_output = process.communicate(timeout=deadline_s)
    except BaseException:  # in a group of its own, nothing else would end it
        kill_group(process)
        raise
    return (
        process.returncode, output.decode(errors="replace"), error_output.decode(errors="replace"),
    )  # fmt: skip


def kill_group(process: subprocess.Popen[Any], grace_s: float = 2.0) -> None:
    """End a child that leads a process group: terminate, wait, then kill the whole group."""
    for number in (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM)):
        if process.poll() is not None:
            return
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if hasattr(os, "killpg"):
                os.killpg(process.pid, number)
            else:
                process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(grace_s)


# -- Keep the handlers of signals where a native library replaces them ----------------------------
#
# glog, in pycolmap, catches SIGTERM when it is imported: the process then dies with a native
# trace instead of the typed end that its own handler would bring.

_UNKNOWN = ctypes.c_void_p(-1).value
"""What C returns for a signal without handlers: SIG_ERR."""


@contextlib.contextmanager
def kept_signal_handlers() -> Iterator[None]:
    """Put the handlers of all signals back when the block ends; in any thread.

    ``signal.signal`` works in the main thread only, and Python does not notice what native code
    sets: the handlers are those of the system, as Python's C interface gives them.
    """
    get, put = ctypes.pythonapi.PyOS_getsig, ctypes.pythonapi.PyOS_setsig
    get.argtypes, get.restype = [ctypes.c_int], ctypes.c_void_p
    put.argtypes, put.restype = [ctypes.c_int, ctypes.c_void_p], ctypes.c_void_p
    numbers = [int(number) for number in signal.valid_signals()]
    before = {number: get(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler != _UNKNOWN and get(number) != handler:
                put(number, handler)


# -- Which process is meant: place, pid and start time; and the caller, with which a child ends
#
# A pid alone is used again. A parent alone says nothing to a child that starts when its caller is
# dead already: it has another parent from the start. So each child is told who called it.

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


# -- Let the system end this process with its parent, where the system can (Linux) ----------------
#
# Elsewhere, and as well, a child looks after its caller (:mod:`.spawn`): that needs
# the interpreter, which long native calls may hold.

_SET_PARENT_DEATH_SIGNAL = 1
"""``PR_SET_PDEATHSIG`` of prctl(2). The signal comes when the thread that started this process
ends: it must wait for it."""


def end_with_parent() -> None:
    """Have this process killed when the thread that started it ends."""
    if not sys.platform.startswith("linux"):
        return
    parent = os.getppid()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:  # it died before the call
        os._exit(128 + signal.SIGKILL)

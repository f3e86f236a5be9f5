# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper processes: a function in a process of its own, with limits of memory and time."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from .. import limits
from ..errors import (
    DatasetError,
    MemoryShortageError,
    MeshingError,
    ResourceError,
    UsageError,
    WorkerError,
    WrapError,
)
from ..progress import Progress, ProgressEvent
from .environment import NO_ROOM, PACKAGES_OPTION, interpreter_of
from .spawn import caller_option, kill_group, spawn

# -- Peak memory of this process and of its helper processes --------------------------------------

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


def _record_helper_peak(peak_bytes: int) -> None:
    global _largest_helper_bytes
    _largest_helper_bytes = max(_largest_helper_bytes, peak_bytes)


def largest_helper_bytes() -> int:
    """Return the peak of the largest helper so far; 0 if none exited normally."""
    return _largest_helper_bytes


# -- Limits of a process's address space; Linux only, elsewhere there are none --------------------


def limit_address_space(most_bytes: int) -> None:
    """Allow this process and those that it starts no more than this; a lower limit stays."""
    if not sys.platform.startswith("linux"):
        return
    import resource

    lowered = [
        most_bytes if limit == resource.RLIM_INFINITY else min(limit, most_bytes)
        for limit in resource.getrlimit(resource.RLIMIT_AS)
    ]
    resource.setrlimit(resource.RLIMIT_AS, (lowered[0], lowered[1]))


def is_limited_below(wanted_bytes: int) -> bool:
    """Tell whether this process was given a lower limit than one that it wants to set."""
    if not sys.platform.startswith("linux"):
        return False
    import resource

    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return soft != resource.RLIM_INFINITY and soft < wanted_bytes


# -- Run third-party native code (xatlas, pycolmap) in a process with deadline and memory limit
#
# A helper is a module with ``main(folder)``; it reads ``task.json`` and arrays in the folder,
# writes its results there, and reports on stdout, one JSON object per line: ``{"fraction": 0.5,
# "message": "..."}``. A typed failure is ``{"error": "...", "hint": "...", "kind":
# "DatasetError"}``. The last line of every helper that exits normally is ``{"peak_bytes": ...}``,
# its peak memory.

_logger = logging.getLogger(__name__)

FAILURES: dict[str, type[WrapError]] = {
    kind.__name__: kind
    for kind in (
        DatasetError, MemoryShortageError, MeshingError, ResourceError, UsageError, WorkerError,
    )
}  # fmt: skip
"""Typed failures of a helper that its caller raises again; others become a ``WorkerError``."""
_POLL_S = 0.1
_running: set[subprocess.Popen[bytes]] = set()
_OUTPUT_TAIL_LINES = 20
_OUT_OF_MEMORY = ("MemoryError", "bad_alloc", "out of memory", "Memory allocation still failed")
"""What Python, C++, LLVM and OpenBLAS say where an allocation fails."""
_MEMORY_HINT = (
    "Close other programs, or allow more memory (ulimit -v, a container's limit), then resume. If "
    "it happens again, use fewer photos, or a longer edge of the mesh."
)
_MAX_SAID = 300
"""Most characters of a crashed helper's last line in the message."""


def child_command(module: str, *arguments: str, python: str | None = None) -> list[str]:
    """Return the argument list that runs ``core.<module>`` in a child interpreter.

    ``python``: an interpreter, or the folder of a worker environment; None for the running
    interpreter with its packages.
    """
    entry = Path(__file__).with_name("worker_main.py")
    if python:
        interpreter, packages = interpreter_of(python)
    else:
        interpreter, packages = sys.executable, str(sys._xoptions.get(PACKAGES_OPTION) or "")
    options = ["-X", caller_option()]
    options += ["-X", f"{PACKAGES_OPTION}={packages}"] if packages else []
    return [interpreter, "-I", *options, "-u", str(entry), module, *arguments]


def emit(**values: Any) -> None:
    """Write one JSON line to stdout: the protocol of helpers and commands."""
    sys.stdout.write(json.dumps(values, allow_nan=False) + "\n")
    sys.stdout.flush()


def emit_progress(event: ProgressEvent) -> None:
    """Write how far a command is as such a line."""
    emit(fraction=event.fraction, message=event.message)


def json_object(line: str | bytes) -> dict[str, Any] | None:
    """Return what a line of that protocol holds; ``None`` where it is no JSON object."""
    try:
        values = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return values if isinstance(values, dict) else None


def last_line(text: str | bytes) -> str:
    """Return the last line of a child's output, or words where it has none."""
    text = text if isinstance(text, str) else text.decode(errors="replace")
    return (text.strip().splitlines() or ["no output"])[-1]


def ending_of(code: int) -> str:
    """Return how a child has ended, from its exit code: a verb and what follows."""
    return f"was stopped by signal {-code}" if code < 0 else f"ended with code {code}"


def kill_helpers() -> None:
    """Kill all running helpers; for a process about to exit without unwinding the stack."""
    for process in list(_running):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()


def run_helper(
    module: str, folder: Path, progress: Progress, *, deadline_s: float = limits.HELPER_DEADLINE_S,
    memory_bytes: int | None = None,
) -> None:  # fmt: skip
    """Run ``core.<module>`` on ``folder`` and wait for it, forwarding its progress.

    Raises Cancelled: the helper has been ended; DatasetError, MeshingError, UsageError,
    ResourceError: as it reported; ResourceError: the deadline passed; MemoryShortageError: the
    system gave it too little memory; WorkerError: it crashed, reached ``memory_bytes``, or a
    package is missing: the message names the signal and its last line, the log has the end of its
    output.
    """
    command = child_command("worker.helper_entry", module, str(folder), str(memory_bytes or 0))
    process = spawn(command)
    _running.add(process)
    lines: queue.Queue[tuple[str, str]] = queue.Queue()
    assert process.stdout is not None
    assert process.stderr is not None
    readers = [
        threading.Thread(target=_drain, args=(stream, name, lines), daemon=True)
        for name, stream in (("out", process.stdout), ("err", process.stderr))
    ]
    for reader in readers:
        reader.start()
    begun_s = time.monotonic()
    failure: dict[str, Any] = {}
    output_tail: list[str] = []
    try:
        while process.poll() is None or any(r.is_alive() for r in readers) or not lines.empty():
            progress.check()
            if time.monotonic() - begun_s > deadline_s:
                raise ResourceError(
                    f"{module} took longer than {deadline_s:.0f} s.", "Try a smaller input."
                )
            try:
                source, line = lines.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            values = json_object(line) if source == "out" else None
            if values is None:
                output_tail = [*output_tail, line.rstrip()][-_OUTPUT_TAIL_LINES:]
                _logger.debug("%s: %s", module, line.rstrip())
            elif "error" in values:
                failure = values
            elif "peak_bytes" in values:
                _record_helper_peak(int(values["peak_bytes"]))
            else:
                progress.update(float(values.get("fraction", 0.0)), str(values.get("message", "")))
    finally:
        kill_group(process)
        _running.discard(process)
        for reader in readers:
            reader.join(1.0)
    code = process.returncode
    if failure:
        kind = FAILURES.get(str(failure.get("kind")), WorkerError)
        raise kind(str(failure["error"]), str(failure.get("hint", "")))
    if code != 0:
        for line in output_tail:
            _logger.error("%s: %s", module, line)
        last = f": {output_tail[-1][:_MAX_SAID]}" if output_tail else "."
        if _is_short_of_memory(code, output_tail, memory_bytes):
            raise MemoryShortageError(f"{module} {ending_of(code)}{last}", _MEMORY_HINT)
        raise WorkerError(f"{module} {ending_of(code)}{last}", "See the log.")


def _is_short_of_memory(code: int, output: Sequence[str], memory_bytes: int | None) -> bool:
    """Tell whether a helper ended for want of memory that the system did not give."""
    # Linux kills what takes the last memory, containers what takes more than they may.
    if code != 0 and code == -getattr(signal, "SIGKILL", 0):
        return True
    if memory_bytes and sys.platform.startswith("linux"):
        if not is_limited_below(memory_bytes):
            return False  # it had what it may take at most
        if code < 0:
            return True  # native code crashes where an allocation fails, and says nothing
    return any(mark in line for line in output for mark in (*_OUT_OF_MEMORY, *NO_ROOM))


def _drain(stream: IO[bytes], name: str, lines: queue.Queue[tuple[str, str]]) -> None:
    for raw in stream:
        lines.put((name, raw.decode(errors="replace")))

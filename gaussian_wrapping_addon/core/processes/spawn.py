# SPDX-License-Identifier: GPL-3.0-or-later
"""Start child processes in groups of their own and end them with their descendants."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import IO, Any

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
    command: list[str],
    *,
    stdin: int | IO[Any] | None = subprocess.DEVNULL,
    stdout: int | IO[Any] | None = subprocess.PIPE,
    stderr: int | IO[Any] | None = subprocess.PIPE,
    environment: dict[str, str] | None = None,
    folder: Path | None = None,
) -> subprocess.Popen[bytes]:
    """Start a child in a new process group; it inherits no open files.

    Parameters
    ----------
    command : list of str
        Program and arguments, without a shell. Our own Python is started isolated (``-I``).
    stdin, stdout, stderr : int or file
        As in ``subprocess``; by default a child has no input.
    environment : dict, optional
        Default: :func:`child_environment`.
    folder : Path, optional
        Working directory; default: the parent's.

    Raises
    ------
    OSError
        The program does not start.
    """
    return subprocess.Popen(
        command,
        stdin=stdin,
        stdout=stdout,
        stderr=stderr,
        close_fds=True,
        cwd=folder,
        env=child_environment() if environment is None else environment,
        **group_options(),
    )


def run_to_end(command: list[str], deadline_s: float) -> tuple[int, str, str]:
    """Start a child and wait for it; return its exit code and output.

    Returns
    -------
    code : int
    output, error_output : str
        Text of stdout and stderr.

    Raises
    ------
    OSError
        The program does not start.
    subprocess.TimeoutExpired
        The deadline passed; the child has been ended.
    """
    process = spawn(command)
    try:
        output, error_output = process.communicate(timeout=deadline_s)
    except BaseException:  # in a group of its own, nothing else would end it
        kill_group(process)
        raise
    return (
        process.returncode,
        output.decode(errors="replace"),
        error_output.decode(errors="replace"),
    )


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

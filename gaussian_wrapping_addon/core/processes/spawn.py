# SPDX-License-Identifier: GPL-3.0-or-later
"""Start child processes, all in the same way, and end them with what they have started."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import IO, Any


def child_environment() -> dict[str, str]:
    """Return the environment for a child: nothing of ours that steers its Python.

    Idle OpenMP threads of torch wait instead of spinning: while they spin, they take the cores
    that our own threads compute on (measured: rendering took twice the processor time).
    """
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    return {"OMP_WAIT_POLICY": "PASSIVE", **kept}


def group_options() -> dict[str, Any]:
    """Return the options of ``Popen`` by which a child leads a group of its own.

    A signal to the group ends the child with all that it has started, and Ctrl-C in the parent's
    terminal does not reach it. On Windows no console window opens.
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
    """Start a child in a process group of its own; it inherits no files.

    Parameters
    ----------
    command : list of str
        Program and arguments; no shell sees them. A Python of ours is started isolated (``-I``).
    stdin, stdout, stderr : int or file
        As ``subprocess`` takes them; a child reads nothing unless told.
    environment : dict, optional
        :func:`child_environment` without it.
    folder : Path, optional
        Its working directory; the parent's without it.

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
    """Start a child and wait for it; return its exit code and what it wrote.

    Returns
    -------
    code : int
    output, words : str
        Of stdout and stderr.

    Raises
    ------
    OSError
        The program does not start.
    subprocess.TimeoutExpired
        It took longer; it has been ended.
    """
    process = spawn(command)
    try:
        output, error_output = process.communicate(timeout=deadline_s)
    except BaseException:  # a group of its own: nobody else would end it
        kill_group(process)
        raise
    return (
        process.returncode,
        output.decode(errors="replace"),
        error_output.decode(errors="replace"),
    )


def kill_group(process: subprocess.Popen[Any], grace_s: float = 2.0) -> None:
    """End a child that leads its own group: terminate, wait, then kill the whole group."""
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

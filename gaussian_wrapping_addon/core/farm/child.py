# SPDX-License-Identifier: GPL-3.0-or-later
"""What a Dask worker does: start a child process, watch it, and tell how it ended.

The module is sent to workers as it is and runs where the add-on need not be imported: standard
library only, nothing imported from the package.
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

SHARED_VARIABLE = "GW_SHARED"
"""Names the shared folder on this computer."""
ENTRY_VARIABLE = "GW_ENTRY"
"""Names ``worker_main.py`` of the add-on on this computer."""
PACKAGES_VARIABLE = "GW_PACKAGES"
"""Names the folder of the worker's packages, where they are not those of the interpreter."""
OTHER_CODE = 3
"""Exit code: this computer has another version of the program than the one that planned."""
LAST_LINES = 20
LAST_BYTES = 4000


def sendable() -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Return :func:`run_child` as a function that cannot be named, so that it is sent whole."""

    def run(request: dict[str, Any]) -> dict[str, Any]:
        return run_child(request)

    return run


def sendable_beside() -> Callable[[dict[str, Any]], Awaitable[dict[str, Any]]]:
    """Return the same for a Dask worker whose slots may be taken, to be run outside of them."""

    async def run_beside(request: dict[str, Any]) -> dict[str, Any]:
        return await asyncio.to_thread(run_child, request)

    return run_beside


def sendable_clock() -> Callable[[], float]:
    """Return a function, to be sent whole, that returns the seconds since the epoch there."""

    def clock() -> float:
        return time.time()

    return clock


def run_child(request: dict[str, Any]) -> dict[str, Any]:
    """Run a module of the add-on in a child process and wait for it.

    ``request``: ``module``; ``arguments``, JSON values; ``folder``, relative to the shared folder
    where ``is_shared``; ``command``, of the interpreter with its options up to the module, or
    ``None`` for that of this computer.
    Returns dict: ``code``, ``error``, ``hint``, ``host``, the last ``lines`` of its output, the
    ``answer`` that it gave (``None`` for none), and whether it is ``refused``: whatever this
    computer is asked, it cannot do.
    """
    host = os.uname().nodename if hasattr(os, "uname") else os.environ.get("COMPUTERNAME", "")
    try:
        command = _command(request, host)
    except OSError as error:
        return {
            "code": 2, "error": str(error), "hint": "", "host": host, "lines": [], "answer": None,
            "refused": True,
        }  # fmt: skip
    lines: list[str] = []
    told: dict[str, Any] = {}
    answer = None
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors,
            start_new_session=os.name != "nt", env=_environment(),
        )  # fmt: skip
        try:
            assert process.stdout is not None
            for raw in process.stdout:
                line = raw.decode(errors="replace").strip()
                lines = [*lines, line][-LAST_LINES:]
                values = _values(line)
                told = values if "error" in values else told
                answer = values.get("answer", answer)
            code = process.wait()
        finally:
            if process.poll() is None:
                process.kill()
        errors.seek(max(0, errors.seek(0, os.SEEK_END) - LAST_BYTES))
        said = errors.read().decode(errors="replace").strip().splitlines()
    problem = str(told.get("error", ""))
    if code and not problem:
        reason = f"was stopped by signal {-code}" if code < 0 else f"ended with code {code}"
        problem = f"Its process {reason}: {said[-1] if said else 'no output'}."
    return {
        "code": code, "error": problem, "hint": str(told.get("hint", "")), "host": host,
        "lines": [*lines, *said][-LAST_LINES:], "answer": answer, "refused": code == OTHER_CODE,
    }  # fmt: skip


def _command(request: dict[str, Any], host: str) -> list[str]:
    """Return the child's command line. Raises OSError: shared folder or add-on are not there."""
    folder = Path(request["folder"])
    if request["is_shared"]:
        shared = os.environ.get(SHARED_VARIABLE, "")
        if not shared:
            raise OSError(
                f"{SHARED_VARIABLE} is not set on {host}: it names the shared folder there."
            )
        folder = Path(shared) / folder
    if not folder.is_dir():
        raise OSError(f"{host} does not see {folder}.")
    arguments = json.dumps({**request["arguments"], "out": str(folder)})
    return [*(request["command"] or _own_command(host)), request["module"], arguments]


def _own_command(host: str) -> list[str]:
    entry = os.environ.get(ENTRY_VARIABLE, "")
    if not Path(entry).is_file():
        raise OSError(f"{ENTRY_VARIABLE} is not set on {host}: it names the add-on's entry there.")
    packages = os.environ.get(PACKAGES_VARIABLE, "")
    options = ["-X", f"gwrap_caller={os.getpid()}:{_start_ticks()}"]
    options += ["-X", f"gwrap_packages={packages}"] if packages else []
    return [sys.executable, "-I", *options, "-u", entry]


def _start_ticks() -> int:
    try:
        text = Path("/proc/self/stat").read_text(errors="replace")
    except OSError:
        return 0
    return int(text.rsplit(")", 1)[1].split()[19])


def _environment() -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    return {"OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1", **kept}


def _values(line: str) -> dict[str, Any]:
    try:
        values = json.loads(line)
    except (ValueError, RecursionError):
        return {}
    return values if isinstance(values, dict) else {}

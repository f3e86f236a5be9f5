# SPDX-License-Identifier: GPL-3.0-or-later
"""Run one command of a set-up: its words to a log, cancel, a watch on hangs, typed failures."""

from __future__ import annotations

import os
import queue
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

from ..errors import EXIT_RESOURCES, Cancelled, ResourceError, WorkerError
from ..processes.spawn import child_environment, kill_group

HANG_S = 900.0
"""Neither a word nor a byte for so long: it hangs."""
DEADLINE_S = 6 * 3600.0
_POLL_S = 0.1
_LOOK_S = 5.0
_LAST_LINES = 40

# Settings of pip that would send packages somewhere else than into the environment.
_STEERING = ("PIP_USER", "PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_REQUIREMENT", "PIP_LOG",
             "PIP_REQUIRE_VIRTUALENV", "PIP_NO_DEPS", "PIP_DRY_RUN")  # fmt: skip
_NOT_FOUND = re.compile(r"No matching distribution found for ([A-Za-z0-9._-]+)(\S*)")
_IMPOSSIBLE = re.compile(r"The user requested ([A-Za-z0-9._-]+)(.*)(?=[\s\S]*ResolutionImpossible)")
_UNREACHABLE = re.compile(
    r"NewConnectionError|NameResolutionError|Temporary failure in name resolution|ProxyError|"
    r"ConnectTimeout|Read timed out|SSLError|getaddrinfo failed|No route to host"
)


class PackageError(WorkerError):
    """A package that cannot be had; ``package`` names it."""

    exit_code = EXIT_RESOURCES

    def __init__(self, package: str, message: str, hint: str) -> None:
        super().__init__(message, hint)
        self.package = package


def setup_environment(temporary: Path) -> dict[str, str]:
    """Return the environment of a command; what it leaves behind lies in ``temporary``."""
    kept = {k: v for k, v in child_environment().items() if k.upper() not in _STEERING}
    folder = str(temporary)
    return {**kept, "TMPDIR": folder, "TEMP": folder, "TMP": folder, "PIP_USER": "0"}


def run_command(
    command: Sequence[str],
    temporary: Path,
    log: IO[str],
    said: Callable[[str], None],
    is_cancelled: Callable[[], bool],
    *,
    hang_s: float = HANG_S,
    deadline_s: float = DEADLINE_S,
) -> None:
    """Run a command to its end; nothing of it is left running, whatever happens.

    Parameters
    ----------
    temporary : Path
        Its folder for temporary files; a download that grows there is no hang.
    said : callable
        Gets each line of its output.

    Raises
    ------
    Cancelled, ResourceError, PackageError, WorkerError
        It was stopped, hangs or found no room; a package is missing; it failed.
    """
    options: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        options = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    try:
        process = subprocess.Popen(
            list(command),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=setup_environment(temporary),
            cwd=temporary,
            **options,
        )
    except OSError as error:
        raise WorkerError(
            f"{command[0]} does not start: {error.strerror}.", "Choose another Python."
        ) from None
    assert process.stdout is not None
    lines: queue.Queue[str] = queue.Queue()
    reader = threading.Thread(target=_drain, args=(process.stdout, lines), daemon=True)
    reader.start()
    last: list[str] = []
    begun_s = alive_s = looked_s = time.monotonic()
    size_bytes = 0
    try:
        while process.poll() is None or reader.is_alive() or not lines.empty():
            if is_cancelled():
                raise Cancelled("The set-up was cancelled.", "Press Set Up Worker to go on.")
            now_s = time.monotonic()
            if now_s - looked_s > min(_LOOK_S, hang_s / 3):
                looked_s, before = now_s, size_bytes
                size_bytes = _size_bytes(temporary)
                alive_s = now_s if size_bytes != before else alive_s
            if now_s - alive_s > hang_s or now_s - begun_s > deadline_s:
                raise ResourceError(
                    f"The set-up stood still for {now_s - alive_s:.0f} s and was ended.",
                    "Check the network, then press Set Up Worker to go on, or use a wheel folder.",
                )
            try:
                line = lines.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            alive_s = time.monotonic()
            last = [*last, line][-_LAST_LINES:]
            log.write(line + "\n")
            log.flush()
            said(line)
    finally:
        kill_group(process)
        reader.join(1.0)
    if process.returncode != 0:
        raise failure_of(process.returncode, last)


def failure_of(code: int, last: list[str]) -> WorkerError | ResourceError:
    """Return the typed error for what a command said before it failed."""
    words = "\n".join(last)
    if "No space left" in words or "not enough space" in words:
        return ResourceError("The disk is full.", "Free several GiB, then press Repair.")
    if _UNREACHABLE.search(words):
        return ResourceError(
            "The package index cannot be reached.",
            "Check the network and proxy, or give a folder with wheels.",
        )
    # With a constraint, pip says of a package without any wheel that it conflicts with itself.
    missing = _NOT_FOUND.search(words) or _IMPOSSIBLE.search(words)
    if missing:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        return PackageError(
            missing[1],
            f"No wheel of {missing[1]}{missing[2]} for Python {version} on {sys.platform} was"
            " found.",
            "With a wheel folder: put it there (the guide says how, under Without a network)."
            " Otherwise choose another Python 3.11 to 3.13.",
        )
    errors = [line for line in last if line.lower().startswith("error")] or last
    return WorkerError(
        f"A command of the set-up ended with code {code}: {errors[-1] if errors else 'no words'}.",
        "See log.txt in the worker's folder, then press Repair.",
    )


def _drain(stream: IO[bytes], lines: queue.Queue[str]) -> None:
    for raw in stream:
        lines.put(raw.decode("utf-8", "replace").rstrip())


def _size_bytes(folder: Path) -> int:
    """Return how much lies in a folder, whose files come and go meanwhile."""
    total_bytes = 0
    for place, _folders, names in os.walk(folder):
        for name in names:
            try:
                total_bytes += os.lstat(os.path.join(place, name)).st_size
            except OSError:
                continue
    return total_bytes

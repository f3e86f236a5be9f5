# SPDX-License-Identifier: GPL-3.0-or-later
"""Make and remove the worker's environment, in a thread; its commands are processes of their own.

A set-up builds in a folder that is not in use and takes it into use in the end: whatever stops it
leaves the environment that was there before, or none.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import logging
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

from ..errors import (
    EXIT_DONE,
    Cancelled,
    ResourceError,
    UsageError,
    WorkerError,
    WrapError,
    cannot_be_written,
)
from ..files import write_json
from ..helper_process import child_command, child_environment
from ..jobs.job_folder import JobFolder, JobStatus
from ..worker_environment import (
    FOLDERS,
    MARKER,
    PACKAGES,
    VENV,
    WorkerEnvironment,
    forget,
    remember,
)
from ..worker_requirements import read_requirements
from .commands import CUDA, SetupRequest, all_commands, as_line, check_folders
from .pythons import probe

_logger = logging.getLogger(__name__)

NEEDED_GIB = 3
"""Download and installation with torch for the processor (1.5 GB stay)."""
NEEDED_CUDA_GIB = 12
_TEMPORARY = "tmp"
_SEE_LOG = "See log.txt in the worker's folder, then press Set Up Worker."

# Settings of pip that would send packages somewhere else than into the environment.
_STEERING = ("PIP_USER", "PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_REQUIREMENT", "PIP_LOG",
             "PIP_REQUIRE_VIRTUALENV", "PIP_NO_DEPS", "PIP_DRY_RUN")  # fmt: skip
# What pip says, what it means, and the next step; the first that matches is told.
_FAILURES = (
    (r"No space left|not enough space|quota exceeded", "The disk is full.",
     "Free several GiB, then press Set Up Worker."),
    (r"NewConnectionError|[Nn]ame ?[Rr]esolution|ProxyError|ConnectTimeout|Read timed out|SSLError|"
     r"getaddrinfo failed|No route to host|Max retries exceeded",
     "The package index cannot be reached.",
     "Check the network and proxy, or give a folder with wheels."),
    (r"No matching distribution found for (\S+)", "No wheel of {} for this Python was found.",
     "With a wheel folder: put it there (the guide says how, under Without a network)."
     " Otherwise choose another Python 3.11 to 3.13."),
)  # fmt: skip


class SetupTask(threading.Thread):
    """A set-up, or a removal, beside its caller; ``status`` tells how far it is."""

    def __init__(self, request: SetupRequest, *, removes: bool = False) -> None:
        super().__init__(daemon=True)
        self.request = request
        self.removes = removes
        self.status = JobStatus("RUNNING", "remove" if removes else "environment")
        self._stop_asked = threading.Event()

    def run(self) -> None:
        """Work until the end, which ``status`` tells as well."""
        try:
            if self.removes:
                remove(self.request.environment)
            else:
                set_up(self.request, self._say, self._stop_asked)
            self.status = JobStatus("DONE", self.status.stage, 1.0, exit_code=EXIT_DONE)
        except WrapError as error:
            state = "CANCELLED" if isinstance(error, Cancelled) else "FAILED"
            self._end(state, error)
        except OSError as error:
            self._end("FAILED", cannot_be_written(error.filename or self.request.root, error))
        except Exception as error:  # without an end, its user would wait for ever
            _logger.exception("set-up")
            self._end("FAILED", WorkerError(f"{type(error).__name__}: {error}.", _SEE_LOG))

    def _say(self, stage: str, fraction: float, message: str) -> None:
        self.status = JobStatus("RUNNING", stage, fraction, message)

    def _end(self, state: str, told: WrapError) -> None:
        self.status = JobStatus(state, error=told.message, hint=told.hint, exit_code=told.exit_code)

    def cancel(self) -> None:
        """Ask it to stop; it deletes what it has begun."""
        self._stop_asked.set()

    @property
    def is_cancelling(self) -> bool:
        """Whether it was asked to stop."""
        return self._stop_asked.is_set()


def set_up(
    request: SetupRequest, say: Callable[[str, float, str], None], stop: threading.Event
) -> None:
    """Make the environment; one that is there is replaced in the end.

    Parameters
    ----------
    say : callable
        Gets stage, fraction and message.

    Raises
    ------
    WrapError
        The Python, the folder or a package cannot be used, there is no room, or the user stopped.
    OSError
        The folder cannot be written.
    """
    environment = request.environment
    names = [r.name for r in read_requirements(Path(request.requirements))]
    python = probe(request.python)
    commands = all_commands(request, python)
    folder = environment.next_folder()
    marker = {
        "made_by": "gaussian_wrapping_addon",
        "kind": VENV if python.has_venv else PACKAGES,
        "python": python.path,
        "version": python.version_text,
        "torch": request.torch,
        "folder": folder.name,
    }
    check_folders(request)
    environment.root.mkdir(parents=True, exist_ok=True)
    if "torch" in names:
        _check_disk(environment.root, NEEDED_CUDA_GIB if request.torch == CUDA else NEEDED_GIB)
    if not environment.is_ours():
        write_json(environment.marker_path, marker)
    lock = JobFolder(environment.root)
    lock.lock()
    try:
        _delete_unused(environment)
        temporary = environment.root / _TEMPORARY
        temporary.mkdir()
        with (environment.root / "log.txt").open("a", encoding="utf-8") as log:
            log.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} {platform.platform()}\n")
            tell = _teller(2 * len(names), say)
            for command in commands:
                log.write(f"$ {as_line(command)}\n")
                tell(as_line(command))
                leashed = child_command("setup.install", *command, python=python.path)
                run_command(leashed, temporary, log, tell, stop)
        sites = [*folder.glob("lib/python3*/site-packages"), *folder.glob("Lib/site-packages")]
        found = importlib.metadata.distributions(path=[str(p) for p in sites or [folder]])
        versions = {d.metadata["Name"]: d.version for d in found}
        write_json(environment.marker_path, marker)
        write_json(environment.ready_path, versions)
        remember(environment.root)
    finally:
        with contextlib.suppress(OSError):  # the next set-up deletes what is left
            _delete_unused(environment)
        lock.unlock()
        if stop.is_set() and not environment.is_ready():
            remove(environment)


def _check_disk(root: Path, needed_gib: int) -> None:
    free_gib = shutil.disk_usage(root).free / 2**30
    if free_gib < needed_gib:
        raise ResourceError(
            f"{free_gib:.1f} GiB are free, {needed_gib} GiB are needed.",
            "Free some, or choose another folder.",
        )


def _teller(expected: int, say: Callable[[str, float, str], None]) -> Callable[[str], None]:
    """Return what turns pip's lines into progress, by the number of packages it has named."""
    named = 0

    def tell(line: str) -> None:
        nonlocal named
        named += line.startswith(("Collecting ", "Processing "))
        stage = "install" if named else "environment"
        say(stage, min(named / expected, 0.9), line.strip()[:160])

    return tell


def run_command(
    command: Sequence[str],
    temporary: Path,
    log: IO[str],
    said: Callable[[str], None],
    stop: threading.Event,
) -> None:
    """Run a command of :func:`main` to its end, which it finds at once when ``stop`` is set.

    Parameters
    ----------
    temporary : Path
        Its working folder, also for its temporary files.
    said : callable
        Gets each line of its output.

    Raises
    ------
    Cancelled, ResourceError, WorkerError
        It was stopped; the disk, the network or a package is missing; it failed.
    """
    process = _start(command, temporary)
    assert process.stdin is not None
    assert process.stdout is not None
    release = process.stdin.close

    def watch() -> None:
        while process.poll() is None and not stop.wait(0.1):
            pass
        release()

    threading.Thread(target=watch, daemon=True).start()
    last: deque[str] = deque(maxlen=40)
    try:
        for raw in process.stdout:
            last.append(raw.decode("utf-8", "replace").rstrip())
            log.write(last[-1] + "\n")
            log.flush()
            said(last[-1])
    finally:
        release()
        process.wait()
        process.stdout.close()
    if stop.is_set():
        raise Cancelled("The set-up was cancelled.", "Press Set Up Worker to start again.")
    if process.returncode != 0:
        raise failure_of(process.returncode, list(last))


def _start(command: Sequence[str], temporary: Path) -> subprocess.Popen[bytes]:
    kept = {k: v for k, v in child_environment().items() if k.upper() not in _STEERING}
    places = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(temporary))
    options: dict[str, Any] = {"start_new_session": True}
    if sys.platform == "win32":
        options = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    try:
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            cwd=temporary, env={**kept, **places, "PIP_USER": "0"}, **options,
        )  # fmt: skip
    except OSError as error:
        raise WorkerError(
            f"{command[0]} does not start: {error.strerror}.", "Choose another Python."
        ) from None


def main(arguments: list[str]) -> int:
    """Run a command that is ended when standard input is closed, as by the end of who asked."""
    process = subprocess.Popen(arguments, stdin=subprocess.DEVNULL)

    def watch() -> None:
        os.read(0, 1)
        process.kill()
        if hasattr(os, "killpg"):
            os.killpg(0, signal.SIGKILL)  # this process too, with all that it has started

    threading.Thread(target=watch, daemon=True).start()
    return process.wait()


def failure_of(code: int, last: list[str]) -> WrapError:
    """Return the typed error for what a command said before it failed."""
    for pattern, message, hint in _FAILURES:
        match = re.search(pattern, "\n".join(last))
        if match:
            return ResourceError(message.format(*match.groups()), hint)
    errors = [line for line in last if line.lower().startswith("error")] or last or ["no words"]
    return WorkerError(f"A command of the set-up ended with code {code}: {errors[-1]}.", _SEE_LOG)


def _delete_unused(environment: WorkerEnvironment) -> None:
    """Delete what belongs to an environment but the folder in use."""
    in_use = environment.folder if environment.is_ready() else None
    if in_use is None:
        environment.ready_path.unlink(missing_ok=True)
    for folder in (environment.root / name for name in (*FOLDERS, _TEMPORARY)):
        if folder.is_symlink():
            folder.unlink()
        elif folder.exists() and folder != in_use:
            shutil.rmtree(folder)


def remove(environment: WorkerEnvironment) -> None:
    """Delete an environment that we made, and nothing else.

    Raises
    ------
    UsageError
        The folder does not carry our marker, or a set-up is at work in it.
    OSError
        Something of it cannot be deleted.
    """
    root = environment.root
    if root.is_symlink() or not environment.is_ours():
        raise UsageError(
            f"{root} was not made by this add-on: it holds no {MARKER}.",
            "Delete it by hand if you are sure.",
        )
    if JobFolder(root).locked():
        raise UsageError(f"A set-up is running in {root}.", "Cancel it or wait for it.")
    environment.ready_path.unlink(missing_ok=True)
    forget(root)
    _delete_unused(environment)
    for name in ("status.json", "log.txt", "output.txt", "cancel", "lock.json", MARKER):
        (root / name).unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # something else lies there: it stays
        root.rmdir()

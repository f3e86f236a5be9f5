# SPDX-License-Identifier: GPL-3.0-or-later
"""Create and remove the worker environment in a thread that runs its commands as processes.

A set-up builds in a folder that is not in use and switches to it at the end: if it is stopped, the
previous environment, or none, remains.
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
import threading
import time
from collections import deque
from pathlib import Path
from typing import IO

from ..errors import (
    EXIT_DONE,
    Cancelled,
    ResourceError,
    UsageError,
    WorkerError,
    WrapError,
    unwritable_error,
)
from ..files import write_json
from ..jobs.store.job_folder import JobFolder, JobStatus
from ..processes.helper_process import child_command
from ..processes.spawn import child_environment, spawn
from ..processes.worker_environment import (
    FOLDERS,
    MARKER,
    PACKAGES,
    VENV,
    WorkerEnvironment,
    register_environment,
    unregister_environment,
)
from ..processes.worker_extras import installed_extras
from ..processes.worker_requirements import read_requirements
from .commands import (
    CUDA,
    TEMPORARY,
    Command,
    SetupRequest,
    all_commands,
    as_line,
    check_addition,
    check_folders,
)
from .pythons import probe

_logger = logging.getLogger(__name__)

NEEDED_GIB = 3
"""Disk space for download and installation with torch for the CPU (1.5 GB remain used)."""
NEEDED_CUDA_GIB = 12
_SEE_LOG = "See log.txt in the worker's folder, then press Set Up Worker."

# Settings of pip that would install packages outside of the environment.
_IGNORED_VARIABLES = (
    "PIP_USER", "PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_REQUIREMENT", "PIP_LOG",
    "PIP_REQUIRE_VIRTUALENV", "PIP_NO_DEPS", "PIP_DRY_RUN",
)  # fmt: skip
# Pattern in pip's output, error message and next step; the first match is reported.
_FAILURES = (
    (r"Got\s+[0-9a-f]{64}", "A downloaded package is not the published one.",
     "Do not use it. Look at network, proxy and mirror; log.txt in the worker's folder names it."),
    (r"No space left|not enough space|quota exceeded", "The disk is full.",
     "Free several GiB, then press Set Up Worker."),
    (r"NewConnection|[Nn]ame ?[Rr]esolution|Proxy|Timeout|timed out|SSLError|Max retries|No route",
     "The package index cannot be reached.",
     "Check the network and proxy, or give a folder with wheels."),
    (r"No matching distribution found for (\S+)", "No wheel of {} for this Python was found.",
     "Put it into the wheel folder, if you use one; or choose another Python 3.11 to 3.13."),
)  # fmt: skip


class SetupTask(threading.Thread):
    """Thread that sets up or removes an environment; ``status`` holds its progress."""

    def __init__(self, request: SetupRequest, *, removes: bool = False) -> None:
        super().__init__(daemon=True)
        self.request = request
        self.removes = removes
        self.is_cancelling = False
        self.status = JobStatus("RUNNING", "remove" if removes else "environment")
        self._process: subprocess.Popen[bytes] | None = None
        self._package_count = 0
        """Number of packages that pip has named so far."""

    def run(self) -> None:
        """Run to the end; ``status`` then holds the outcome."""
        try:
            if self.removes:
                remove(self.request.environment)
            elif self.request.adds:
                self._add()
            else:
                self._set_up()
            self.status = JobStatus("DONE", self.status.stage, 1.0, exit_code=EXIT_DONE)
        except WrapError as error:
            self._end("CANCELLED" if isinstance(error, Cancelled) else "FAILED", error)
        except OSError as error:
            self._end("FAILED", unwritable_error(error.filename or self.request.root, error))
        except Exception as error:  # without a final status, the user would wait forever
            _logger.exception("set-up")
            self._end("FAILED", WorkerError(f"{type(error).__name__}: {error}.", _SEE_LOG))

    def _end(self, state: str, failure: WrapError) -> None:
        self.status = JobStatus(
            state, error=failure.message, hint=failure.hint, exit_code=failure.exit_code
        )

    def cancel(self) -> None:
        """Request a stop; unfinished files are deleted."""
        self.is_cancelling = True
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()

    def _set_up(self) -> None:
        """Create the environment; an existing one is replaced at the end."""
        request, environment = self.request, self.request.environment
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
            "extras": list(request.extras),
        }
        check_folders(request)
        environment.root.mkdir(parents=True, exist_ok=True)
        if "torch" in names:
            _check_disk(environment.root, NEEDED_CUDA_GIB if request.torch == CUDA else NEEDED_GIB)
        if not environment.is_ours():
            write_json(environment.marker_path, marker)
        lock = JobFolder(environment.root)
        lock.lock()
        replaced = environment.folder if environment.is_ready() else None
        try:
            _delete_unused(environment)
            (environment.root / TEMPORARY).mkdir()
            self._run_all(commands, python.path, 2 * len(names))
            write_json(environment.marker_path, marker)
            write_json(environment.ready_path, installed_versions(folder))
            register_environment(environment.root)
        finally:
            with contextlib.suppress(OSError):  # the next set-up deletes the rest
                # Jobs that run may still load packages from the replaced environment.
                _delete_unused(environment, keep=replaced)
            lock.unlock()
            if self.is_cancelling and not environment.is_ready():
                with contextlib.suppress(OSError):
                    remove(environment)

    def _add(self) -> None:
        """Add the extras to the environment in use; stopped before the end, it stays as it is."""
        request, environment = self.request, self.request.environment
        check_folders(request)
        check_addition(request)
        python = probe(str(environment.marker().get("python", "")))
        commands = all_commands(request, python)
        lock = JobFolder(environment.root)
        lock.lock()
        temporary = environment.root / TEMPORARY
        try:
            shutil.rmtree(temporary, ignore_errors=True)
            temporary.mkdir()
            self._run_all(commands, python.path, 1 + len(commands))
            place_packages(request.target, site_folder(environment.folder))
            versions = installed_versions(environment.folder)
            extras = list(installed_extras(versions))
            write_json(environment.marker_path, {**environment.marker(), "extras": extras})
            write_json(environment.ready_path, versions)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
            lock.unlock()

    def _run_all(self, commands: list[Command], python: str, expected: int) -> None:
        """Run commands one after the other; their output goes to ``log.txt``."""
        with (self.request.environment.root / "log.txt").open("a", encoding="utf-8") as log:
            log.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} {platform.platform()}\n")
            for command in commands:
                self._run_command(command, python, log, expected)

    def _run_command(self, command: Command, python: str, log: IO[str], expected: int) -> None:
        """Run a command to its end; the progress is the share of ``expected`` packages named."""
        log.write(f"$ {as_line(command)}\n")
        last: deque[str] = deque(maxlen=40)
        self._process = process = start_process(
            child_command("setup.install", *command, python=python),
            self.request.environment.root / TEMPORARY,
        )
        assert process.stdin is not None
        assert process.stdout is not None
        if self.is_cancelling:  # cancelled before the process started
            process.stdin.close()
        try:
            for raw in process.stdout:
                line = raw.decode("utf-8", "replace").rstrip()
                log.write(line + "\n")
                log.flush()
                last.append(line)
                self._package_count += line.startswith(("Collecting ", "Processing "))
                stage = "install" if self._package_count else "environment"
                self.status = JobStatus(
                    "RUNNING", stage, min(self._package_count / expected, 0.9), line.strip()[:160]
                )
        finally:
            process.stdin.close()
            process.wait()
            process.stdout.close()
        if self.is_cancelling:
            raise Cancelled("The set-up was cancelled.", "Press Set Up Worker to start again.")
        if process.returncode != 0:
            raise error_from_output(process.returncode, list(last))


def site_folder(folder: Path) -> Path:
    """Return where packages are in an environment's folder: a venv, or packages alone."""
    sites = [*folder.glob("lib/python3*/site-packages"), *folder.glob("Lib/site-packages")]
    return sites[0] if sites else folder


def installed_versions(folder: Path) -> dict[str, str]:
    """Return the packages in an environment's folder: the version of each name."""
    found = importlib.metadata.distributions(path=[str(site_folder(folder))])
    return {d.metadata["Name"]: d.version for d in found}


def place_packages(added: Path, site: Path) -> None:
    """Move installed packages into an environment on the same disk, in place of other versions."""
    for info in added.glob("*.dist-info"):
        for other in site.glob(f"{info.name.split('-')[0]}-*.dist-info"):
            shutil.rmtree(other)
    # The metadata last: what they list is there by then.
    for entry in sorted(added.iterdir(), key=lambda p: p.name.endswith(".dist-info")):
        if entry.name in ("bin", "Scripts"):  # no program of an extra is called
            continue
        target = site / entry.name
        if target.is_dir():
            shutil.rmtree(target)
        os.replace(entry, target)


def _check_disk(root: Path, needed_gib: int) -> None:
    free_gib = shutil.disk_usage(root).free / 2**30
    if free_gib < needed_gib:
        raise ResourceError(
            f"{free_gib:.1f} GiB are free, {needed_gib} GiB are needed.",
            "Free some, or choose another folder.",
        )


def start_process(command: list[str], temporary: Path) -> subprocess.Popen[bytes]:
    """Start :func:`main` in a process group of its own, with temporary files in ``temporary``.

    Raises
    ------
    WorkerError
        The process does not start.
    """
    inherited = {
        k: v for k, v in child_environment().items() if k.upper() not in _IGNORED_VARIABLES
    }
    temporary_variables = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(temporary))
    try:
        return spawn(
            command,
            stdin=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            environment={**inherited, **temporary_variables, "PIP_USER": "0"},
            folder=temporary,
        )
    except OSError as error:
        raise WorkerError(
            f"{command[0]} does not start: {error.strerror}.", "Choose another Python."
        ) from None


def main(arguments: list[str]) -> int:
    """Run a command and kill it when standard input is closed, as when the parent ends."""
    process = subprocess.Popen(arguments, stdin=subprocess.DEVNULL)

    def watch() -> None:
        os.read(0, 1)
        process.kill()
        if hasattr(os, "killpg"):
            os.killpg(0, signal.SIGKILL)  # the whole group, this process included

    threading.Thread(target=watch, daemon=True).start()
    return process.wait()


def error_from_output(code: int, last: list[str]) -> WrapError:
    """Return the typed error for the last output lines of a failed command."""
    for pattern, message, hint in _FAILURES:
        match = re.search(pattern, "\n".join(last))
        if match:
            return ResourceError(message.format(*match.groups()), hint)
    errors = [line for line in last if line.lower().startswith("error")] or last or ["no output"]
    return WorkerError(f"A command of the set-up ended with code {code}: {errors[-1]}.", _SEE_LOG)


def _delete_unused(environment: WorkerEnvironment, keep: Path | None = None) -> None:
    """Delete the files of an environment except the folder in use and ``keep``."""
    in_use = environment.folder if environment.is_ready() else None
    if in_use is None:
        environment.ready_path.unlink(missing_ok=True)
    for folder in (environment.root / name for name in (*FOLDERS, TEMPORARY)):
        if folder.is_symlink():
            folder.unlink()
        elif folder.exists() and folder not in (in_use, keep):
            shutil.rmtree(folder)


def remove(environment: WorkerEnvironment) -> None:
    """Delete an environment made by the add-on, and nothing else.

    Raises
    ------
    UsageError
        The folder has no marker of ours, or a set-up is running in it.
    OSError
        A file cannot be deleted.
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
    unregister_environment(root)
    _delete_unused(environment)
    for name in ("status.json", "log.txt", "output.txt", "cancel", "lock.json", MARKER):
        (root / name).unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # other files in the folder stay
        root.rmdir()

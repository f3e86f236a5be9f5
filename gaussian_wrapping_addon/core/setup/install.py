# SPDX-License-Identifier: GPL-3.0-or-later
"""Make, repair and remove the worker's environment; runs in a process of its own.

Everything lands in one folder, which is marked as ours first and declared ready last. Whatever
stops it between leaves a folder that no job uses and that the next set-up goes on with.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import platform
import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO

from ..errors import (
    EXIT_DONE,
    EXIT_OTHER,
    Cancelled,
    ResourceError,
    UsageError,
    WorkerError,
    WrapError,
)
from ..files import write_json
from ..jobs.doctor import diagnose_worker
from ..jobs.job_folder import JobFolder, JobStatus, process_alive, process_start_ticks
from ..worker_environment import (
    MARKER,
    PACKAGES,
    VENV,
    WorkerEnvironment,
    forget,
    remember,
)
from ..worker_requirements import Requirement, plain_name, read_requirements
from .command_runner import run_command
from .commands import CUDA, SetupRequest, Step, check_folders, install_steps, kind_for, venv_step
from .examine import BROKEN, GOOD, MISSING, PackageState, examine_worker
from .pythons import FoundPython, probe

_logger = logging.getLogger(__name__)

NEEDED_BYTES = 3 * 2**30
"""Download and installation with torch for the processor (1.5 GB stay)."""
NEEDED_CUDA_BYTES = 12 * 2**30
PARENT_POLL_S = 0.5
_NEWS = re.compile(r"(Collecting|Requirement already satisfied:) ([A-Za-z0-9._-]+)")
_MAX_MESSAGE = 160

Say = Callable[[str, float, str], None]
"""Stage, fraction, message."""


def set_up(request: SetupRequest, say: Say, is_cancelled: Callable[[], bool]) -> WorkerEnvironment:
    """Make the environment, or go on with one that is half made or broken.

    The folder is there and is free for us: :func:`main` has looked.

    Raises
    ------
    WrapError
        The Python, the folder or a package cannot be used, there is no room, or the user stopped.
    """
    environment = request.environment
    requirements = read_requirements(Path(request.requirements))
    python = probe(request.python)
    request = replace(request, python=python.path)
    kind = kind_for(python)
    _check_disk(request, requirements)
    with _logged(environment) as (log, temporary):

        def run(step: Step, say_line: Callable[[str], None] = lambda _line: None) -> None:
            log.write(f"$ {step.line}\n")
            run_command(step.command, temporary, log, say_line, is_cancelled)

        environment.ready_path.unlink(missing_ok=True)
        states = _states(request, environment, python, kind)
        if not states:
            say("environment", 0.0, "Making the environment")
            kind = _make(request, environment, python, kind, run)
            states = [PackageState(r.name, MISSING) for r in requirements]
        _install(request, python, kind, requirements, states, run, say)
        say("check", 0.95, "Checking the packages")
        states = examine_worker(environment.worker(), Path(request.requirements))
        bad = [s for s in states if s.state != GOOD]
        if bad:
            raise WorkerError(
                f"{bad[0].name} is {bad[0].state} after the installation. {bad[0].detail}".strip(),
                "See log.txt in the worker's folder, then press Repair.",
            )
        if kind == VENV:
            run(Step((str(environment.venv_python), "-I", "-m", "pip", "check")))
        if is_cancelled():
            raise Cancelled("The set-up was cancelled.", "Press Set Up Worker to go on.")
    write_json(environment.ready_path, {s.name: s.version for s in states})
    remember(environment.root)
    return environment


def _make_folder(request: SetupRequest) -> None:
    check_folders(request)
    root = request.environment.root
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"{root} cannot be written: {error.strerror}.", "Choose another folder."
        ) from None


def _check_disk(request: SetupRequest, requirements: list[Requirement]) -> None:
    if request.repair or all(r.name != "torch" for r in requirements):
        return
    needed_bytes = NEEDED_CUDA_BYTES if request.torch == CUDA else NEEDED_BYTES
    free_bytes = shutil.disk_usage(request.root).free
    if free_bytes < needed_bytes and not request.environment.venv.exists():
        raise ResourceError(
            f"{free_bytes / 2**30:.1f} GiB are free, {needed_bytes / 2**30:.0f} GiB are needed.",
            "Free some, or choose another folder.",
        )


@contextlib.contextmanager
def _logged(environment: WorkerEnvironment) -> Iterator[tuple[IO[str], Path]]:
    """Open the log and a folder for temporary files, which goes in the end."""
    temporary = environment.root / "tmp"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    try:
        with (environment.root / "log.txt").open("a", encoding="utf-8") as log:
            log.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} {platform.platform()}\n")
            yield log, temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _states(
    request: SetupRequest, environment: WorkerEnvironment, python: FoundPython, kind: str
) -> list[PackageState]:
    """Return what an environment that is there holds; nothing where it must be made anew."""
    marker = environment.marker()
    same_python = os.path.realpath(str(marker.get("python", ""))) == os.path.realpath(python.path)
    if not same_python or marker.get("version") != python.version_text or not environment.worker():
        return []
    if marker.get("kind") not in (kind, PACKAGES):
        return []
    try:
        states = examine_worker(environment.worker(), Path(request.requirements))
    except WorkerError as error:
        _logger.info("making the environment anew: %s", error)
        return []
    if not request.repair:
        return states
    # Their files are all there; whether they can be imported, only trying tells.
    unusable = {d.subject for d in diagnose_worker(environment.worker()) if not d.good} & {
        s.name for s in states if s.state == GOOD
    }
    return [replace(s, state=BROKEN) if s.name in unusable else s for s in states]


def _make(
    request: SetupRequest,
    environment: WorkerEnvironment,
    python: FoundPython,
    kind: str,
    run: Callable[[Step], None],
) -> str:
    """Make an empty environment and return its kind: a venv, or where that fails a folder."""
    for kind_now in dict.fromkeys((kind, PACKAGES)):
        write_json(
            environment.marker_path,
            {
                "made_by": "gaussian_wrapping_addon",
                "kind": kind_now,
                "python": python.path,
                "version": python.version_text,
                "torch": request.torch,
            },
        )
        for folder in (environment.venv, environment.packages):
            if folder.exists():
                shutil.rmtree(folder)
        if kind_now == PACKAGES:
            environment.packages.mkdir()
            break
        try:
            run(venv_step(request))
            if environment.venv_python.exists():
                break
        except (Cancelled, ResourceError):
            raise
        except WorkerError as error:
            # Blender's Python lacks the launcher of venvs on Windows.
            if not (python.has_pip or python.has_ensurepip):
                raise
            _logger.warning("no venv can be made, packages go into a folder: %s", error)
    return kind_now


def _install(
    request: SetupRequest,
    python: FoundPython,
    kind: str,
    requirements: list[Requirement],
    states: list[PackageState],
    run: Callable[[Step, Callable[[str], None]], None],
    say: Say,
) -> None:
    """Install what is missing and, by force, what is broken."""
    bad = {s.name: s.state for s in states if s.state != GOOD}
    if kind == PACKAGES and bad:
        bad = {r.name: MISSING for r in requirements}  # pip replaces such a folder as a whole
    missing = [r for r in requirements if bad.get(r.name) == MISSING]
    broken = [r for r in requirements if r.name in bad and r not in missing]
    steps = install_steps(request, python, kind, broken, force=True)
    # Once more without force: a broken package may lack what it needs.
    steps += install_steps(request, python, kind, missing + broken)
    total = len(missing) + 2 * len(broken)
    before = 0
    for step in steps:
        tell = _teller(step, before, total, say)
        first = step.brings[0].name
        say("install", 0.05 + 0.9 * before / max(total, 1), f"{first}: asking pip")
        run(step, tell)
        before += len(step.brings)


def _teller(step: Step, before: int, total: int, say: Say) -> Callable[[str], None]:
    """Return what turns pip's lines into progress: a package is done when the next is named."""
    names = {plain_name(r.name) for r in step.brings}
    seen: list[str] = []

    def tell(line: str) -> None:
        match = _NEWS.match(line)
        name = plain_name(match[2]) if match else ""
        if name in names and name not in seen:
            seen.append(name)
        done = before + max(len(seen) - 1, 0)
        current = seen[-1] if seen else "packages"
        message = f"{current}: {line.strip()}"[:_MAX_MESSAGE]
        say("install", 0.05 + 0.9 * done / max(total, 1), message)

    return tell


def repair_request(request: SetupRequest) -> SetupRequest:
    """Return a request with the Python and torch that the environment was made with.

    Raises
    ------
    UsageError
        There is no environment of ours.
    """
    marker = request.environment.marker()
    if not marker:
        raise UsageError(
            f"{request.root} holds no worker environment.", "Press Set Up Worker instead."
        )
    python = str(marker.get("python", ""))
    if not Path(python).exists():
        if not request.python:
            raise UsageError(
                f"The Python {python}, from which it was made, has gone.",
                "Press Set Up Worker and choose another Python.",
            )
        python = request.python
    torch = str(marker.get("torch", request.torch))
    return replace(request, python=python, torch=torch, repair=True)


def remove(environment: WorkerEnvironment) -> None:
    """Delete an environment that we made, and nothing else.

    Raises
    ------
    UsageError
        The folder does not carry our marker, or a set-up is at work in it.
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
    for folder in (environment.venv, environment.packages, root / "tmp"):
        if folder.is_symlink():
            folder.unlink()
        elif folder.exists():
            shutil.rmtree(folder)
    for name in ("status.json", "log.txt", "output.txt", "cancel", "lock.json", MARKER):
        (root / name).unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # something else lies there: it stays
        root.rmdir()


def main(arguments: list[str]) -> int:
    """Carry out a request (JSON, ``arguments[0]``) for the process ``arguments[1]``."""
    request = SetupRequest(**json.loads(arguments[0]))
    folder = JobFolder(Path(request.root))
    stop = threading.Event()
    threading.Thread(target=_stop_with_parent, args=(int(arguments[1]), stop), daemon=True).start()
    status = JobStatus(
        "RUNNING",
        "environment",
        message="Looking at what is there",
        pid=os.getpid(),
        pid_started=process_start_ticks(os.getpid()),
        heartbeat_s=time.time(),
    )

    def say(stage: str, fraction: float, message: str) -> None:
        nonlocal status
        news = replace(status, stage=stage, fraction=fraction, message=message)
        if news != replace(status, heartbeat_s=news.heartbeat_s):
            status = replace(news, heartbeat_s=time.time())
            folder.write_status(status)

    locked = False
    try:
        _make_folder(request)
        folder.lock()
        locked = True
        folder.write_status(status)
        set_up(request, say, lambda: stop.is_set() or folder.cancel_path.exists())
        status = replace(status, state="DONE", fraction=1.0, message="", exit_code=EXIT_DONE)
    except WrapError as error:
        state = "CANCELLED" if isinstance(error, Cancelled) else "FAILED"
        status = replace(
            status, state=state, error=error.message, hint=error.hint, exit_code=error.exit_code
        )
    except Exception as error:  # whatever it is, the one who waits must read it
        _logger.exception("set-up")
        status = replace(
            status, state="FAILED", error=f"{type(error).__name__}: {error}.",
            hint="See log.txt in the worker's folder, then press Repair.", exit_code=EXIT_OTHER,
        )  # fmt: skip
    if locked:
        folder.cancel_path.unlink(missing_ok=True)
        if request.environment.is_ours():
            folder.write_status(replace(status, heartbeat_s=time.time()))
        else:  # it came to nothing: nothing stays
            folder.status_path.unlink(missing_ok=True)
        folder.unlock()
        with contextlib.suppress(OSError):
            folder.root.rmdir()
    sys.stdout.write(json.dumps({"error": status.error, "hint": status.hint}) + "\n")
    return int(status.exit_code or 0)


def _stop_with_parent(parent: int, stop: threading.Event) -> None:
    """Ask for the end when the one who asked has gone: pip is ended too, and nothing is ready."""
    started = process_start_ticks(parent)
    while process_alive(parent, started):
        time.sleep(PARENT_POLL_S)
    stop.set()

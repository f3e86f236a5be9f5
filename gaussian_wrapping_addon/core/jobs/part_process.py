# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``run-part`` command: run one part of a job in a process of its own.

Runs in the worker's Python, on any computer that sees the job folder. Lines are in the protocol of
:mod:`.run_in_worker`, the exit code is one of :mod:`.graph`.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import FrameType

from .. import limits
from ..devices import choose_device
from ..errors import Cancelled, UsageError, WorkerError, WrapError
from ..files import seconds_since_written
from ..names import TILE_KINDS
from ..parallel import default_threads
from ..progress import Progress
from ..worker.helper_process import emit, kill_helpers
from ..worker.spawn import Caller, end_with_parent
from .parts import graph as parts
from .parts.graph import Part, PartsGraph
from .parts.lease import PartLease
from .parts.runner import HERE, PartResult, PartRunner
from .stages.meshing import TILES_FOLDER
from .store.job_file import JobFile, read_job
from .store.job_folder import JobFolder, JobStatus
from .store.rollback import discard_rollback
from .worker import failure_of

_logger = logging.getLogger(__name__)

TELL_EVERY_S = 30.0
"""Farms take a task that says nothing for minutes for dead."""
POLL_S = 1.0
MANY = frozenset((parts.STATES_FOLDER, TILES_FOLDER))
"""Folders with files of every tile. A part of one tile does not look for links among them all:
whatever opens one of their files refuses links, and what replaces one replaces the link."""


def main(arguments: list[str]) -> int:
    """Run ``arguments = [{"out", "part", "threads", "device", "attempt", "driven"} as JSON]``.

    ``driven``: whether a process that walks the parts holds the folder; the part ends with it.
    """
    end_with_parent()
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    request = json.loads(arguments[0])
    folder = JobFolder(Path(request["out"]))
    try:
        return _run(folder, request)
    except WrapError as error:
        emit(error=error.message, hint=error.hint)
        return parts.part_exit_code(error, error.exit_code)


def _run(folder: JobFolder, request: dict[str, object]) -> int:
    if not folder.is_job():
        raise UsageError(f"{folder.root} is not a job folder.", "Give the --out of a job.")
    folder.check_entries(but=MANY)
    graph = parts.read_parts(folder.root)
    version = parts.code_version()
    if graph.code != version:
        emit(
            error=f"This computer has version {version} of the program, the job was planned "
            f"by {graph.code}.",
            hint="Install the same version on all computers.",
        )
        return parts.OTHER_CODE
    job = read_job(folder.job_path)
    if parts.plan_hash(job) != graph.plan:
        raise UsageError(f"{folder.root} was planned for another job.", "Plan it again: parts DIR.")
    part = graph.part(str(request["part"]))
    if part.kind not in TILE_KINDS:
        folder.check_entries()
    driven = bool(request["driven"])
    if parts.done_state(folder.root, part.name, graph.plan) is not None:
        emit(line=f"part {part.name} was done before")
        return parts.DONE
    for name in part.needs:
        if parts.done_state(folder.root, name, graph.plan) is None:
            raise WorkerError(f"Part {part.name} needs {name}, which is not done.", "Run it first.")
    job = _with_photos(job, graph, folder)
    if part.kind in HERE and not driven:
        folder.lock()
        try:
            code = _hold(folder, job, graph, part, request)
            if code == parts.DONE:  # it is the last one
                result = str(folder.result) if folder.result.is_dir() else ""
                folder.write_status(JobStatus("DONE", part.kind, 1.0, result=result))
                discard_rollback(folder)
            return code
        finally:
            folder.unlock()
    return _hold(folder, job, graph, part, request)


def _with_photos(job: JobFile, graph: PartsGraph, folder: JobFolder) -> JobFile:
    """Return the job with the path of its photos as this computer sees them."""
    if os.path.lexists(job.source) or not graph.source:
        return job
    here = os.path.normpath(folder.root / graph.source)
    return replace(job, source=here) if os.path.lexists(here) else job


class _Watch:
    """Tells whether the part is to stop, and why."""

    def __init__(self, folder: JobFolder, lease: PartLease, driven: bool) -> None:
        self._folder, self._lease, self._driven = folder, lease, driven
        self._caller = Caller()
        self._terminated = self._driver_is_gone = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._terminate)

    def _terminate(self, _number: int, _frame: FrameType | None) -> None:
        self._terminated = True

    def reason(self) -> str:
        """Return why the part is to stop; empty to go on."""
        if self._lease.is_lost:
            return "another process has taken it over"
        if self._driver_is_gone:
            return "the process that walks the parts has ended"
        return "its process was ended" if self._terminated else ""

    def cancelled(self) -> bool:
        """Return whether to stop."""
        return bool(self.reason()) or self._folder.cancel_path.exists()

    def keep(self, ended: threading.Event) -> None:
        """Look after caller, driver and cancel file, and say that it works; runs in a thread."""
        stop_s, told_s = None, time.monotonic()
        while not ended.wait(POLL_S):
            if time.monotonic() - told_s >= TELL_EVERY_S:
                told_s = time.monotonic()
                self._lease.tell()
            if self._caller.ended():
                self._exit()
            if self._driven and self._gone():
                self._driver_is_gone = True
            if self.cancelled():
                stop_s = stop_s or time.monotonic()
                if time.monotonic() - stop_s > limits.CANCEL_ALONE_S:
                    self._exit()

    def _gone(self) -> bool:
        """Return whether the process that walks the parts has shown nothing for long."""
        if self._folder.locked():
            return False
        try:
            return seconds_since_written(self._folder.lock_path) > limits.SILENT_S
        except OSError:
            return True  # it has released the folder, or the folder is gone

    def _exit(self) -> None:
        kill_helpers()
        self._lease.finish("FAILED", error="It was ended.", exit_code=parts.MAY_WORK_ELSEWHERE)
        os._exit(parts.CANCELLED if self._folder.cancel_path.exists() else parts.MAY_WORK_ELSEWHERE)


def _hold(
    folder: JobFolder, job: JobFile, graph: PartsGraph, part: Part, request: dict[str, object]
) -> int:
    """Run a part while holding its lease; return the exit code."""
    attempt = int(str(request["attempt"]))
    lease = PartLease(folder.root, part.name, graph.plan, attempt)
    watch = _Watch(folder, lease, bool(request["driven"]))
    ended = threading.Event()
    threading.Thread(target=watch.keep, args=(ended,), daemon=True).start()
    try:
        # Another process may still run it, for a walk that has ended.
        if not lease.take(watch.cancelled if request["driven"] else None):
            emit(line=f"part {part.name} was done by another process")
            return parts.DONE
        result = _work(folder, job, graph, part, request, lease, watch)
        state = lease.finish("DONE", fraction=1.0, exit_code=parts.DONE, outputs=result.outputs)
    except Cancelled as cancelled:
        reason = watch.reason()
        code = parts.MAY_WORK_ELSEWHERE if reason else parts.CANCELLED
        message = f"Part {part.name} stopped: {reason}." if reason else cancelled.message
        lease.finish("FAILED", error=message, exit_code=code)
        emit(error=message, hint="")
        return code
    except Exception as error:
        failure = failure_of(error, folder.root)
        if not failure.is_known:
            _logger.exception("unexpected failure")
        code = parts.part_exit_code(error, failure.code)
        lease.finish("FAILED", error=failure.error, hint=failure.hint, exit_code=code)
        emit(error=failure.error, hint=failure.hint)
        return code
    finally:
        ended.set()
    emit(line=f"part {part.name} is done, {state.seconds:.0f} s")
    return parts.DONE


def _work(
    folder: JobFolder, job: JobFile, graph: PartsGraph, part: Part, request: dict[str, object],
    lease: PartLease, watch: _Watch,
) -> PartResult:  # fmt: skip
    threads = int(str(request["threads"])) or default_threads()
    wanted = str(request["device"] or job.settings.device)
    device = choose_device("cpu" if job.command == "bake" else wanted)
    _logger.info("part %s, device: %s", part.name, device.sentence())
    # Only the last part tells how long the job took, and reads the states of all for it.
    begun = begun_s(folder, graph) if part.kind in HERE else time.time()
    runner = PartRunner(
        folder, job, lambda: graph, threads=threads, device=device, begun_s=begun, is_alone=False
    )
    return runner.run(part, Progress(part.kind, lease.event, watch.cancelled))


def begun_s(folder: JobFolder, graph: PartsGraph) -> float:
    """Return when the first part of a plan was begun; now, if none was."""
    begun = [time.time()]
    for path in (folder.root / parts.STATES_FOLDER).glob("*.json"):
        state = parts.read_state(folder.root, path.stem)
        if state is not None and state.plan == graph.plan:
            begun.append(state.begun_s)
    return min(begun)

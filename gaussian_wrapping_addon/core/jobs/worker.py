# SPDX-License-Identifier: GPL-3.0-or-later
"""The worker process of a job."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import math
import os
import signal
import threading
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import FrameType

from .. import limits
from ..errors import (
    DISK_FULL_ERRNOS,
    EXIT_DONE,
    EXIT_OTHER,
    EXIT_RESOURCES,
    Cancelled,
    WrapError,
    unwritable_error,
)
from ..files import open_regular, remove_partial_files
from ..progress import COMPILING, LineFormatter, ProgressEvent
from ..worker.environment import package_error
from ..worker.helper_process import emit, kill_helpers
from ..worker.spawn import Caller, host_and_pid_namespace, process_start_ticks
from .store.job_file import read_job
from .store.job_folder import JobFolder, JobStatus
from .store.rollback import discard_rollback, roll_back

# -- What a job that failed tells: exit code, error and next step of any exception ----------------

FULL_DISK_HINT = "Make room on that disk, then resume: the last checkpoint is intact."
MEMORY_HINT = "Close other programs, or choose a smaller preset."
BUG_HINT = "Send the job folder's log.txt with a bug report."
_NO_THREAD = "can't start new thread"
"""What Python says where the system gives no memory, or no number, to another thread."""


@dataclass(frozen=True)
class Failure:
    """What ``status.json`` says of a failed job."""

    code: int
    error: str
    hint: str
    is_known: bool = True
    """Whether users can do something about it; else the log needs the traceback."""


def failure_of(error: Exception, root: Path) -> Failure:
    """Describe an exception that ended a job.

    ``root``: the job folder: where a full disk is, if the error does not name a file.
    """
    if isinstance(error, WrapError):
        cause = error.__cause__
        is_full = isinstance(cause, OSError) and cause.errno in DISK_FULL_ERRNOS
        return Failure(error.exit_code, error.message, FULL_DISK_HINT if is_full else error.hint)
    if isinstance(error, OSError) and error.errno in DISK_FULL_ERRNOS:
        full = unwritable_error(error.filename or root, error)
        return Failure(full.exit_code, full.message, FULL_DISK_HINT)
    if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
        return Failure(EXIT_RESOURCES, "Not enough memory.", MEMORY_HINT)
    if isinstance(error, ImportError | OSError) and (known := package_error(error)):
        return Failure(known.exit_code, known.message, known.hint)
    if isinstance(error, RuntimeError) and _NO_THREAD in str(error):
        return Failure(EXIT_RESOURCES, "The system starts no further thread.", MEMORY_HINT)
    return Failure(EXIT_OTHER, f"Unexpected {type(error).__name__}: {error}", BUG_HINT, False)


# -- The worker process: lock the job folder, run the job, keep ``status.json`` up to date --------

_logger = logging.getLogger(__name__)

HEARTBEAT_S = 5.0
STATUS_EVERY_S = 0.25
PARENT_POLL_S = 1.0
RESUME_HINT = "Resume continues from the last checkpoint."


class _Reporter:
    """Write progress events to the status file at a bounded rate and poll for cancelling."""

    def __init__(self, folder: JobFolder, status: JobStatus) -> None:
        self.folder, self.status = folder, status
        self._guard, self._final_status = threading.Lock(), threading.Lock()
        self._written_s = self._logged_s = 0.0
        self._stop = threading.Event()
        self.stop_requested = False

    def event(self, event: ProgressEvent) -> None:
        """Handle a progress event of the runner; fraction and time left are of the whole job."""
        now_s = time.monotonic()
        changed = event.stage != self.status.stage
        finite = {name: value for name, value in event.figures.items() if math.isfinite(value)}
        with self._guard:
            self.status = replace(
                self.status, stage=event.stage, fraction=event.fraction, message=event.message,
                phase=event.phase, seconds_left=event.seconds_left,
                figures={**({} if changed else self.status.figures), **finite},
            )  # fmt: skip
        if changed or now_s - self._written_s > STATUS_EVERY_S:
            self.write()
        if changed or now_s - self._logged_s > HEARTBEAT_S:
            self._logged_s = now_s
            _logger.info("%s %.1f %% %s", event.stage, 100 * event.fraction, event.message)

    def write(self, **changes: object) -> None:
        """Write the status now, with a fresh heartbeat."""
        with self._guard:
            self.status = replace(self.status, heartbeat_s=time.time(), **changes)  # type: ignore[arg-type]
            self._written_s = time.monotonic()
            self.folder.write_status(self.status)

    def cancelled(self) -> bool:
        """Whether a cancel file exists or the process was asked to terminate."""
        return self.stop_requested or self.folder.cancel_path.exists()

    def keep_heartbeat(self, caller: Caller | None) -> None:
        """Write the heartbeat; request a stop when the caller has ended. Runs in a thread."""
        requested_s = math.inf
        shown_s = time.monotonic()
        while not self._stop.wait(PARENT_POLL_S):
            if caller is not None and caller.ended():
                self.stop_requested = True
            if self.cancelled():
                requested_s = min(requested_s, time.monotonic())
            if self.cancelled() and self.status.phase == COMPILING:
                self._exit_immediately()
                continue
            if time.monotonic() - requested_s > limits.CANCEL_ALONE_S:
                _logger.warning("busy with %r: ended without waiting", self.status.message)
                self._exit_immediately()
            # On a full disk the main thread ends the job with an error message.
            with contextlib.suppress(OSError):
                if self.cancelled() and self.status.state == "RUNNING":
                    self.write(state="CANCELLING")
                elif time.time() - self.status.heartbeat_s > HEARTBEAT_S:
                    self.write()
            if time.monotonic() - shown_s > HEARTBEAT_S:
                shown_s = time.monotonic()
                self.folder.show_life()

    def _exit_immediately(self) -> None:
        """Exit while the main thread is in a long native call, such as a compilation.

        Work in progress is lost, as after a kill: a stage is finished once ``done.json`` exists.
        """
        self._final_status.acquire()
        if self._stop.is_set():
            return  # the main thread ended first and writes the final status
        _logger.info("cancelled")
        kill_helpers()
        with contextlib.suppress(OSError):  # on a full disk, exit all the same
            self.write(state="CANCELLED", error="", hint=RESUME_HINT, exit_code=Cancelled.exit_code)
            self.folder.unlock()
            logging.shutdown()
        os._exit(Cancelled.exit_code)

    def end(self) -> None:
        """Stop the heartbeat; the caller then writes the final status."""
        with self._final_status:
            self._stop.set()


class _LogFile(logging.FileHandler):
    """A log that is a regular file and nothing else."""

    def _open(self) -> io.TextIOWrapper:
        stream = open_regular(Path(self.baseFilename), "ab")
        return io.TextIOWrapper(stream, encoding="utf-8", errors="backslashreplace")

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - a name of logging
        """Say nothing: on a full disk the job ends with an error of its own, see ``main``."""


def _log_to(path: Path) -> logging.Handler:
    handler = _LogFile(path, encoding="utf-8")
    handler.setFormatter(LineFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    for noisy in ("numba", "PIL", "matplotlib", "trimesh"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    return handler


def main(arguments: list[str]) -> int:
    """Run the job of ``arguments = [folder, "1" or "0"]``; return the exit code.

    With ``"0"`` the worker continues when its caller ends.
    """
    folder = JobFolder(Path(arguments[0]))
    caller = Caller() if arguments[1:2] not in ([], ["0"]) else None
    try:
        folder.check_entries()
        _log_to(folder.log_path)
    except WrapError as refused:
        # Nothing of the folder is touched, its log and status included.
        emit(error=refused.message, hint=refused.hint)
        return refused.exit_code
    pid = os.getpid()
    begun = JobStatus(
        state="RUNNING", pid=pid, pid_started=process_start_ticks(pid),
        place=host_and_pid_namespace(),
    )  # fmt: skip
    reporter = _Reporter(folder, begun)

    def request_stop(_number: int, _frame: FrameType | None) -> None:
        reporter.stop_requested = True

    signal.signal(signal.SIGTERM, request_stop)
    signal.signal(signal.SIGINT, request_stop)
    try:
        folder.lock()
    except WrapError as refused:
        # Another worker owns the folder: leave its status and its lock alone.
        _logger.error("%s", refused)
        emit(error=refused.message, hint=refused.hint)
        return refused.exit_code
    can_resume = False
    try:
        remove_partial_files(folder.root)
        reporter.write()
        threading.Thread(target=reporter.keep_heartbeat, args=(caller,), daemon=True).start()
        from .runner import run_job

        run_job(folder, read_job(folder.job_path), reporter.event, reporter.cancelled)
    except Cancelled:
        _logger.info("cancelled")
        code = Cancelled.exit_code
        state, error, hint = "CANCELLED", "", RESUME_HINT
    except Exception as error_of_job:
        can_resume = getattr(error_of_job, "can_resume", False)
        failure = failure_of(error_of_job, folder.root)
        if isinstance(error_of_job, WrapError):
            _logger.error("%s", error_of_job)
        else:
            _logger.exception("the job failed" if failure.is_known else "unexpected failure")
        code, state, error, hint = failure.code, "FAILED", failure.error, failure.hint
    else:
        code, state, error, hint = EXIT_DONE, "DONE", "", ""
    reporter.end()
    result = str(folder.result) if folder.result.is_dir() else ""
    if state == "DONE":
        discard_rollback(folder)
    earlier = None
    if state == "FAILED" and not can_resume:
        try:
            earlier = roll_back(folder)
        except OSError:  # the failure is reported all the same
            _logger.exception("the earlier job cannot be restored")
    finished = {"fraction": 1.0, "seconds_left": 0.0, "message": ""} if state == "DONE" else {}
    last = {**finished, "state": state, "phase": "", "result": result}
    if earlier is not None:
        last = {k: v for k, v in asdict(earlier).items() if k != "heartbeat_s"}
        last["put_back"] = True
    reporter.write(**{**last, "error": error, "hint": hint, "exit_code": code})
    remove_partial_files(folder.root)
    folder.unlock()
    return code

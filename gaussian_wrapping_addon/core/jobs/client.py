# SPDX-License-Identifier: GPL-3.0-or-later
"""Starts, watches and stops the worker of a job."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from ..devices import reject_absent_gpu
from ..errors import (
    EXIT_CANCELLED,
    EXIT_OTHER,
    EXIT_RESOURCES,
    ParseError,
    UsageError,
    WorkerError,
    unwritable_error,
)
from ..files import open_regular, real_path, touch_regular
from ..worker.environment import not_started, ready_worker
from ..worker.helper_process import child_command, ending_of, json_object
from ..worker.spawn import is_here, kill_group, process_alive, spawn
from .stages.training import killed_hint, killed_mesh_hint
from .store.job_file import JobFile, read_job, reject_region_conflicts, write_job
from .store.job_folder import FOREIGN_LOCK_HINT, JobFolder, JobStatus
from .store.rollback import save_rollback

WORKER_MODULE = "jobs.worker"
PYTHON_VARIABLE = "GAUSSIAN_WRAPPING_PYTHON"
OUTPUT_TAIL_BYTES = 16_000
KILLED_CODES = (-9, 137)
"""Exit codes of a process ended by SIGKILL, directly or under a shell, as by the kernel when memory
runs out."""

CODE_WAIT_S = 0.5
"""How long to wait for the exit code of a worker that has ended; only a launcher in between takes
longer."""
KILL_GRACE_S = 2.0
KILL_POLL_S = 0.05
RUNNING_HINT = (
    "Wait for it, or stop it: cancel DIR on the command line, Cancel in Blender. "
    f"{FOREIGN_LOCK_HINT}"
)
PYTHON_HINT = "Check the worker's Python: batch.py doctor, or Check Worker in the preferences."
STAGES_AFTER_TRAINING = ("mesh", "texture", "export", "bake")
"""Stages of a job whose training is finished."""
KILLED_BAKE_HINT = (
    "Close other programs and resume; or bake again with a smaller --texture-size, or fewer "
    "--faces. The job's result is unchanged."
)


def worker_python(preference: str = "") -> str:
    """Return the interpreter for workers, or the folder of a worker environment.

    In this order: the preference, the environment variable, the environment made by the add-on, the
    running Python if it has torch. Raises UsageError: there is none.
    """
    chosen = preference or os.environ.get(PYTHON_VARIABLE, "")
    if chosen and not Path(chosen).exists():
        raise UsageError(
            f"The worker's Python {chosen} does not exist.",
            f"Correct it in the add-on's preferences or in {PYTHON_VARIABLE}.",
        )
    found = chosen or ready_worker() or (sys.executable if _has_torch() else "")
    if not found:
        raise UsageError(
            "No worker is set up.",
            "Press Set Up Worker in the add-on's preferences, run batch.py set-up-worker, or name"
            f" a Python that has the packages in {PYTHON_VARIABLE}.",
        )
    return found


def worker_if_any(preference: str = "") -> str:
    """Return :func:`worker_python`'s answer, ``""`` where there is none."""
    try:
        return worker_python(preference)
    except UsageError:
        return ""


def _has_torch() -> bool:
    """Tell whether the running Python could be a worker; imports nothing."""
    try:
        return importlib.util.find_spec("torch") is not None
    except (ImportError, ValueError):
        return False


@contextlib.contextmanager
def _writing(root: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise unwritable_error(error.filename2 or error.filename or root, error) from None


def prepare_job(folder: Path, job: JobFile) -> JobFolder:
    """Write a job into its folder, to be started or submitted.

    Raises WrapError: the folder cannot be used, or a job runs there; the earlier job stays.
    """
    target = JobFolder(real_path(folder))
    source = Path(job.source)
    if source.is_dir() and target.root.is_relative_to(source):
        raise UsageError(
            f"{folder} lies inside the photos' folder.", "Choose a folder outside of it."
        )
    target.create()
    if target.locked():
        raise UsageError(f"A job is running in {folder}.", RUNNING_HINT)
    reject_region_conflicts(target.result, job)
    with _writing(target.root):
        save_rollback(target, job)
        write_job(target.job_path, job)
    return target


class JobClient:
    """Handle of one job for Blender or the command line."""

    def __init__(self, folder: JobFolder, process: subprocess.Popen[bytes] | None) -> None:
        self.folder = folder
        self._process = process
        self._seen_active = process is not None
        self._gone_since_s: float | None = None

    @classmethod
    def start(
        cls, folder: Path, job: JobFile, *, python: str | None = None, keep_running: bool = False
    ) -> JobClient:
        """Write the job into ``folder`` and start its worker.

        Parameters
        ----------
        folder : Path
            New, empty, or a job folder.
        job : JobFile
            What to do.
        python : str or None
            Interpreter that has torch; ``None`` asks :func:`worker_python`.
        keep_running : bool
            Whether the worker continues when this process ends.

        Raises
        ------
        DeviceError
            The job names a GPU that the driver does not find; nothing was written.
        """
        _reject_absent_device(job)
        return cls._launch(prepare_job(folder, job), python, keep_running)

    @classmethod
    def resume(
        cls, folder: Path, *, python: str | None = None, keep_running: bool = False,
        device: str | None = None,
    ) -> JobClient:  # fmt: skip
        """Start a worker for the job in ``folder``; ``device``, if given, replaces its setting.

        Raises DeviceError: as :meth:`start`.
        """
        target = JobFolder(real_path(folder))
        if not target.is_job():
            raise UsageError(
                f"{folder} holds no job.", "Choose the folder given as --out, or press Find Job."
            )
        target.check_entries()
        stored = read_job(target.job_path)  # refused here rather than by the worker
        job = stored
        if device is not None:
            job = replace(stored, settings=replace(stored.settings, device=device).validated())
        _reject_absent_device(job)
        if target.locked():
            raise UsageError(f"A job is running in {folder}.", RUNNING_HINT)
        if job != stored:
            with _writing(target.root):
                write_job(target.job_path, job)
        return cls._launch(target, python, keep_running)

    @classmethod
    def _launch(cls, target: JobFolder, python: str | None, keep_running: bool) -> JobClient:
        with _writing(target.root):
            target.cancel_path.unlink(missing_ok=True)
            target.write_status(JobStatus(heartbeat_s=time.time()))
            output = open_regular(target.output_path, "wb")
        with output:
            chosen = python or worker_python()
            command = child_command(
                WORKER_MODULE, str(target.root), "0" if keep_running else "1", python=chosen
            )
            try:
                process = spawn(command, stdout=output, stderr=subprocess.STDOUT)
            except OSError as error:
                raise not_started(chosen, error) from None
        return cls(target, process)

    @classmethod
    def attach(cls, folder: Path) -> JobClient:
        """Watch a job started by another process."""
        target = JobFolder(real_path(folder))
        if not target.is_job():
            raise UsageError(f"{folder} holds no job.", "Choose a job folder.")
        return cls(target, None)

    def poll(self) -> JobStatus:
        """Return the job's status; cheap enough for a timer, and never waits.

        A finished job whose new mesh failed was rolled back: it is FAILED for a client that saw it
        running, and DONE for all others.
        """
        status = self._poll()
        if status.result:
            # The stored path is not trusted: the job may have been moved or come from elsewhere.
            status = replace(status, result=str(self.folder.result))
        self._seen_active = self._seen_active or status.active
        if self._seen_active and status.state == "DONE" and status.put_back:
            return replace(status, state="FAILED")
        return status

    def _poll(self) -> JobStatus:
        code = None if self._process is None else self._process.poll()
        # Read after polling the process: it may write its last status just before it ends.
        status = self.folder.read_status()
        if code is None and self._process is not None and status.state == "LOST":
            # It ended between poll() and read_status(): only its exit code tells why.
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = self._process.wait(0.0)
            now_s = time.monotonic()
            self._gone_since_s = self._gone_since_s or now_s
            if code is None and now_s - self._gone_since_s < CODE_WAIT_S:
                return replace(status, state="RUNNING", error="", hint="")
        if code is None:
            if status.state == "NEW" and self._process is None and not self.folder.locked():
                return self._failed(status, "The worker did not start.")
            return status
        if EXIT_OTHER <= code <= EXIT_CANCELLED and (told := self._refusal()):
            return replace(
                status, state="FAILED", error=told.message, hint=told.hint, exit_code=code
            )
        if status.active or status.state == "LOST":
            if code in KILLED_CODES:
                return self._killed(status)
            words = f"The worker {ending_of(code)}. {self.output_tail()}"
            return self._failed(status, words.strip())
        return status

    def _killed(self, status: JobStatus) -> JobStatus:
        """Return the status of a worker ended by SIGKILL, which could not report an error."""
        failed = self._failed(
            status, "The worker was stopped by signal 9: killed, probably out of memory."
        )
        failed = replace(failed, exit_code=EXIT_RESOURCES)
        try:
            job = read_job(self.folder.job_path)
        except (UsageError, ParseError, OSError):
            return failed
        if job.command == "bake":
            return replace(failed, hint=KILLED_BAKE_HINT)
        if job.command != "mesh" and status.stage not in STAGES_AFTER_TRAINING:
            return replace(failed, hint=killed_hint(job.settings.training))
        kept = job.command == "mesh" and (self.folder.result / "report.json").is_file()
        return replace(failed, hint=killed_mesh_hint(job.settings.meshing, kept=kept))

    def _refusal(self) -> WorkerError | None:
        """Return the error of a worker that could not begin; the job's status is not of it."""
        for line in reversed(self._output_lines()):
            values = json_object(line) or {}
            if values.get("error"):
                return WorkerError(str(values["error"]), str(values.get("hint", "")))
        return None

    def _failed(self, status: JobStatus, error: str) -> JobStatus:
        log = self.folder.log_path.name
        begun = status.state != "NEW"
        return replace(
            status, state="LOST" if begun else "FAILED", error=error,
            hint=f"See {log} in the job folder, then resume." if begun else PYTHON_HINT,
        )  # fmt: skip

    def output_tail(self) -> str:
        """Return the last line that the worker wrote to stdout and stderr."""
        lines = self._output_lines()
        return lines[-1] if lines else ""

    def _output_lines(self) -> list[str]:
        try:
            with open_regular(self.folder.output_path) as output:
                length = output.seek(0, os.SEEK_END)
                output.seek(max(length - OUTPUT_TAIL_BYTES, 0))
                data = output.read(OUTPUT_TAIL_BYTES)
        except (OSError, ParseError):
            return []
        return data.decode(errors="replace").strip().splitlines()

    def cancel(self) -> None:
        """Ask the worker to stop; it stops within about two seconds and keeps a checkpoint.

        Raises ParseError: ``cancel`` in the job folder is not a regular file.
        """
        with contextlib.suppress(OSError):
            touch_regular(self.folder.cancel_path)

    def kill(self) -> None:
        """End the worker and its helpers: terminate, wait two seconds, kill.

        A worker started by another process is known only from the job folder, which may come from
        another machine: it is ended only if the system confirms that it is a worker.
        """
        if self._process is not None:
            kill_group(self._process)
            return
        status = self.folder.read_status()
        if not is_here(status.place) or not _is_worker(status.pid):
            return
        for number in (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM)):
            end_s = time.monotonic() + KILL_GRACE_S
            with contextlib.suppress(ProcessLookupError, PermissionError):
                if process_alive(status.pid, status.pid_started):
                    _signal_group(status.pid, number)
            while time.monotonic() < end_s:
                if not process_alive(status.pid, status.pid_started):
                    return
                time.sleep(KILL_POLL_S)

    def wait(self, timeout_s: float | None = None) -> JobStatus:
        """Wait until our worker process has ended and return the final status.

        Raises WorkerError: the job was started by another process.
        """
        if self._process is None:
            raise WorkerError("This job was started by another process.", "Poll it instead.")
        self._process.wait(timeout_s)
        return self.poll()


def _reject_absent_device(job: JobFile) -> None:
    if job.command != "bake":  # nothing of a bake runs on a GPU
        reject_absent_gpu(job.settings.device)


def _signal_group(pid: int, number: int) -> None:
    """Signal a worker's process group, or the worker alone if it does not lead a group."""
    if hasattr(os, "killpg") and os.getpgid(pid) == pid:
        os.killpg(pid, number)
    else:
        os.kill(pid, number)


def _is_worker(pid: int) -> bool:
    """Tell whether a process is one of our workers; false where the system does not tell."""
    try:
        return WORKER_MODULE.encode() in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    except OSError:
        return False

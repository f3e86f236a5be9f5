# SPDX-License-Identifier: GPL-3.0-or-later
"""Start a worker process for a job folder, watch it, stop it. Needs neither torch nor bpy."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..errors import EXIT_RESOURCES, ParseError, UsageError, WorkerError
from ..helper_process import child_command, child_environment, kill_group
from .earlier_job import keep_finished
from .job_file import JobFile, read_job, write_job
from .job_folder import JobFolder, JobStatus, process_alive
from .smaller import killed_hint, killed_mesh_hint

PYTHON_VARIABLE = "GAUSSIAN_WRAPPING_PYTHON"
LAST_WORDS_BYTES = 2000
KILLED_CODES = (-9, 137)
"""Of a process that SIGKILL ended, itself or under a shell: what the kernel does for memory."""

CODE_WAIT_S = 0.5
"""For the exit code of a worker that has ended; longer only where a launcher stands between."""
AFTER_TRAINING = ("mesh", "texture", "export")
"""Stages of a job whose training is finished."""


def worker_python(preference: str = "") -> str:
    """Return the interpreter for workers: preference, environment variable, or this one."""
    chosen = preference or os.environ.get(PYTHON_VARIABLE, "") or sys.executable
    if not Path(chosen).exists():
        raise UsageError(
            f"The worker's Python {chosen} does not exist.",
            f"Correct it in the add-on's preferences or in {PYTHON_VARIABLE}.",
        )
    return chosen


class JobClient:
    """The view of one job from outside: Blender, or the command line."""

    def __init__(self, folder: JobFolder, process: subprocess.Popen[bytes] | None) -> None:
        self.folder = folder
        self._process = process
        self._seen_at_work = process is not None

    @classmethod
    def start(
        cls,
        folder: Path,
        job: JobFile,
        *,
        python: str | None = None,
        keep_running: bool = False,
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
            Let the worker go on when this process ends.
        """
        target = JobFolder(folder.resolve())
        source = Path(job.source)
        if source.is_dir() and target.root.is_relative_to(source):
            raise UsageError(
                f"{folder} lies inside the photos' folder.", "Choose a folder outside of it."
            )
        target.create()
        if target.locked():
            raise UsageError(f"A job is running in {folder}.", "Cancel it or wait for it.")
        keep_finished(target, job)
        write_job(target.job_path, job)
        return cls._launch(target, python, keep_running)

    @classmethod
    def resume(
        cls, folder: Path, *, python: str | None = None, keep_running: bool = False
    ) -> JobClient:
        """Start a worker for the job that lies in ``folder``; finished stages are re-used."""
        target = JobFolder(folder.resolve())
        if not target.is_job():
            raise UsageError(f"{folder} holds no job.", "Choose the folder given as --out.")
        if target.locked():
            raise UsageError(f"A job is running in {folder}.", "Cancel it or wait for it.")
        return cls._launch(target, python, keep_running)

    @classmethod
    def _launch(cls, target: JobFolder, python: str | None, keep_running: bool) -> JobClient:
        target.cancel_path.unlink(missing_ok=True)
        target.write_status(JobStatus(heartbeat_s=time.time()))
        options: dict[str, Any] = {"start_new_session": True}
        if sys.platform == "win32":
            options = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
        parent = "0" if keep_running else str(os.getpid())
        with (target.root / "worker-output.txt").open("wb") as output:
            process = subprocess.Popen(
                child_command(
                    "jobs.worker", str(target.root), parent, python=python or worker_python()
                ),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=child_environment(),
                **options,
            )
        return cls(target, process)

    @classmethod
    def attach(cls, folder: Path) -> JobClient:
        """Watch a job that this process did not start."""
        target = JobFolder(folder.resolve())
        if not target.is_job():
            raise UsageError(f"{folder} holds no job.", "Choose a job folder.")
        return cls(target, None)

    def poll(self) -> JobStatus:
        """Return the job's status; cheap enough for a timer.

        A job that is finished as before, but could not be meshed again, has failed for those who
        saw it at work, and is done for all others.
        """
        status = self._poll()
        self._seen_at_work = self._seen_at_work or status.active
        if self._seen_at_work and status.state == "DONE" and status.error:
            return replace(status, state="FAILED")
        return status

    def _poll(self) -> JobStatus:
        code = None if self._process is None else self._process.poll()
        # Read after the process was looked at: its last status may be its last deed.
        status = self.folder.read_status()
        if code is None and self._process is not None and status.state == "LOST":
            # It has ended between our two looks: only its code tells of what.
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = self._process.wait(CODE_WAIT_S)
        if code is None:
            if status.state == "NEW" and self._process is None and not self.folder.locked():
                return self._failed(status, "The worker did not start.")
            return status
        if status.active or status.state == "LOST":
            if code in KILLED_CODES:
                return self._killed(status)
            reason = f"was stopped by signal {-code}" if code < 0 else f"ended with code {code}"
            return self._failed(status, f"The worker {reason}. {self.last_words()}".strip())
        return status

    def _killed(self, status: JobStatus) -> JobStatus:
        """Say what a worker dies of that could not say it itself."""
        failed = self._failed(
            status, "The worker was stopped by signal 9: killed, probably out of memory."
        )
        failed = replace(failed, exit_code=EXIT_RESOURCES)
        try:
            job = read_job(self.folder.job_path)
        except (UsageError, ParseError, OSError):
            return failed
        if job.command != "mesh" and status.stage not in AFTER_TRAINING:
            return replace(failed, hint=killed_hint(job.settings.training))
        kept = job.command == "mesh" and (self.folder.result / "report.json").is_file()
        return replace(failed, hint=killed_mesh_hint(job.settings.meshing, kept=kept))

    def _failed(self, status: JobStatus, error: str) -> JobStatus:
        return replace(
            status,
            state="FAILED" if status.state == "NEW" else "LOST",
            error=error,
            hint=f"See {self.folder.log_path.name} in the job folder, then resume.",
        )

    def last_words(self) -> str:
        """Return the end of what the worker wrote to its terminal."""
        try:
            data = (self.folder.root / "worker-output.txt").read_bytes()
        except OSError:
            return ""
        lines = data[-LAST_WORDS_BYTES:].decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""

    def cancel(self) -> None:
        """Ask the worker to stop; it does within about two seconds and keeps a checkpoint."""
        with contextlib.suppress(OSError):
            self.folder.cancel_path.touch()

    def kill(self) -> None:
        """End the worker and its helpers at once."""
        if self._process is not None:
            kill_group(self._process)
            return
        status = self.folder.read_status()
        if process_alive(status.pid, status.pid_started):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                if hasattr(os, "killpg"):
                    os.killpg(status.pid, signal.SIGTERM)
                else:
                    os.kill(status.pid, signal.SIGTERM)

    def wait(self, timeout_s: float | None = None) -> JobStatus:
        """Wait until our worker process has ended and return the final status.

        Raises
        ------
        WorkerError
            This client only watches a job that another process started.
        """
        if self._process is None:
            raise WorkerError("This job was started by another process.", "Poll it instead.")
        self._process.wait(timeout_s)
        return self.poll()

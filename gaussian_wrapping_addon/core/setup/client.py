# SPDX-License-Identifier: GPL-3.0-or-later
"""Start a set-up in a process of its own and watch it; Blender and the command line do it so."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

from ..errors import EXIT_OTHER, UsageError, WorkerError
from ..helper_process import child_command
from ..jobs.job_folder import JobFolder, JobStatus
from ..processes.spawn import child_environment, kill_group
from .commands import SetupRequest, check_folders, kind_for
from .pythons import probe

LAST_WORDS_BYTES = 4000


class SetupClient:
    """A set-up that this process has started; it ends when this process does."""

    def __init__(
        self, request: SetupRequest, process: subprocess.Popen[bytes], output: IO[bytes]
    ) -> None:
        self.request = request
        self._folder = JobFolder(Path(request.root))
        self._process = process
        self._output = output
        self._begun_s = time.time()
        self._last = JobStatus(stage="environment", message="Starting")

    @classmethod
    def start(cls, request: SetupRequest) -> SetupClient:
        """Begin.

        Raises
        ------
        UsageError
            The Python cannot be used, or a set-up runs in the folder already.
        WorkerError
            The process does not start.
        """
        python = probe(request.python)
        kind_for(python)
        request = replace(request, python=python.path)
        folder = JobFolder(Path(request.root))
        if folder.locked():
            raise UsageError(f"A set-up is running in {request.root}.", "Wait for it.")
        check_folders(request)
        folder.cancel_path.unlink(missing_ok=True)
        options: dict[str, Any] = {"start_new_session": True}
        if sys.platform == "win32":
            options = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
        output = tempfile.TemporaryFile()  # noqa: SIM115 - kept as long as the process
        words = json.dumps(request.to_json())
        try:
            process = subprocess.Popen(
                child_command("setup.install", words, str(os.getpid()), python=python.path),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=child_environment(),
                **options,
            )
        except OSError as error:
            output.close()
            raise WorkerError(
                f"{python.path} does not start: {error.strerror}.", "Choose another Python."
            ) from None
        return cls(request, process, output)

    def poll(self) -> JobStatus:
        """Return how far it is; cheap enough for a timer."""
        code = self._process.poll()
        status = self._folder.read_status()
        fresh = status.heartbeat_s >= self._begun_s - 1.0
        if code is None:
            if fresh and status.active:
                self._last = status
            return self._last  # while it starts, and while it ends
        if fresh and not status.active and status.state != "LOST":
            return status
        said = self._last_words()
        error = str(said.get("error") or f"The set-up ended with code {code}. {said['words']}")
        hint = str(said.get("hint") or "Press Set Up Worker to go on.")
        return JobStatus("FAILED", error=error.strip(), hint=hint, exit_code=code or EXIT_OTHER)

    def _last_words(self) -> dict[str, Any]:
        self._output.seek(0)
        lines = self._output.read()[-LAST_WORDS_BYTES:].decode("utf-8", "replace").splitlines()
        for line in reversed(lines):
            with contextlib.suppress(ValueError):
                values = json.loads(line)
                if isinstance(values, dict):
                    return {**values, "words": ""}
        return {"words": lines[-1] if lines else ""}

    def cancel(self) -> None:
        """Ask it to stop, which it does within a second; what is installed stays for next time."""
        if self._folder.root.is_dir():
            with contextlib.suppress(OSError):
                self._folder.cancel_path.touch()

    def kill(self) -> None:
        """End it at once."""
        kill_group(self._process)

    def wait(self, timeout_s: float | None = None) -> JobStatus:
        """Wait for its end and return how it ended."""
        self._process.wait(timeout_s)
        return self.poll()

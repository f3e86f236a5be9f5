# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts as child processes of a Dask cluster: the engine for several processes or computers."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from ... import limits
from ...farm.dask import DaskTasks, request_of
from ...parallel import default_threads
from ...settings import JobSettings
from ...settings.job import LOCAL
from ...worker.helper_process import child_command
from .graph import Part
from .runner import Outcome

MODULE = "jobs.part_process"


class FarmEngine:
    """Runs each part by ``run-part`` on a Dask cluster.

    ``root``: the job folder, which all computers see; ``settings``: ``computers``, ``processes``,
    ``certificates``, ``threads`` and ``device`` are read.
    Raises MissingExtraError, UsageError, WorkerError: as :class:`~.dask.DaskTasks`.
    """

    trusts_states = True

    def __init__(self, root: Path, settings: JobSettings) -> None:
        self._root = root
        self._settings = settings
        self._is_local = settings.computers == LOCAL
        self._tasks = DaskTasks(settings.computers, settings.processes, settings.certificates)
        self._parts: dict[str, Part] = {}
        self._begun_s = time.time()

    @property
    def slots(self) -> int:
        """Parts that run at a time."""
        return self._tasks.slots

    def start(self, part: Part, plan: str, attempt: int) -> None:
        """Submit a part."""
        arguments: dict[str, Any] = {
            "part": part.name, "threads": self._threads(part), "device": self._settings.device,
            "attempt": attempt, "driven": True,
        }  # fmt: skip
        command = None
        if self._is_local:
            command = child_command(MODULE)[:-1]
        self._parts[part.name] = part
        # The same part of another walk is another task: what it left is not known to Dask.
        key = f"{part.name}-{plan}-{attempt}-{int(self._begun_s * 1000):x}"
        self._tasks.submit(part.name, key, request_of(self._root, MODULE, arguments, command))

    def _threads(self, part: Part) -> int:
        """Return the threads of a part: all there are, or a share where others run beside it."""
        if self._settings.threads or not self._is_local or not part.is_one_of_many:
            return self._settings.threads
        return max(1, default_threads() // self._settings.processes)

    def wait(self, seconds: float) -> list[Outcome]:
        """Return what has ended."""
        return [
            Outcome(self._parts.pop(e.name), e.code, error=e.error, hint=e.hint, place=e.host)
            for e in self._tasks.ended(seconds)
        ]

    def close(self, *, cancelled: bool) -> None:
        """End all parts: they see the cancel file, or that nobody holds the folder."""
        self._tasks.close(limits.CANCEL_ALONE_S if cancelled else 0.0)

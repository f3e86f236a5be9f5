# SPDX-License-Identifier: GPL-3.0-or-later
"""A Flamenco Manager: what it says of itself, of jobs and of tasks, and what it is asked to do."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from typing import Any
from uuid import UUID

from ...errors import FarmError, UsageError
from ..address import Address
from .exchange import NotFoundError, ask, ask_json, shown

JOB_TYPE = "gaussian-wrapping"
"""The name that a Manager gives to the script ``gaussian-wrapping.js``."""
SCRIPT_VERSION = 1
"""Of that script; a test compares them."""
OLDEST = (3, 3)
"""Has the command ``exec``, tags of workers, and jobs of more than 1000 tasks."""

SUBMIT_S = 120.0
"""The Manager writes all tasks into its database before it answers."""
MAX_TASKS = 20_000
MAX_LOG_LINES = 12
MAX_LINE_CHARACTERS = 300

UNFINISHED = ("active", "queued", "requeueing", "under-construction", "cancel-requested", "paused")
"""States of a job that is still to do something."""

_PLATFORMS = {"win32": "windows", "darwin": "darwin"}
_INSTALL = (
    "Put gaussian-wrapping.js (batch.py farm job-type FOLDER) into the folder scripts beside "
    "flamenco-manager, and restart it."
)


def platform() -> str:
    """Return the name that Flamenco has for this computer's system."""
    return _PLATFORMS.get(sys.platform, "linux" if sys.platform.startswith("linux") else "unknown")


@dataclass(frozen=True)
class Task:
    """One task of a job: one part."""

    id: str
    name: str
    status: str


@dataclass(frozen=True)
class Manager:
    """The HTTP interface of a Manager. All methods raise :class:`~...errors.FarmError`."""

    address: Address

    def version(self) -> str:
        """Return its version.

        Raises
        ------
        FarmError
            Too old, or of a later interface.
        """
        values = ask_json(self.address, "GET", "/api/v3/version")
        text = shown(values.get("shortversion") or values.get("version"))
        numbers = re.match(r"(\d{1,4})\.(\d{1,4})", text)
        if numbers is None:
            raise FarmError(
                f"{self.address} gives no version of Flamenco.",
                "Check the address; another server may have answered.",
            )
        found = (int(numbers[1]), int(numbers[2]))
        if found < OLDEST or found[0] > OLDEST[0]:
            raise FarmError(
                f"{self.address} is Flamenco {text}; 3.3 or a later 3 is needed.",
                "Install another version of Flamenco.",
            )
        return text

    def job_type_etag(self) -> str:
        """Return the mark of the installed job type, which a submission has to repeat.

        Raises
        ------
        FarmError
            The job type is not installed, or of another version.
        """
        try:
            values = ask_json(self.address, "GET", f"/api/v3/jobs/type/{JOB_TYPE}")
        except NotFoundError:
            raise FarmError(
                f"The Manager at {self.address} has no job type {JOB_TYPE}.", _INSTALL
            ) from None
        settings = values.get("settings")
        version = next(
            (
                entry.get("default")
                for entry in (settings if isinstance(settings, list) else ())
                if isinstance(entry, dict) and entry.get("key") == "script_version"
            ),
            None,
        )
        etag = values.get("etag")
        if version != SCRIPT_VERSION or not isinstance(etag, str):
            raise FarmError(
                f"The job type {JOB_TYPE} at {self.address} is of another version of the add-on.",
                _INSTALL,
            )
        return etag

    def variables(self, audience: str) -> dict[str, str]:
        """Return the values of the Manager's variables on this computer's system.

        Parameters
        ----------
        audience : str
            ``"users"`` or ``"workers"``.
        """
        path = f"/api/v3/configuration/variables/{audience}/{platform()}"
        found = {}
        for name, entry in ask_json(self.address, "GET", path).items():
            value = entry.get("value") if isinstance(entry, dict) else None
            if isinstance(value, str) and value:
                found[name] = value
        return found

    def tag_id(self, name: str) -> str:
        """Return the id of a tag of workers.

        Raises
        ------
        UsageError
            There is no such tag; lists those that there are.
        """
        values = ask_json(self.address, "GET", "/api/v3/worker-mgt/tags").get("tags")
        tags = [
            tag for tag in (values if isinstance(values, list) else ()) if isinstance(tag, dict)
        ]
        for tag in tags:
            if tag.get("name") == name:
                return _uuid(self.address, tag.get("id"))
        known = ", ".join(shown(tag.get("name")) for tag in tags[:10])
        hint = f"It has: {known}." if known else "It has none: create it in Flamenco's web page."
        raise UsageError(f"The Manager at {self.address} has no tag {name!r}.", hint)

    def submit(self, body: dict[str, Any]) -> str:
        """Submit a job; return its id."""
        values = ask_json(self.address, "POST", "/api/v3/jobs", body, deadline_s=SUBMIT_S)
        return _uuid(self.address, values.get("id"))

    def job_status(self, job: str) -> str:
        """Return the state of a job.

        Raises
        ------
        NotFoundError
            The Manager does not have it any more.
        """
        status = shown(ask_json(self.address, "GET", f"/api/v3/jobs/{job}").get("status"))
        if not status:
            raise FarmError(f"{self.address} gives no state of job {job}.", "Look at its web page.")
        return status

    def tasks(self, job: str) -> list[Task]:
        """Return the tasks of a job."""
        values = ask_json(self.address, "GET", f"/api/v3/jobs/{job}/tasks").get("tasks")
        found = []
        for entry in (values if isinstance(values, list) else [])[:MAX_TASKS]:
            if isinstance(entry, dict):
                number = _uuid(self.address, entry.get("id"))
                found.append(Task(number, shown(entry.get("name")), shown(entry.get("status"))))
        return found

    def worker_of(self, task: str) -> str:
        """Return the name of the worker that a task was last given to; empty for none."""
        values = ask_json(self.address, "GET", f"/api/v3/tasks/{task}")
        worker = values.get("worker")
        return shown(worker.get("name")) if isinstance(worker, dict) else ""

    def last_lines(self, task: str) -> tuple[str, ...]:
        """Return the last lines of a task's log."""
        data = ask(self.address, "GET", f"/api/v3/tasks/{task}/logtail").data
        lines = data.decode(errors="replace").splitlines()
        clean = [shown(line)[:MAX_LINE_CHARACTERS] for line in lines[-4 * MAX_LOG_LINES :]]
        return tuple(line for line in clean if line)[-MAX_LOG_LINES:]

    def cancel(self, job: str) -> None:
        """Cancel a job: workers end what they are running of it."""
        self._set_status(job, "cancel-requested", "cancelled in Gaussian Wrapping")

    def requeue(self, job: str) -> None:
        """Let all tasks of a job run again that are not completed."""
        self._set_status(job, "requeueing", "tried again in Gaussian Wrapping")

    def _set_status(self, job: str, status: str, reason: str) -> None:
        path = f"/api/v3/jobs/{job}/setstatus"
        ask(self.address, "POST", path, {"status": status, "reason": reason})


def _uuid(address: Address, text: Any) -> str:
    """Return an id that may be put into a path."""
    try:
        return str(UUID(text if isinstance(text, str) else ""))
    except ValueError:
        raise FarmError(
            f"{address} answers without an id.",
            "Check its version: batch.py farm submit needs 3.3.",
        ) from None

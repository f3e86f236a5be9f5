# SPDX-License-Identifier: GPL-3.0-or-later
"""Distribute tasks over processes by claim files in a shared folder, without a server.

A claim is a file that only one process can create; its modification time is refreshed while the
process works. A claim is taken over when its process has ended (same machine) or has stopped
refreshing it (another machine). When one resumes after a long sleep, a task is done twice. That
only costs time: both compute the same result, and results are written atomically.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import platform
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import ParseError
from ...files import read_json
from ...processes.process_identity import owner_alive, process_start_ticks
from ...progress import Progress

_logger = logging.getLogger(__name__)

REFRESH_S = 5.0
STALE_S = 60.0
"""A claim of another machine that was not refreshed for this long is stale. Measured by the local
clock since the claim was first seen, as clocks of machines differ."""
POLL_S = 1.0

_WORKER = "worker"
"""Suffix of an empty file for each process that has completed a task."""


@dataclass(frozen=True)
class Task:
    """A unit of work."""

    name: str
    """Name of its claim file."""
    done: Callable[[], bool]
    ready: Callable[[], bool]
    """Whether its inputs exist."""
    run: Callable[[Progress], None]


class Claims:
    """The claims in one folder."""

    def __init__(self, folder: Path, stale_s: float = STALE_S) -> None:
        self._folder = folder
        self._stale_s = stale_s
        self._seen: dict[str, tuple[Any, float]] = {}
        self._worker = uuid.uuid4().hex
        folder.mkdir(exist_ok=True)

    def path(self, name: str) -> Path:
        """Return the file of a claim."""
        return self._folder / f"{name}.json"

    def record_worker(self) -> None:
        """Record that this process has completed a task."""
        (self._folder / f"{self._worker}.{_WORKER}").touch()

    def worker_count(self) -> int:
        """Count the processes that have completed a task; a restarted process counts again."""
        return sum(1 for _ in self._folder.glob(f"*.{_WORKER}"))

    @contextmanager
    def held(self, name: str) -> Iterator[bool]:
        """Hold a claim during a ``with`` block; yields false if another process holds it."""
        if not (self._create(name) or (self._drop_stale(name) and self._create(name))):
            yield False
            return
        ended = threading.Event()
        beat = threading.Thread(target=self._refresh, args=(name, ended), daemon=True)
        beat.start()
        try:
            yield True
        finally:
            ended.set()
            beat.join()
            self.path(name).unlink(missing_ok=True)

    def _create(self, name: str) -> bool:
        try:
            number = os.open(self.path(name), os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:
            return False
        owner = {
            "place": host_and_pid_namespace(),
            "pid": os.getpid(),
            "started": process_start_ticks(os.getpid()),
            "token": uuid.uuid4().hex,
        }
        with os.fdopen(number, "w") as stream:
            json.dump(owner, stream)
        return True

    def _refresh(self, name: str, ended: threading.Event) -> None:
        while not ended.wait(REFRESH_S):
            try:
                os.utime(self.path(name))
            except OSError:
                _logger.warning("the claim on %s has disappeared", name)
                return

    def _drop_stale(self, name: str) -> bool:
        """Remove the claim of a dead process; return false if its owner seems alive."""
        path = self.path(name)
        try:
            time_ns = path.stat().st_mtime_ns
        except FileNotFoundError:
            return True  # released just now
        owner = self._owner(path)
        here = owner.get("place") == host_and_pid_namespace()
        if here and owner_alive(int(owner["pid"]), int(owner["started"])):
            return False
        state = (owner.get("token"), time_ns)
        known, since_s = self._seen.get(name, (None, 0.0))
        if known != state:
            self._seen[name] = (state, time.monotonic())
            since_s = time.monotonic()
        if not here and time.monotonic() - since_s < self._stale_s:
            return False
        _logger.warning("taking over %s from process %s", name, owner.get("pid", "unknown"))
        aside = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.stale")
        try:
            os.rename(path, aside)  # only one of several processes succeeds
        except FileNotFoundError:
            return False
        fresh = self._owner(aside).get("token") != owner.get("token")
        if fresh:  # another process took over between the look and the rename
            with contextlib.suppress(OSError):
                os.link(aside, path)
        aside.unlink(missing_ok=True)
        return not fresh

    @staticmethod
    def _owner(path: Path) -> dict[str, Any]:
        """Return the content of a claim; empty while it is being written or if it is cut off."""
        try:
            values = read_json(path)
            return {**values, "pid": int(values["pid"]), "started": int(values["started"])}
        except (OSError, ParseError, KeyError, TypeError, ValueError):
            return {}


def host_and_pid_namespace() -> str:
    """Return a text that is equal only for processes that see each other's process ids."""
    parts = [platform.node()]
    for read in (
        lambda: Path("/proc/sys/kernel/random/boot_id").read_text().strip(),
        lambda: os.readlink("/proc/self/ns/pid"),
    ):
        try:
            parts.append(read())
        except (OSError, AttributeError):
            continue  # outside Linux: the host name alone
    return " ".join(parts)


def run_tasks(
    tasks: Sequence[Task],
    claims: Claims,
    progress: Progress,
    poll_s: float = POLL_S,
    done_here: list[str] | None = None,
) -> int:
    """Run unclaimed tasks until all are done; return how many this process completed.

    Waits while other processes hold the remaining tasks, and takes over stale claims.

    Parameters
    ----------
    done_here : list of str, optional
        Receives the names of the tasks completed here, also if the call ends with an error.

    Raises
    ------
    WrapError
        A task failed here, or a stop was requested.
    """
    completed = [] if done_here is None else done_here
    while True:
        unfinished = [task for task in tasks if not task.done()]
        finished = len(tasks) - len(unfinished)
        progress.update(finished / max(len(tasks), 1), f"{finished} of {len(tasks)} parts")
        if not unfinished:
            return len(completed)
        worked = False
        for task in unfinished:
            if not task.ready():
                continue
            with claims.held(task.name) as free:
                if not free or task.done():  # done before the claim was taken
                    continue
                task.run(progress.span(finished / len(tasks), (finished + 1) / len(tasks)))
                completed.append(task.name)
                claims.record_worker()
                worked = True
                break
        if not worked:
            time.sleep(poll_s)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Claims on pieces of work in a shared folder: who does what, without a server.

A claim is a file that only one process can create. Its time is refreshed while the process works.
Of a process that has ended on this machine, or that has not refreshed it for a while on another
one, the claim is taken over. Where two take over at once, or a process comes back from a long
sleep, a piece is done twice; that costs time and nothing else, as both get the same result and
results appear whole.
"""

from __future__ import annotations

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
from ...progress import Progress
from .job_folder import process_alive, process_start_ticks

_logger = logging.getLogger(__name__)

REFRESH_S = 5.0
STALE_S = 60.0
"""A claim of another machine that was not refreshed for so long is dead. Measured by the own clock
from the first look, as clocks of machines differ."""
POLL_S = 1.0

_WORKER = "worker"
"""Ending of an empty file for each process that has done a part."""


@dataclass(frozen=True)
class Task:
    """A piece of work."""

    name: str
    """Of its claim's file."""
    done: Callable[[], bool]
    ready: Callable[[], bool]
    """Whether what it needs is there."""
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
        """Say that this process has done a part."""
        (self._folder / f"{self._worker}.{_WORKER}").touch()

    def worker_count(self) -> int:
        """Return how many processes have done a part; one that was started anew counts again."""
        return sum(1 for _ in self._folder.glob(f"*.{_WORKER}"))

    @contextmanager
    def held(self, name: str) -> Iterator[bool]:
        """Hold a claim for the duration of a block; false where another process has it."""
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
                _logger.warning("the claim on %s has gone", name)
                return

    def _drop_stale(self, name: str) -> bool:
        """Remove a dead process's claim; false where its owner seems alive."""
        path = self.path(name)
        try:
            time_ns = path.stat().st_mtime_ns
        except FileNotFoundError:
            return True  # given back just now
        owner = self._owner(path)
        here = owner.get("place") == host_and_pid_namespace()
        if here and process_alive(int(owner["pid"]), int(owner["started"])):
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
            os.rename(path, aside)  # of several only one succeeds
        except FileNotFoundError:
            return False
        aside.unlink(missing_ok=True)
        return True

    @staticmethod
    def _owner(path: Path) -> dict[str, Any]:
        """Return what a claim says; nothing where it is being written, or was broken off."""
        try:
            values = read_json(path)
            return {**values, "pid": int(values["pid"]), "started": int(values["started"])}
        except (OSError, ParseError, KeyError, TypeError, ValueError):
            return {}


def host_and_pid_namespace() -> str:
    """Return a text that processes share only where they know each other's process ids."""
    parts = [platform.node()]
    for read in (
        lambda: Path("/proc/sys/kernel/random/boot_id").read_text().strip(),
        lambda: os.readlink("/proc/self/ns/pid"),
    ):
        try:
            parts.append(read())
        except (OSError, AttributeError):
            continue  # the name alone, where the system is not Linux
    return " ".join(parts)


def run_tasks(
    tasks: Sequence[Task],
    claims: Claims,
    progress: Progress,
    poll_s: float = POLL_S,
    done_here: list[str] | None = None,
) -> int:
    """Do what nobody else does until all tasks are done; return how many this process did.

    Waits where the rest is in other hands, and takes over what they drop.

    Parameters
    ----------
    done_here : list of str, optional
        Gets the names of what this process has done, also where it ends with an error.

    Raises
    ------
    WrapError
        Of a task that failed here, or the request to stop.
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
                if not free or task.done():  # done between our look and our claim
                    continue
                task.run(progress.span(finished / len(tasks), (finished + 1) / len(tasks)))
                completed.append(task.name)
                claims.record_worker()
                worked = True
                break
        if not worked:
            time.sleep(poll_s)

# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``queue`` command: many jobs, one after another or side by side on a Dask cluster.

Each job is a process of its own that can be killed and begun again: it goes on from what it has
finished. Lines are in the protocol of :mod:`.run_in_worker`.
"""

from __future__ import annotations

import json
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from .. import limits
from ..errors import (
    EXIT_CANCELLED,
    EXIT_DONE,
    EXIT_OTHER,
    EXIT_RESOURCES,
    Cancelled,
    ParseError,
    WrapError,
)
from ..evaluation.report.figures import measured, part
from ..farm.dask import DaskTasks, Ended, request_of
from ..files import read_json, touch_regular, write_json
from ..settings.job import LOCAL
from ..worker.helper_process import child_command, emit
from ..worker.spawn import Caller, end_with_parent
from . import worker
from .client import JobClient
from .parts import graph as parts
from .store.job_file import read_job
from .store.job_folder import JobFolder
from .worker import failure_of

MODULE = "jobs.queue_process"
TABLE_NAME = "queue.json"
MOST_ATTEMPTS = 3
POLL_S = 0.5
SHOW_LIFE_S = 5.0
HELD_S = limits.SILENT_S + 30.0
"""How long a job that another process holds is waited for: one that a killed queue has left ends
within seconds here, and on another computer counts as ended after :data:`limits.SILENT_S`."""
_CODES = {
    EXIT_DONE: parts.DONE, EXIT_RESOURCES: parts.MAY_WORK_ELSEWHERE,
    EXIT_CANCELLED: parts.CANCELLED,
}  # fmt: skip
"""What the exit codes of a job mean to who may begin it again; others: never."""


def main(arguments: list[str]) -> int:
    """Run the queue of ``arguments = [{"out", "jobs", "computers", ...} as JSON]``.

    With ``{"out", "job", "code"}``, what a Dask worker calls, run that one job; the exit code is
    then one of :mod:`.graph`.
    """
    request = json.loads(arguments[0])
    folder = JobFolder(Path(request["out"]))
    try:
        if "job" in request:
            end_with_parent()
            return _run_job(JobFolder(folder.root / request["job"]), str(request["code"]))
        folder.lock()
        try:
            return _Queue(folder, [str(name) for name in request["jobs"]], request).run()
        finally:
            folder.unlock()
    except (WrapError, OSError) as error:  # such as a disk without room for the table
        failure = failure_of(error, folder.root)
        if not failure.is_known:
            raise
        emit(error=failure.error, hint=failure.hint)
        return _CODES.get(failure.code, parts.NEVER) if "job" in request else failure.code


def _run_job(folder: JobFolder, code: str) -> int:
    if code != (version := parts.code_version()):
        emit(
            error=f"This computer has version {version} of the program, the queue {code}.",
            hint="Install the same version on all computers.",
        )
        return parts.OTHER_CODE
    caller = Caller()
    if not _is_free(folder, lambda: caller.ended() or folder.cancel_path.exists()):
        emit(
            error=f"Another process is working in {folder.root}.",
            hint="Wait for it, or cancel it; then give the same command again.",
        )
        return parts.MAY_WORK_ELSEWHERE
    if _is_done(folder):  # by a worker whose computer was lost before it could say so
        return parts.DONE
    ended = _CODES.get(worker.main([str(folder.root), "1"]), parts.NEVER)
    status = folder.read_status()
    if ended != parts.DONE and status.error:
        emit(error=status.error, hint=status.hint)
    return ended


def _is_free(folder: JobFolder, is_stopped: Callable[[], bool]) -> bool:
    """Wait, not for ever, until nobody holds a job; return whether that is so."""
    until_s = time.monotonic() + HELD_S
    while folder.locked():
        if is_stopped() or time.monotonic() > until_s:
            return False
        time.sleep(POLL_S)
    return True


def _is_done(folder: JobFolder) -> bool:
    """Return whether the job that stands in a folder, not an earlier one, is done."""
    if folder.read_status().state != "DONE" or not folder.result.is_dir():
        return False
    try:
        return parts.read_parts(folder.root).plan == parts.plan_hash(read_job(folder.job_path))
    except WrapError:
        return False


@dataclass
class _Queue:
    """The jobs of a folder, which this process holds."""

    home: JobFolder
    names: list[str]
    request: dict[str, Any]
    stopped: bool = False
    codes: dict[str, int] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)
    _shown_s: float = field(default_factory=time.monotonic)

    def run(self) -> int:
        """Run all jobs; return the exit code of the first that failed, 0 if none."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._stop)
        self._caller = Caller()
        left = [name for name in self.names if not _is_done(self._folder(name))]
        for name in self.names:
            if name not in left:
                self.codes[name] = EXIT_DONE
                emit(line=f"{name}: was done before")
        try:
            ended = self._on_cluster(left) if self.request["computers"] else self._in_turn(left)
            for name, code, error in ended:
                self.codes[name], self.errors[name] = code, error
                told = "done" if code == EXIT_DONE else f"failed: {error}"
                emit(line=f"{name}: {told} ({len(self.codes)} of {len(self.names)})")
        finally:
            self._tell()
        if self.stopped:
            return EXIT_CANCELLED
        return next((code for code in self.codes.values() if code != EXIT_DONE), EXIT_DONE)

    def _stop(self, _number: int, _frame: FrameType | None) -> None:
        self.stopped = True

    def _is_stopped(self) -> bool:
        """Return whether to stop; called all the time, it shows that the queue lives."""
        if time.monotonic() - self._shown_s > SHOW_LIFE_S:
            self._shown_s = time.monotonic()
            self.home.show_life()
        self.stopped = self.stopped or self._caller.ended()
        return self.stopped

    def _folder(self, name: str) -> JobFolder:
        return JobFolder(self.home.root / name)

    def _in_turn(self, names: list[str]) -> Iterator[tuple[str, int, str]]:
        for name in names:
            _is_free(self._folder(name), self._is_stopped)
            if self.stopped:
                return
            try:
                client = JobClient.resume(self._folder(name).root)
            except WrapError as error:
                yield name, error.exit_code, str(error)
                continue
            while (status := client.poll()).active:
                if self._is_stopped():
                    client.cancel()
                time.sleep(POLL_S)
            if self.stopped:
                return
            code = EXIT_DONE if status.state == "DONE" else (status.exit_code or 1)
            yield name, code, f"{status.error} {status.hint}".strip()

    def _on_cluster(self, names: list[str]) -> Iterator[tuple[str, int, str]]:
        computers = str(self.request["computers"])
        tasks = DaskTasks(
            computers, int(self.request["processes"]), str(self.request["certificates"])
        )
        command = child_command(MODULE)[:-1] if computers == LOCAL else None
        attempts = dict.fromkeys(names, 0)
        waiting, running = deque(names), set[str]()
        begun = f"{time.time_ns():x}"

        def submit(name: str) -> None:
            attempts[name] += 1
            running.add(name)
            self._folder(name).cancel_path.unlink(missing_ok=True)
            arguments = {"job": name, "code": parts.code_version()}
            request = request_of(self.home.root, MODULE, arguments, command)
            tasks.submit(name, f"job-{name}-{begun}-{attempts[name]}", request)

        try:
            while waiting or running:
                if self._is_stopped():
                    for name in running:
                        touch_regular(self._folder(name).cancel_path)
                    return
                while waiting and len(running) < tasks.slots:
                    submit(waiting.popleft())
                for end in tasks.ended(POLL_S):
                    running.discard(end.name)
                    if _may_work(end) and attempts[end.name] < MOST_ATTEMPTS:
                        waiting.append(end.name)
                        continue
                    yield end.name, self._exit_code(end), f"{end.error} {end.hint}".strip()
        except Cancelled:
            self.stopped = True
        finally:
            tasks.close(limits.CANCEL_ALONE_S if self.stopped else 0.0)

    def _exit_code(self, end: Ended) -> int:
        """Return the exit code of a job for people, from how its process ended."""
        if end.code == parts.DONE:
            return EXIT_DONE
        status = self._folder(end.name).read_status()
        if status.state == "FAILED" and status.exit_code and end.code != parts.OTHER_CODE:
            return status.exit_code
        return EXIT_RESOURCES if _may_work(end) else EXIT_OTHER

    def _tell(self) -> None:
        """Write the table of results, and say it."""
        rows = [self._row(name) for name in self.names]
        write_json(self.home.root / TABLE_NAME, {"version": 1, "jobs": rows})
        emit(line=f"{'job':24} {'state':8} {'s':>7} {'held out dB':>11} {'faces':>9}")
        for row in rows:
            held_out = "" if row["psnr"] is None else f"{row['psnr']:.2f}"
            faces = "" if row["faces"] is None else str(row["faces"])
            seconds = "" if row["seconds"] is None else f"{row['seconds']:.0f}"
            line = f"{row['name']:24} {row['state']:8} {seconds:>7} {held_out:>11} {faces:>9}"
            emit(line=f"{line} {row['error']}".rstrip())

    def _row(self, name: str) -> dict[str, Any]:
        folder = self._folder(name)
        status = folder.read_status()
        try:
            report = read_json(folder.result / "report.json")
        except (OSError, ParseError):
            report = {}
        report = report if isinstance(report, dict) else {}
        faces = [
            measured(part(region, "statistics").get("faces"))
            for region in part(report, "regions").values()
        ]
        return {
            "name": name,
            "state": status.state.lower(),
            "seconds": measured(report.get("wall_seconds")),
            "psnr": measured(part(report, "training").get("held_out_psnr")),
            "faces": int(sum(count or 0 for count in faces)) if faces else None,
            "error": self.errors.get(name, "") if status.state != "DONE" else "",
        }


def _may_work(end: Ended) -> bool:
    """Return whether a job that did not end well may work elsewhere, or if begun again."""
    return end.code < 0 or end.code in (parts.MAY_WORK_ELSEWHERE, parts.OTHER_CODE, parts.CANCELLED)

# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``queue`` command: many jobs, one after another or side by side on a Dask cluster.

Runs in the worker's Python; writes one JSON object per line, in the protocol of
:mod:`.commands.run_in_worker`. Each job is a process of its own that can be killed and begun again:
it goes on from what it has finished.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from .. import limits
from ..cluster.dask_tasks import DaskTasks, request_of
from ..errors import EXIT_CANCELLED, EXIT_DONE, EXIT_RESOURCES, Cancelled, ParseError, WrapError
from ..evaluation.report.text import measured, part
from ..files import read_json, write_json
from ..processes.helper_process import child_command, emit
from ..processes.process_identity import Caller
from ..regular_files import touch_regular
from ..settings.farm import LOCAL
from . import worker
from .client import JobClient
from .store.job_folder import JobFolder

MODULE = "jobs.queue_process"
TABLE_NAME = "queue.json"
MOST_ATTEMPTS = 3
POLL_S = 0.5


def main(arguments: list[str]) -> int:
    """Run the queue of ``arguments = [{"out", "jobs", "computers", ...} as JSON]``.

    With ``{"out", "job"}``, what a Dask worker calls, run that one job.
    """
    request = json.loads(arguments[0])
    if "job" in request:
        return worker.main([str(Path(request["out"]) / request["job"]), "1"])
    try:
        return _Queue(Path(request["out"]), [str(name) for name in request["jobs"]], request).run()
    except WrapError as error:
        emit(error=error.message, hint=error.hint)
        return error.exit_code


@dataclass
class _Queue:
    """The jobs of a folder."""

    root: Path
    names: list[str]
    request: dict[str, Any]
    stopped: bool = False
    codes: dict[str, int] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)

    def run(self) -> int:
        """Run all jobs; return the exit code of the first that failed, 0 if none."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._stop)
        self._caller = Caller()
        left = [name for name in self.names if not self._is_done(name)]
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
        self.stopped = self.stopped or self._caller.ended()
        return self.stopped

    def _folder(self, name: str) -> JobFolder:
        return JobFolder(self.root / name)

    def _is_done(self, name: str) -> bool:
        folder = self._folder(name)
        return folder.read_status().state == "DONE" and folder.result.is_dir()

    def _in_turn(self, names: list[str]) -> Iterator[tuple[str, int, str]]:
        for name in names:
            client = JobClient.resume(self.root / name)
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
        begun = f"{time.time_ns():x}"

        def submit(name: str) -> None:
            attempts[name] += 1
            self._folder(name).cancel_path.unlink(missing_ok=True)
            request = request_of(self.root, MODULE, {"job": name}, command)
            tasks.submit(name, f"job-{name}-{begun}-{attempts[name]}", request)

        try:
            for name in names:
                submit(name)
            while attempts:
                if self._is_stopped():
                    for name in attempts:
                        touch_regular(self._folder(name).cancel_path)
                    return
                for end in tasks.ended(POLL_S):
                    again = end.code < 0 or end.code in (EXIT_RESOURCES, EXIT_CANCELLED)
                    if again and attempts[end.name] < MOST_ATTEMPTS:
                        submit(end.name)
                        continue
                    del attempts[end.name]
                    status = self._folder(end.name).read_status()
                    failed = status.error or end.error
                    yield end.name, end.code, f"{failed} {status.hint}".strip()
        except Cancelled:
            self.stopped = True
        finally:
            tasks.close(limits.CANCEL_ALONE_S if self.stopped else 0.0)

    def _tell(self) -> None:
        """Write the table of results, and say it."""
        rows = [self._row(name) for name in self.names]
        write_json(self.root / TABLE_NAME, {"version": 1, "jobs": rows})
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

# SPDX-License-Identifier: GPL-3.0-or-later
"""A scheduler and its workers by SSH."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import queue
import signal
import subprocess
import threading
import time
from collections.abc import AsyncIterator, Iterator
from types import FrameType
from typing import IO, TYPE_CHECKING

from ...errors import FarmError, UsageError
from ...farm.addresses import Address, scheduler_address
from ...farm.dask import HTTP, security_of
from ...farm.hosts import Host, ssh_command
from ...worker.environment import load_extra
from ...worker.helper_process import emit
from ...worker.spawn import kill_group, spawn
from .farm_findings import short
from .farm_worker import WORKS_FOR
from .run_in_worker import run_command

if TYPE_CHECKING:
    from distributed import Scheduler


# -- A Dask scheduler in this process, its workers told as they come and go, and an orderly end

END_S = 10.0
"""Longest time in which others are told that this process ends."""
POLL_S = 0.5
_CLOSE_S = 2.0


class Ending:
    """Whether this process is to end, by a signal or with its caller; used with ``with``."""

    def __init__(self) -> None:
        self._asked = threading.Event()
        self._left = threading.Event()

    @property
    def is_asked(self) -> bool:
        """Whether to end."""
        return self._asked.is_set()

    def leave(self) -> None:
        """Ask to end, from another thread, and wait until that is done."""
        self._asked.set()
        self._left.wait(END_S)

    def __enter__(self) -> Ending:
        def ask(_number: int, _frame: FrameType | None) -> None:
            self._asked.set()

        self._before = signal.signal(signal.SIGTERM, ask)
        return self

    def __exit__(self, *_error: object) -> None:
        signal.signal(signal.SIGTERM, self._before)
        self._left.set()


@contextlib.asynccontextmanager
async def serving(address: Address, certificates: str) -> AsyncIterator[Scheduler]:
    """Run a scheduler that listens at an address, and tell which workers come and go.

    Raises UsageError: it cannot listen there, or certificates are missing.
    """
    from distributed import Scheduler

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    security = security_of(str(address), certificates)
    try:
        scheduler = await Scheduler(
            host=str(address), security=security, dashboard=False, dashboard_address=HTTP
        )
    except OSError as error:
        raise UsageError(
            f"The scheduler cannot listen at {address}: {error.strerror or error}.",
            "Give an address of this computer and a free port.",
        ) from None
    telling = asyncio.create_task(_tell_workers(scheduler))
    try:
        yield scheduler
    finally:
        telling.cancel()
        with contextlib.suppress(Exception):  # what does not close ends with this process
            await asyncio.wait_for(scheduler.close(), _CLOSE_S)


async def _tell_workers(scheduler: Scheduler) -> None:
    known: dict[str, str] = {}
    while True:
        now = {address: str(state.host) for address, state in scheduler.workers.items()}
        for there, word in ((now, "has joined"), (known, "has left")):
            other = known if there is now else now
            for address in sorted(set(there) - set(other)):
                emit(line=f"{address.partition('://')[2]} {word} (workers: {len(now)})")
        known = now
        await asyncio.sleep(POLL_S)


# -- The ``farm ssh`` command: a scheduler here, and a worker on each of a list of computers ------
#
# A worker ends with its connection: it reads its input, which ends with this process, however that
# ends.

_END_S = 5.0
_MAX_LINE_BYTES = 4000


class Connection:
    """A worker on another computer, by a process of ``ssh`` that lives as long."""

    def __init__(self, host: Host, address: str, start_s: float) -> None:
        self.name = host.name
        self._process = spawn(
            ssh_command(host, address), stdin=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._start_s, self._until_s = start_s, time.monotonic() + start_s
        self._works = False
        self._last = ""
        self.has_ended = False
        assert self._process.stdout is not None
        self._reader = threading.Thread(target=self._read, args=(self._process.stdout,))
        self._reader.daemon = True
        self._reader.start()

    def _read(self, stream: IO[bytes]) -> None:
        while raw := stream.readline(_MAX_LINE_BYTES):
            self._lines.put(short(raw.decode(errors="replace")))

    def news(self) -> Iterator[dict[str, str]]:
        """Yield what its worker has said, and once if it has ended or does not begin."""
        if self.has_ended:
            return
        code = self._process.poll()
        if code is not None:
            self._reader.join(POLL_S)
        while not self._lines.empty():
            line = self._lines.get()
            self._works = self._works or line.startswith(WORKS_FOR)
            self._last = line or self._last
            if self._works:
                yield {"line": f"{self.name}: {line}"}
        if code is not None:
            self.has_ended = True
            said = self._last.rstrip(".") or "it said nothing"
            yield _warning(f"{self.name} has ended with code {code}: {said}. "
                           f"Try: ssh {self.name} true")  # fmt: skip
        elif not self._works and time.monotonic() > self._until_s:
            self.has_ended = True
            self.end_input()
            kill_group(self._process)
            yield _warning(f"{self.name} does not work {self._start_s:.0f} s after it was called. "
                           f"Try: ssh {self.name} true")  # fmt: skip

    def end_input(self) -> None:
        """Let the worker there end."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()

    def end(self, until_s: float) -> None:
        """Wait for the end until a time of the monotonic clock, then end ``ssh``."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(max(0.0, until_s - time.monotonic()))
        kill_group(self._process)


def main(arguments: list[str]) -> int:
    """Run for ``arguments = [{"address", "certificates", "hosts", "start_s"} as JSON]``."""
    ending = Ending()

    def work() -> Iterator[str]:
        request = json.loads(arguments[0])
        address = scheduler_address(str(request["address"]))
        hosts = [Host(**values) for values in request["hosts"]]
        load_extra("farm", "A farm by SSH")
        asyncio.run(
            _run(address, str(request["certificates"]), hosts, float(request["start_s"]), ending)
        )
        yield "all computers were told to end"

    with ending:
        return run_command(work, leave=ending.leave)


async def _run(
    address: Address, certificates: str, hosts: list[Host], start_s: float, ending: Ending
) -> None:
    async with serving(address.listening(), certificates):
        emit(line=f"the scheduler listens for {address}; end all with Ctrl-C")
        connections: list[Connection] = []
        try:
            for host in hosts:
                connections.append(Connection(host, str(address), start_s))
            while not ending.is_asked:
                for news in await asyncio.to_thread(
                    lambda: [n for c in connections for n in c.news()]
                ):
                    emit(**news)
                if all(connection.has_ended for connection in connections):
                    raise FarmError(
                        "None of the computers works any more.", "See the lines above, of each."
                    )
                await asyncio.sleep(POLL_S)
        finally:
            await asyncio.to_thread(_end, connections)


def _end(connections: list[Connection]) -> None:
    for connection in connections:
        connection.end_input()
    until_s = time.monotonic() + _END_S
    for connection in connections:
        connection.end(until_s)


def _warning(text: str) -> dict[str, str]:
    return {"warning": text, "code": "computer-lost"}

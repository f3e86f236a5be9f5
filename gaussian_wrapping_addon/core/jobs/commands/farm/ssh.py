# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``farm ssh`` command: a scheduler here, and a worker on each of a list of computers.

Runs in the worker's Python; writes one JSON object per line, in the protocol of commands. A worker
ends with its connection: it reads its input, which ends with this process, however that ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import queue
import subprocess
import threading
import time
from collections.abc import Iterator
from typing import IO

from ....cluster.addresses import Address, scheduler_address
from ....cluster.ssh_hosts import Host, ssh_command
from ....errors import FarmError
from ....processes.helper_process import emit
from ....processes.spawn import kill_group, spawn
from ....processes.worker_extras import load_extra
from ..worker_call import run_command
from .serving import POLL_S, Ending, serving
from .worker import WORKS_FOR
from .worker_findings import short

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
                for news in await asyncio.to_thread(_news, connections):
                    emit(**news)
                if all(connection.has_ended for connection in connections):
                    raise FarmError(
                        "None of the computers works any more.", "See the lines above, of each."
                    )
                await asyncio.sleep(POLL_S)
        finally:
            await asyncio.to_thread(_end, connections)


def _news(connections: list[Connection]) -> list[dict[str, str]]:
    return [news for connection in connections for news in connection.news()]


def _end(connections: list[Connection]) -> None:
    for connection in connections:
        connection.end_input()
    until_s = time.monotonic() + _END_S
    for connection in connections:
        connection.end(until_s)


def _warning(text: str) -> dict[str, str]:
    return {"warning": text, "code": "computer-lost"}

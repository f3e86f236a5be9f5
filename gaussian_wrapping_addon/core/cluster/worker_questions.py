# SPDX-License-Identifier: GPL-3.0-or-later
"""Ask each worker of a Dask cluster something, beside its work and within a time limit."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import platform
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from . import child
from .addresses import Address
from .child import sendable_beside, sendable_clock
from .dask_tasks import CONNECT_S, check_scheduler, no_scheduler, security_of

if TYPE_CHECKING:
    from distributed import Client

_CLOCK_READINGS = 3
"""Of which the one with the shortest round trip counts: the first ones open connections."""
_CLOSE_S = 5.0

Judged = TypeVar("Judged")


@dataclass(frozen=True)
class Answer:
    """What one worker has answered."""

    worker: str
    """Its address, as the scheduler knows it."""
    error: str = ""
    """Why it has not answered to the end."""
    python: str = ""
    """Version; nothing is asked of a worker whose minor version is not ours."""
    clock_s: float = 0.0
    """How far its clock is ahead of ours, by the middle of a round trip."""
    results: Sequence[dict[str, Any]] = field(default=())
    """How the children ended, see :func:`.child.run_child`."""

    @property
    def has_our_python(self) -> bool:
        """Whether functions can be sent to it: they hold bytecode."""
        return _minor(self.python) == _minor(platform.python_version())


async def ask_workers(
    address: Address,
    certificates: str,
    requests: Callable[[int], Sequence[dict[str, Any]]],
    judge: Callable[[Answer], Awaitable[Judged]],
    limit_s: float,
) -> AsyncIterator[Judged]:
    """Have each worker run children at once, whatever it works on; yield what comes of them.

    Parameters
    ----------
    requests : callable
        Returns the requests for the worker of a number; the next one is made where one had no
        answer.
    judge : callable
        Receives the answers.
    limit_s : float
        Time for each worker.

    Raises
    ------
    WorkerError
        No scheduler answers.
    """
    import cloudpickle
    from distributed import Client

    cloudpickle.register_pickle_by_value(child)
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    security = security_of(str(address), certificates)
    await check_scheduler(str(address), security)
    try:
        client = await Client(
            str(address), asynchronous=True, timeout=CONNECT_S, set_as_default=False,
            security=security,
        )  # fmt: skip
    except (OSError, TimeoutError) as error:
        raise no_scheduler(str(address), error) from None
    tasks: list[asyncio.Task[Judged]] = []
    try:
        try:
            known = await asyncio.wait_for(client.scheduler.identity(n_workers=-1), CONNECT_S)
        except (OSError, TimeoutError) as error:
            raise no_scheduler(str(address), error) from None

        async def one(worker: str, number: int) -> Judged:
            return await judge(await _ask(client, worker, requests(number), limit_s))

        tasks = [asyncio.create_task(one(w, k)) for k, w in enumerate(sorted(known["workers"]))]
        for task in asyncio.as_completed(tasks):
            yield await task
    finally:
        for task in tasks:
            task.cancel()
        with contextlib.suppress(Exception):  # whatever is open ends with this process
            await asyncio.wait_for(client.close(timeout=_CLOSE_S), _CLOSE_S)


async def _ask(
    client: Client, worker: str, requests: Sequence[dict[str, Any]], limit_s: float
) -> Answer:
    answer = Answer(worker)
    scheduler: Any = client.scheduler
    try:
        async with asyncio.timeout(limit_s):
            there = await scheduler.broadcast(msg={"op": "versions"}, workers=[worker])
            python = str(there[worker]["host"]["python"]).split(".")  # as 3.11.9.final.0
            answer = Answer(worker, python=".".join(python[:3]))
            if not answer.has_our_python:
                return answer
            clock_s, results = await _clock(client, worker), []
            for request in requests:
                told = await client.run(sendable_beside(), request, workers=[worker])
                results.append(dict(told[worker]))
                if results[-1].get("answer") is not None:
                    break
            return Answer(worker, "", answer.python, clock_s, results)
    except (OSError, TimeoutError):  # of ours, or of the scheduler, which asks it for us
        return Answer(worker, f"It does not answer within {limit_s:.0f} s.", answer.python)
    except Exception as error:  # whatever a worker raises arrives here
        return Answer(worker, f"{type(error).__name__}: {error}.", answer.python)


async def _clock(client: Client, worker: str) -> float:
    found = []
    for _ in range(_CLOCK_READINGS):
        begun_s, asked_s = time.monotonic(), time.time()
        there_s = (await client.run(sendable_clock(), workers=[worker]))[worker]
        trip_s = time.monotonic() - begun_s
        found.append((trip_s, float(there_s) - asked_s - trip_s / 2))
    return min(found)[1]


def _minor(version: str) -> str:
    return ".".join(version.split(".")[:2])

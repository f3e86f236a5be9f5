# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes on a Dask cluster."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import platform
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from ..errors import WorkerError
from ..settings.job import LOCAL
from ..worker.environment import load_extra
from . import child
from .addresses import (
    CA_NAME,
    CERTIFICATE_NAME,
    KEY_NAME,
    Address,
    checked_folder,
    scheduler_address,
)
from .child import sendable_beside, sendable_clock

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster


# -- Child processes by Dask: a cluster of this computer, or the scheduler at an address ----------
#
# Names and results travel over the network, data over the folder that all computers share.

_logger = logging.getLogger(__name__)

HTTP = "127.0.0.1:0"
"""Where Dask serves its pages: it cannot be told not to, but nobody else sees them."""
CONNECT_S = 15.0
"""Longest time until a scheduler has answered."""
KILLED_WORKERS = 2
"""Dask gives a task up that has taken more workers than this with it."""
_POLL_S = 0.05
_LOOK_S = 5.0
"""How often it is looked whether workers are still there."""
_NONE_S = 60.0
"""Without any worker of this computer for so long, none will come: starting one takes seconds."""
_CLOSE_S = 5.0
_LOST = ("cancelled", "lost")
_CONNECTED = ("running", "connecting", "newly-created")


class FarmLostError(WorkerError):
    """The scheduler is gone, with all that it knew."""

    can_resume = True


@dataclass(frozen=True)
class Ended:
    """How a child process ended."""

    name: str
    code: int
    error: str = ""
    hint: str = ""
    host: str = ""


@dataclass(frozen=True)
class _Bound:
    """A child that some workers are asked for only, as others have refused."""

    key: str
    request: dict[str, Any]
    workers: frozenset[str]


class DaskTasks:
    """A connection to a Dask cluster.

    ``address``: ``"local"``, with so many ``processes``, or that of a scheduler:
    ``tls://HOST:PORT``, with a folder of ``certificates``, or ``tcp://`` on this computer only.
    Raises MissingExtraError: the worker lacks Dask; UsageError: the address is none, is not
    encrypted, or the certificates are missing; WorkerError: no scheduler answers there.
    """

    def __init__(self, address: str, processes: int, certificates: str = "") -> None:
        self._address = address if address == LOCAL else str(scheduler_address(address))
        load_extra("farm", "Several processes or computers")
        import dask
        from distributed import Client, LocalCluster

        _send_child_as_source(logging.ERROR)
        self._run = child.sendable()
        self._futures: dict[str, Future] = {}
        self._refusing: set[str] = set()
        self._bound: dict[str, _Bound] = {}
        self._looked_s = self._seen_s = time.monotonic()
        self._cluster: LocalCluster | None = None
        self._processes = processes
        dask.config.set({
            "distributed.scheduler.allowed-failures": KILLED_WORKERS,
            "distributed.comm.retry.count": 3, "distributed.admin.log-length": 100,
        })  # fmt: skip
        target: Any = self._address
        if self._address == LOCAL:
            self._cluster = target = LocalCluster(
                n_workers=processes, threads_per_worker=1, processes=True, memory_limit=0,
                host="127.0.0.1", dashboard_address=HTTP, scheduler_kwargs={"dashboard": False},
                worker_dashboard_address=HTTP,
            )  # fmt: skip
        security = security_of(self._address, certificates)
        if self._cluster is None:
            asyncio.run(check_scheduler(self._address, security))
        try:
            self._client: Client = Client(
                target, timeout=CONNECT_S, set_as_default=False, security=security
            )
        except (OSError, TimeoutError) as error:
            raise no_scheduler(self._address, error) from None

    @property
    def slots(self) -> int:
        """How many children may run at a time; at least one, as workers may still come.

        Workers that refuse do not count, while there are others.
        """
        if self._cluster is not None:
            return self._processes
        return max(1, sum(int(worker["nthreads"]) for worker in self._fit().values()))

    def submit(self, name: str, key: str, request: dict[str, Any]) -> None:
        """Have a child run somewhere (see :func:`.child.run_child`), not where one was refused.

        ``name``: by which it is found again; ``key``: unique: by it the scheduler knows the task.
        Raises FarmLostError: the scheduler is gone.
        """
        if self._client.status not in _CONNECTED:
            raise self._lost()
        fit = self._fit().keys() if self._refusing else set[str]()
        if fit and fit.isdisjoint(self._refusing):
            self._bound[name] = _Bound(key, request, frozenset(fit))
        self._send(name, key, request)

    def _send(self, name: str, key: str, request: dict[str, Any]) -> None:
        bound = self._bound.get(name)
        self._futures[name] = self._client.submit(
            self._run, request, key=key, pure=False,
            workers=None if bound is None else sorted(bound.workers),
        )  # fmt: skip

    def _workers(self) -> dict[str, Any]:
        """Return what the scheduler knows of its workers, by address."""
        with contextlib.suppress(OSError):  # no connection now: :meth:`ended` tells if it is lost
            return dict(self._client.scheduler_info(n_workers=-1).get("workers", {}))
        return {}

    def _fit(self) -> dict[str, Any]:
        """Return the workers that have not refused; all, if all have."""
        found = self._workers()
        return {k: v for k, v in found.items() if k not in self._refusing} or found

    def ended(self, seconds: float) -> list[Ended]:
        """Return which children have ended; wait so long at most. Raises FarmLostError."""
        until_s = time.monotonic() + seconds
        while True:
            found = [name for name, future in self._futures.items() if future.done()]
            if found:
                return [self._take(name) for name in found]
            if self._client.status not in _CONNECTED:
                raise self._lost()
            self._look_after_workers()
            if time.monotonic() >= until_s:
                return []
            time.sleep(_POLL_S)

    def _look_after_workers(self) -> None:
        """Submit for any worker what waits for some that are gone: Dask would wait for ever.

        Raises FarmLostError: all workers of this computer are gone. Dask starts one again that dies
        at work, and gives up one that dies while it starts.
        """
        now_s = time.monotonic()
        watched = self._bound or self._cluster is not None
        if not self._futures or not watched or now_s - self._looked_s < _LOOK_S:
            return
        self._looked_s = now_s
        alive = self._workers()
        if alive:
            self._seen_s = now_s
        elif self._cluster is not None and now_s - self._seen_s > _NONE_S:
            raise FarmLostError(
                "All processes that run parts on this computer have ended.",
                "Resume: parts that are done stay. If it happens again, use fewer processes.",
            )
        lonely = [name for name, bound in self._bound.items() if bound.workers.isdisjoint(alive)]
        for name in lonely if alive else ():
            bound = self._bound.pop(name)
            self._client.cancel([self._futures.pop(name)])
            self._send(name, f"{bound.key}-anywhere", bound.request)

    def _take(self, name: str) -> Ended:
        from distributed.scheduler import KilledWorker

        future = self._futures.pop(name)
        self._bound.pop(name, None)
        if future.status in _LOST:
            raise self._lost()
        try:
            result = dict(future.result(timeout=_CLOSE_S))
        except KilledWorker as error:
            host = getattr(error.last_worker, "host", "")
            return Ended(
                name, 1, f"It took {KILLED_WORKERS + 1} Dask workers with it, the last on {host}.",
                "See the logs of the workers.", host,
            )  # fmt: skip
        except Exception as error:  # whatever a worker raises arrives here
            return Ended(name, 2, f"{type(error).__name__}: {error}")
        if result.get("refused"):
            with contextlib.suppress(OSError):  # the scheduler is gone: said elsewhere
                for workers in self._client.who_has([future]).values():
                    self._refusing.update(workers)
        texts = [str(result.get(key, "")) for key in ("error", "hint", "host")]
        return Ended(name, int(result.get("code", 2)), *texts)

    def _lost(self) -> FarmLostError:
        return FarmLostError(
            f"The Dask scheduler at {self._address} is gone.",
            "Start it again and resume: parts that are done stay, the rest is submitted again.",
        )

    def close(self, grace_s: float) -> None:
        """Wait so long for children that were told to stop, then give the cluster back."""
        until_s = time.monotonic() + grace_s
        while time.monotonic() < until_s and self._client.status == "running":
            if all(future.done() for future in self._futures.values()):
                break
            time.sleep(_POLL_S)
        try:
            self._client.cancel(list(self._futures.values()), force=True)
            self._client.close(timeout=_CLOSE_S)
            if self._cluster is not None:
                self._cluster.close(timeout=_CLOSE_S)
        except Exception as error:  # a cluster that is gone already
            _logger.warning("the Dask cluster did not close: %s", error)


def _send_child_as_source(log_level: int) -> None:
    """Have :mod:`.child` sent whole: workers need not have the add-on; quieten Dask's log."""
    import cloudpickle

    cloudpickle.register_pickle_by_value(child)
    logging.getLogger("distributed").setLevel(log_level)


async def check_scheduler(address: str, security: Any) -> None:
    """Ask a scheduler for its name: a client would wait for ever for one that accepts and hangs.

    Raises WorkerError: it does not answer.
    """
    from distributed.core import rpc

    arguments = {} if security is None else security.get_connection_args("client")
    try:
        async with asyncio.timeout(CONNECT_S), rpc(address, connection_args=arguments) as scheduler:
            await scheduler.identity(n_workers=0)
    except (OSError, TimeoutError) as error:
        raise no_scheduler(address, error) from None


def no_scheduler(address: str, error: Exception) -> WorkerError:
    """Return the error where no Dask scheduler answers at an address."""
    return WorkerError(
        f"No Dask scheduler answers at {address} ({str(error) or 'no answer'}).",
        "Start one there: batch.py farm scheduler. Both sides need the same certificates.",
    )


def request_of(
    folder: Path, module: str, arguments: dict[str, Any], command: list[str] | None
) -> dict[str, Any]:
    """Return a request for :func:`.child.run_child` about a folder; ``command``: for this computer.

    The folder is named relative to the shared folder of this computer, if it lies in it.
    """
    shared = os.environ.get(child.SHARED_VARIABLE, "")
    is_shared = bool(shared) and command is None and folder.is_relative_to(Path(shared).resolve())
    name = folder.relative_to(Path(shared).resolve()).as_posix() if is_shared else str(folder)
    return {
        "module": module, "arguments": arguments, "folder": name, "is_shared": is_shared,
        "command": command,
    }  # fmt: skip


def security_of(address: str, certificates: str) -> Any:
    """Return what Dask needs for an address; ``None`` where nothing is encrypted.

    Raises UsageError: certificates are needed and missing.
    """
    if not address.startswith("tls://"):
        return None
    from distributed.security import Security

    folder = checked_folder(certificates)
    return Security(
        tls_ca_file=str(folder / CA_NAME), tls_client_cert=str(folder / CERTIFICATE_NAME),
        tls_client_key=str(folder / KEY_NAME), require_encryption=True,
        tls_scheduler_cert=str(folder / CERTIFICATE_NAME),
        tls_scheduler_key=str(folder / KEY_NAME),
        tls_worker_cert=str(folder / CERTIFICATE_NAME), tls_worker_key=str(folder / KEY_NAME),
    )  # fmt: skip


# -- Ask each worker of a Dask cluster something, beside its work and within a time limit ---------

_CLOCK_READINGS = 3
"""Of which the one with the shortest round trip counts: the first ones open connections."""


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
    address: Address, certificates: str, requests: Callable[[int], Sequence[dict[str, Any]]],
    judge: Callable[[Answer], Awaitable[Judged]], limit_s: float,
) -> AsyncIterator[Judged]:  # fmt: skip
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
    from distributed import Client

    _send_child_as_source(logging.CRITICAL)
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

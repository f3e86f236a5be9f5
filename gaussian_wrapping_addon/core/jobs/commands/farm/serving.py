# SPDX-License-Identifier: GPL-3.0-or-later
"""A Dask scheduler in this process, its workers told as they come and go, and an orderly end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import threading
from collections.abc import AsyncIterator
from types import FrameType
from typing import TYPE_CHECKING

from ....cluster.addresses import Address
from ....cluster.dask_tasks import HTTP, security_of
from ....errors import UsageError
from ....processes.helper_process import emit

if TYPE_CHECKING:
    from distributed import Scheduler

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

    Raises
    ------
    UsageError
        It cannot listen there, or certificates are missing.
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

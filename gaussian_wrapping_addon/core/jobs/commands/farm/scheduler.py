# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``farm scheduler`` command: a Dask scheduler that runs until it is ended.

Runs in the worker's Python; writes one JSON object per line, in the protocol of commands.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Iterator
from typing import Any

from ....cluster.addresses import checked_address
from ....cluster.dask_tasks import HTTP, security_of
from ....errors import UsageError
from ....processes.worker_extras import load_extra
from ..worker_call import run_command


def main(arguments: list[str]) -> int:
    """Run for ``arguments = [{"address", "certificates"} as JSON]``."""

    def work() -> Iterator[str]:
        request = json.loads(arguments[0])
        address = checked_address(str(request["address"]))
        load_extra("farm", "A scheduler")
        logging.getLogger("distributed").setLevel(logging.ERROR)
        security = security_of(address, str(request["certificates"]))
        yield f"the scheduler listens at {address}; end it with Ctrl-C"
        asyncio.run(_run(address, security))

    return run_command(work)


async def _run(address: str, security: Any) -> None:
    from distributed import Scheduler

    try:
        scheduler = await Scheduler(
            host=address, security=security, dashboard=False, dashboard_address=HTTP
        )
    except OSError as error:
        raise UsageError(
            f"The scheduler cannot listen at {address}: {error.strerror or error}.",
            "Give an address of this computer and a free port.",
        ) from None
    await scheduler.finished()

# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``farm scheduler`` command: a Dask scheduler that runs until it is ended."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator

from ...farm.addresses import Address, scheduler_address
from ...worker.environment import load_extra
from ...worker.helper_process import emit
from .farm_ssh import serving
from .run_in_worker import run_command


def main(arguments: list[str]) -> int:
    """Run for ``arguments = [{"address", "certificates"} as JSON]``."""

    def work() -> Iterator[str]:
        request = json.loads(arguments[0])
        address = scheduler_address(str(request["address"]))
        load_extra("farm", "A scheduler")
        asyncio.run(_run(address, str(request["certificates"])))
        yield "the scheduler has ended"

    return run_command(work)


async def _run(address: Address, certificates: str) -> None:
    async with serving(address, certificates) as scheduler:
        emit(line=f"the scheduler listens at {address}; end it with Ctrl-C")
        await scheduler.finished()

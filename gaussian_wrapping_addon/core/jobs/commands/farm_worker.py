# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``farm worker`` command: this computer runs parts for a Dask scheduler until it is ended."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from ...errors import UsageError
from ...farm import child
from ...farm.addresses import Address, scheduler_address
from ...farm.dask import HTTP, security_of
from ...worker.environment import PACKAGES_OPTION, load_extra
from ...worker.helper_process import emit
from .run_in_worker import run_command

WORKS_FOR = "this computer works for"
"""Begin of the line once the scheduler knows this worker."""
SILENCE_S = 30.0
"""Time without a scheduler after which the worker ends."""
_ENTRY = Path(__file__).resolve().parents[2] / "worker" / "worker_main.py"


def main(arguments: list[str]) -> int:
    """Run for ``arguments = [{"address", "certificates", "shared", "slots"} as JSON]``."""

    def work() -> Iterator[str]:
        request = json.loads(arguments[0])
        address = scheduler_address(str(request["address"]))
        shared = str(request["shared"])
        if shared and not Path(shared).is_dir():
            raise UsageError(f"{shared} is not a folder.", "Mount the shared folder, or name it.")
        load_extra("farm", "A worker")
        logging.getLogger("distributed").setLevel(logging.ERROR)
        security = security_of(str(address), str(request["certificates"]))
        os.environ[child.ENTRY_VARIABLE] = str(_ENTRY)
        os.environ[child.PACKAGES_VARIABLE] = str(sys._xoptions.get(PACKAGES_OPTION) or "")
        if shared:
            os.environ[child.SHARED_VARIABLE] = shared
        asyncio.run(_run(address, security, int(request["slots"])))
        yield "the scheduler has ended"

    return run_command(work)


async def _run(address: Address, security: object, slots: int) -> None:
    from distributed import Nanny

    try:
        nanny = await Nanny(
            str(address), nthreads=slots, memory_limit=0, security=security, dashboard=False,
            dashboard_address=HTTP, death_timeout=SILENCE_S,
            # By itself a worker listens at all networks, not encrypted where the scheduler is not.
            host=address.host if address.is_this_computer else None,
        )  # fmt: skip
    except (OSError, TimeoutError) as error:
        raise UsageError(
            f"No scheduler answers at {address} ({error or 'no answer'}).",
            "Start it first: batch.py farm scheduler. Both need the same certificates.",
        ) from None
    emit(line=f"{WORKS_FOR} {address}; end it with Ctrl-C")
    await nanny.finished()

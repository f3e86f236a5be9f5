# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``farm doctor`` command: whether each worker of a Dask cluster can run parts of jobs.

The line of a worker has its findings as ``"worker"``, too, for the panel.
"""

from __future__ import annotations

import asyncio
import json
import logging
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

from ...errors import EXIT_BAD_DATA, EXIT_CANCELLED, FarmError
from ...farm.addresses import Address, check_reachable, scheduler_address
from ...farm.dask import ask_workers
from ...worker.environment import load_extra
from ...worker.helper_process import emit
from .farm_findings import MeetingFolder, WorkerFinding, finding_of, versions
from .run_in_worker import run_command


class UnfitWorkersError(FarmError):
    """A worker cannot run parts, or there is none."""

    exit_code = EXIT_BAD_DATA


def main(arguments: list[str]) -> int:
    """Ask for ``arguments = [{"address", "certificates", "folder", "limit_s"} as JSON]``."""
    request = json.loads(arguments[0])
    meeting = MeetingFolder(Path(request["folder"]))

    def work() -> Iterator[str]:
        address = scheduler_address(str(request["address"]))
        load_extra("farm", "The doctor of a farm")
        check_reachable(address)
        with meeting:
            found = asyncio.run(_asked(address, request, meeting))
        bad = sum(not finding.good for finding in found)
        if not found:
            raise UnfitWorkersError(
                f"The scheduler at {address} answers, but has no workers.",
                "Start one on each computer: batch.py farm worker.",
            )
        if bad:
            raise UnfitWorkersError(
                f"{bad} of {len(found)} workers cannot be used as they are.",
                "Mend what their lines say, then ask again.",
            )
        yield f"{len(found)} of {len(found)} workers can be used"

    def end(_number: int, _frame: FrameType | None) -> None:
        sys.exit(EXIT_CANCELLED)  # so that the folder is removed

    before = signal.signal(signal.SIGTERM, end)
    try:
        return run_command(work, leave=meeting.remove)
    finally:
        signal.signal(signal.SIGTERM, before)


async def _asked(
    address: Address, request: dict[str, object], meeting: MeetingFolder
) -> list[WorkerFinding]:
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    limit_s, here = float(str(request["limit_s"])), versions()
    found = []
    asked = ask_workers(
        address, str(request["certificates"]), lambda number: meeting.requests(number, limit_s),
        lambda answer: finding_of(answer, meeting, here), limit_s,
    )  # fmt: skip
    async for finding in asked:
        emit(line=finding.line(), worker=finding.to_json())
        found.append(finding)
    return found

# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands ``farm slurm`` and ``farm pbs``: a scheduler here, its workers as jobs of a cluster.

The jobs are cancelled at the end; where nobody could do that, a worker ends without its scheduler.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ...farm.addresses import Address, scheduler_address
from ...farm.hosts import Host, Wanted, make_job, submit, worker_command
from ...worker.environment import load_extra
from ...worker.helper_process import emit
from .farm_ssh import END_S, POLL_S, Ending, serving
from .run_in_worker import run_command

if TYPE_CHECKING:
    from dask_jobqueue.core import Job


def main(arguments: list[str]) -> int:
    """Run for ``arguments = [{"address", "certificates", "workers", "wanted", "host"}]``.

    ``wanted``: of each job; ``host``: the paths there.
    """
    ending = Ending()

    def work() -> Iterator[str]:
        request = json.loads(arguments[0])
        address = scheduler_address(str(request["address"]))
        given = request["wanted"]
        wanted = Wanted(**{**given, "directives": tuple(given["directives"])}).validated()
        load_extra("farm", "A farm of jobs")
        line = worker_command(Host(**request["host"]), str(address))
        asyncio.run(_run(address, request, wanted, line, ending))
        yield "the jobs were cancelled"

    with ending:
        return run_command(work, leave=ending.leave)


async def _run(
    address: Address, request: dict[str, Any], wanted: Wanted, worker: str, ending: Ending
) -> None:
    async with serving(address.listening(), str(request["certificates"])) as scheduler:
        jobs: list[Job] = []
        try:
            for number in range(int(request["workers"])):
                if ending.is_asked:
                    break
                jobs.append(make_job(wanted, str(address), f"worker-{number}", worker))
                emit(line=f"job {await submit(jobs[-1])} is in the queue of {wanted.system}")
            emit(line=f"the scheduler listens for {address}; end all with Ctrl-C")
            while not ending.is_asked and scheduler.status.name == "running":
                await asyncio.sleep(POLL_S)
        finally:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(END_S):
                    await asyncio.gather(*(job.close() for job in jobs), return_exceptions=True)

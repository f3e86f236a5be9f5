# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``work-tiles`` command: mesh tiles of a running job in a further process.

Runs in the worker's Python, on this machine or on another one that shares the job folder. Writes
one JSON object per line to stdout, in the protocol of :mod:`~.run_in_worker`.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

from ...errors import UsageError, WrapError
from ...kernels.parallel import default_threads
from ...progress import Progress
from ..stages.region_meshing import unfinished_tile_lists, work_on_tile_list
from ..store.job_folder import JobFolder
from .worker_call import run_command

POLL_S = 0.5


def main(arguments: list[str]) -> int:
    """Work for ``arguments = [{"out", "threads", "wait_s", "device"} as JSON]``."""

    def work() -> list[str]:
        request = json.loads(arguments[0])
        folder = JobFolder(Path(request["out"]))
        threads, wait_s = int(request["threads"]), float(request["wait_s"])
        done = work_on_tiles(folder, threads, wait_s, str(request["device"]))
        return [f"{done} parts done by this process"]

    return run_command(work)


def work_on_tiles(folder: JobFolder, threads: int, wait_s: float, device: str) -> int:
    """Work on every unfinished tile list of a job; return the number of tasks completed here.

    Parameters
    ----------
    wait_s : float
        Longest time to wait for a list.
    device : str
        The setting of this process, which need not be that of the job.

    Raises
    ------
    UsageError
        There is no job, or no list to work on.
    """
    if not folder.is_job():
        raise UsageError(f"{folder.root} is not a job folder.", "Give the --out of a job.")
    until_s = time.monotonic() + wait_s
    folder.check_entries()
    progress = Progress("mesh", None, folder.cancel_path.exists)
    while not (lists := unfinished_tile_lists(folder)):
        progress.check()
        if time.monotonic() >= until_s:
            raise UsageError(
                f"{folder.root} has no tiles to work on.",
                "Start mesh --tiles N there first, or give --wait.",
            )
        time.sleep(POLL_S)
    done: list[str] = []
    for path in lists:
        try:
            work_on_tile_list(
                folder.stages, path, progress, done, threads=threads or default_threads(),
                device=device,
            )  # fmt: skip
        except (WrapError, OSError):
            # The job may have joined the tiles and removed their files meanwhile.
            if path in unfinished_tile_lists(folder):
                raise
    return len(done)

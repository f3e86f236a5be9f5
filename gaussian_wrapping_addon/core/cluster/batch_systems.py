# SPDX-License-Identifier: GPL-3.0-or-later
"""Workers as jobs of a batch system (SLURM, PBS), by dask-jobqueue's jobs.

dask-jobqueue writes the head of the script, submits it, reads the job's number and cancels the job;
defaults of a site are read from its ``jobqueue.yaml``. The worker in the script is ours: parts need
its environment.
"""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..errors import FarmError, UsageError

if TYPE_CHECKING:
    from dask_jobqueue.core import Job

SYSTEMS = ("slurm", "pbs")
MAX_WORKERS = 1000
_MEMORY = re.compile(r"[0-9]{1,6}(\.[0-9]{1,3})?(MB|GB|TB|MiB|GiB|TiB)")
_TIME = re.compile(r"([0-9]{1,3}-)?[0-9]{1,4}(:[0-9]{2}){0,2}")
_WORD = re.compile(r"[\w.:@/,+-]{0,100}")
_MAX_DIRECTIVE = 500


@dataclass(frozen=True)
class Wanted:
    """What each job asks the batch system for."""

    system: str
    cores: int
    memory: str
    """With a unit, such as ``"16GB"``."""
    time: str
    """``HH:MM:SS``, and what else the system takes."""
    queue: str = ""
    account: str = ""
    directives: tuple[str, ...] = ()
    """Other options of the system's script, such as ``"--gres=gpu:1"``."""
    logs: str = ""
    """Folder of the jobs' output; empty: as the system does."""

    def validated(self) -> Wanted:
        """Return this.

        Raises
        ------
        UsageError
            A value cannot stand in a script.
        """
        if self.system not in SYSTEMS:
            raise UsageError(
                f"{self.system!r} is no batch system.", f"Give {' or '.join(SYSTEMS)}."
            )
        if not 1 <= self.cores <= 4096:
            raise UsageError("--cores is out of range.", "Give from 1 to 4096.")
        if not _MEMORY.fullmatch(self.memory):
            raise UsageError(f"{self.memory!r} is no memory.", "Give it with a unit, as 16GB.")
        if not _TIME.fullmatch(self.time):
            raise UsageError(f"{self.time!r} is no time.", "Give HH:MM:SS.")
        for text in (self.queue, self.account):
            if not _WORD.fullmatch(text):
                raise UsageError(f"{text!r} is no name of a queue or account.", "Give its name.")
        for text in self.directives:
            if len(text) > _MAX_DIRECTIVE or not text.isprintable():
                raise UsageError(
                    "A directive has a line break, or is long.", "Give one option each."
                )
        if not self.logs.isprintable():
            raise UsageError("The folder of --logs has a line break.", "Give another folder.")
        return self


def make_job(wanted: Wanted, address: str, name: str, worker: str) -> Job:
    """Return a job that runs a worker, not submitted yet.

    Parameters
    ----------
    address : str
        Of the scheduler.
    worker : str
        The line of the script that runs the worker.

    Raises
    ------
    UsageError
        The commands of the batch system are not on this computer.
    """
    from dask_jobqueue.pbs import PBSJob
    from dask_jobqueue.slurm import SLURMJob

    kind: type[Any] = {"slurm": SLURMJob, "pbs": PBSJob}[wanted.system]
    for command in (kind.submit_command, kind.cancel_command):
        if shutil.which(command) is None:
            raise UsageError(
                f"There is no {command} on this computer.",
                "Run this on a computer that hands jobs to the cluster.",
            )

    class WorkerJob(kind):
        def __init__(self, **options: Any) -> None:
            super().__init__(**options)
            self._command_template = f"exec {worker}"

    return WorkerJob(
        scheduler=address, name=name, cores=wanted.cores, processes=1, memory=wanted.memory,
        walltime=wanted.time, queue=wanted.queue or None, account=wanted.account or None,
        job_extra_directives=list(wanted.directives) or None, log_directory=wanted.logs or None,
        job_name="gaussian-wrapping", python="python3",
    )  # fmt: skip


async def submit(job: Job) -> str:
    """Submit a job; return its number.

    Raises
    ------
    FarmError
        The batch system refuses it.
    """
    try:
        await job.start()
    except (RuntimeError, ValueError, OSError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise FarmError(
            f"{job.submit_command} refuses a job: {lines[-1] if lines else 'it says nothing'}.",
            "Change the options, then start again.",
        ) from None
    return str(job.job_id)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Computers by SSH, SLURM and PBS."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import FarmError, ParseError, UsageError
from ..files import read_bounded
from ..settings.declaration import MAX_PROCESSES

if TYPE_CHECKING:
    from dask_jobqueue.core import Job


# -- Workers as jobs of a batch system (SLURM, PBS), by dask-jobqueue's jobs ----------------------
#
# dask-jobqueue writes the head of the script, submits it, reads the job's number and cancels the
# job; defaults of a site are read from its ``jobqueue.yaml``. The worker in the script is ours:
# parts need its environment.

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
        """Return this. Raises UsageError: a value cannot stand in a script."""
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
    """Return a job, not submitted yet, in whose script the line ``worker`` runs a worker.

    Raises UsageError: the commands of the batch system are not on this computer.
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
    """Submit a job; return its number. Raises FarmError: the batch system refuses it."""
    try:
        await job.start()
    except (RuntimeError, ValueError, OSError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise FarmError(
            f"{job.submit_command} refuses a job: {lines[-1] if lines else 'it says nothing'}.",
            "Change the options, then start again.",
        ) from None
    return str(job.job_id)


# -- Computers that the system's ``ssh`` reaches, and how a worker is started on one --------------
#
# The client of the system knows the user's keys, agents, jump hosts and names of computers. It
# never asks: a computer that wants a password fails at once.

MAX_HOSTS = 1000
MAX_FILE_BYTES = 1 << 20
_CONNECT_S = 15
_ALIVE_EVERY_S = 15
_ALIVE_COUNT = 4
_NAME = re.compile(
    r"(ssh://)?([A-Za-z0-9_.][A-Za-z0-9_.-]*@)?"
    r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.][A-Za-z0-9_.-]*)(:[0-9]{1,5})?"
)
"""``[user@]computer``, or ``ssh://[user@]computer[:port]``."""


@dataclass(frozen=True)
class Host:
    """A computer, with its own paths."""

    name: str
    shared: str
    certificates: str
    python: str
    batch: str
    slots: int = 1


def read_hosts(path: Path, usual: Host) -> list[Host]:
    """Read computers from a file: a line has a name, and ``KEY=VALUE`` where not as ``usual``.

    Raises ParseError: a line is none of these, or the file is too large; OSError.
    """
    data = read_bounded(path, MAX_FILE_BYTES, follow_links=True)
    try:
        text = data.decode("utf-8")
    except ValueError:
        raise ParseError(
            path, "whole file", "it is not text.", "Name a list of computers."
        ) from None
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            words = shlex.split(line, comments=True)
            if words:
                found.append(_host(words, usual))
        except (ValueError, UsageError) as error:
            told = error.message if isinstance(error, UsageError) else f"{error}."
            raise ParseError(
                path, f"line {number}", told, "Write: COMPUTER [shared=DIR] [slots=N] ..."
            ) from None
    return found


def hosts_named(names: Iterable[str], usual: Host) -> list[Host]:
    """Return computers by their names. Raises UsageError: a name is none."""
    return [_host([name], usual) for name in names]


def checked_hosts(hosts: list[Host]) -> list[Host]:
    """Return computers of which there are some, each once.

    Raises UsageError: there is none, one is named twice, or they are too many.
    """
    names = [host.name for host in hosts]
    twice = [name for name in names if names.count(name) > 1] if len(names) <= MAX_HOSTS else []
    if not names:
        raise UsageError("No computer is named.", "Give their names, or --hosts FILE.")
    if len(names) > MAX_HOSTS:
        raise UsageError(f"{len(names)} computers are too many.", f"Give up to {MAX_HOSTS}.")
    if twice:
        raise UsageError(f"{twice[0]} is named twice.", "Give slots=2 for two parts side by side.")
    return hosts


def ssh_command(host: Host, address: str) -> list[str]:
    """Return the command that runs a worker on a computer until its input ends.

    Raises UsageError: there is no ``ssh`` here.
    """
    program = shutil.which("ssh")
    if program is None:
        raise UsageError("There is no ssh on this computer.", "Install OpenSSH's client.")
    there = worker_command(host, address, "--end-with-input")
    return [
        program, "-T", "-a", "-x", "-o", "BatchMode=yes", "-o", f"ConnectTimeout={_CONNECT_S}",
        "-o", f"ServerAliveInterval={_ALIVE_EVERY_S}", "-o", f"ServerAliveCountMax={_ALIVE_COUNT}",
        "--", host.name, f"exec {there}",
    ]  # fmt: skip


def worker_command(host: Host, address: str, *more: str) -> str:
    """Return the line for a POSIX shell that runs a worker."""
    words = [host.python, host.batch, "farm", "worker", address, "--slots", str(host.slots), *more]
    if address.startswith("tls://"):
        words += ["--certificates", host.certificates]
    if host.shared:
        words += ["--shared", host.shared]
    return shlex.join(words)


def _host(words: list[str], usual: Host) -> Host:
    name, *pairs = words
    if not _NAME.fullmatch(name):
        raise UsageError(f"{name!r} is no name of a computer.", "Give it as ssh takes it.")
    changes: dict[str, Any] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or key not in ("shared", "certificates", "python", "batch", "slots"):
            raise UsageError(f"{pair!r} is unknown.", "Give shared=DIR, python=PATH and the like.")
        if key != "slots":
            changes[key] = value
        elif value.isdecimal() and 1 <= int(value) <= MAX_PROCESSES:
            changes[key] = int(value)
        else:
            raise UsageError(f"slots is not from 1 to {MAX_PROCESSES}.", "")
    return replace(usual, name=name, **changes)

# SPDX-License-Identifier: GPL-3.0-or-later
"""The command ``farm``: jobs on several computers.

Certificates, scheduler, workers here (``worker``) and elsewhere (``ssh``, ``slurm``, ``pbs``), and
``doctor``: requests to commands in the worker's Python, which run until they are ended.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from ..core.errors import EXIT_CANCELLED, UsageError
from ..core.farm.addresses import checked_folder, scheduler_address
from ..core.farm.hosts import (
    MAX_WORKERS,
    Host,
    Wanted,
    checked_hosts,
    hosts_named,
    read_hosts,
    ssh_command,
)
from ..core.files import real_path
from ..core.names import SHARED_VARIABLE
from ..core.settings.declaration import MAX_PROCESSES
from .job_commands import run_in_worker
from .options import Commands, given_path

_BATCH = Path(__file__).resolve().parents[1] / "batch.py"


def add_certificates(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--certificates", default="", metavar="DIR", help="folder of the farm's certificates"
    )


def in_worker(module: str, request: dict[str, Any]) -> int:
    """Run a command of a farm in the worker's Python; return the exit code."""

    return run_in_worker(
        request, module=f"jobs.commands.farm_{module}", what="command",
        grace_s=_GRACE_S,
    )  # fmt: skip


_GRACE_S = 12.0
"""In which others are told to end."""


def add_ssh(commands: Any) -> None:
    parser = commands.add_parser(
        "ssh", help="run a Dask scheduler here, and a worker on each of several computers by SSH"
    )
    _add_here(parser)
    parser.add_argument("hosts", nargs="*", metavar="COMPUTER", help="as ssh takes it")
    parser.add_argument(
        "--hosts", dest="hosts_file", type=given_path, metavar="FILE",
        help="more of them, one a line: COMPUTER [shared=DIR] [certificates=DIR] [python=PATH] "
        "[batch=PATH] [slots=N]",
    )  # fmt: skip
    _add_there(parser, "python3")
    parser.add_argument(
        "--limit", type=float, default=120.0, metavar="S",
        help="seconds within which a computer must begin to work (default: 120)",
    )  # fmt: skip
    parser.set_defaults(run=_ssh)


def _ssh(options: Namespace) -> int:
    if not 1.0 <= options.limit <= 3600.0:
        raise UsageError("--limit is out of range.", "Give from 1 to 3600.")
    usual = _usual(options)
    hosts = hosts_named(options.hosts, usual)
    if options.hosts_file is not None:
        hosts += read_hosts(options.hosts_file, usual)
    ssh_command(checked_hosts(hosts)[0], options.address)
    request = _request(options) | {
        "hosts": [asdict(host) for host in hosts], "start_s": options.limit,
    }  # fmt: skip
    return in_worker("ssh", request)


def _add_system(name: str, title: str, commands: Any) -> None:
    parser = commands.add_parser(
        name, help=f"run a Dask scheduler here, and workers as jobs of {title}"
    )
    _add_here(parser)
    parser.add_argument("--workers", type=int, required=True, metavar="N", help="jobs, one each")
    parser.add_argument("--cores", type=int, required=True, metavar="N", help="of each job")
    parser.add_argument("--memory", required=True, metavar="SIZE", help="of each job, as 32GB")
    parser.add_argument("--time", required=True, metavar="HH:MM:SS", help="of each job")
    parser.add_argument("--queue", default="", metavar="NAME", help="queue or partition")
    parser.add_argument("--account", default="", metavar="NAME", help="that pays for the jobs")
    parser.add_argument(
        "--directive", action="append", default=[], metavar="OPTION", dest="directives",
        help=f"another option of {title}, as --directive=--gres=gpu:1; may be repeated",
    )  # fmt: skip
    parser.add_argument("--logs", default="", metavar="DIR", help="for the output of the jobs")
    _add_there(parser, sys.executable)
    parser.set_defaults(run=_batch_jobs, system=name)


def _batch_jobs(options: Namespace) -> int:
    if not 1 <= options.workers <= MAX_WORKERS:
        raise UsageError("--workers is out of range.", f"Give from 1 to {MAX_WORKERS}.")
    wanted = Wanted(
        options.system, options.cores, options.memory, options.time, options.queue,
        options.account, tuple(options.directives),
        str(real_path(options.logs)) if options.logs else "",
    ).validated()  # fmt: skip
    request = _request(options) | {
        "workers": options.workers, "wanted": asdict(wanted), "host": asdict(_usual(options)),
    }  # fmt: skip
    return in_worker("batch_jobs", request)


def _add_here(parser: ArgumentParser) -> None:
    parser.add_argument(
        "address", metavar="tls://HOST:PORT",
        help="this computer as the others know it, and a port for the scheduler",
    )  # fmt: skip
    add_certificates(parser)


def _add_there(parser: ArgumentParser, python: str) -> None:
    parser.add_argument(
        "--shared", default="", metavar="DIR",
        help="the folder that all computers share, as the others see it",
    )  # fmt: skip
    parser.add_argument("--slots", type=int, default=1, help="parts side by side on each")
    parser.add_argument(
        "--python", default=python, metavar="PATH", help="Python 3.11 or newer on the others"
    )
    parser.add_argument(
        "--batch", default=str(_BATCH), metavar="PATH",
        help="batch.py of the add-on on the others (default: as here)",
    )  # fmt: skip
    parser.add_argument(
        "--certificates-there", default="", metavar="DIR",
        help="the certificates on the others (default: as here)",
    )  # fmt: skip


def _usual(options: Namespace) -> Host:
    if not 1 <= options.slots <= MAX_PROCESSES:
        raise UsageError("--slots is out of range.", f"Give from 1 to {MAX_PROCESSES}.")
    there = options.certificates_there or _request(options)["certificates"]
    return Host("", options.shared, there, options.python, options.batch, options.slots)


def _request(options: Namespace) -> dict[str, Any]:
    """Return address and certificates, checked here: others would be asked in vain."""
    address = scheduler_address(options.address)
    folder = ""
    if address.scheme == "tls":
        folder = str(real_path(checked_folder(options.certificates)))
    return {"address": str(address), "certificates": folder}


_DEFAULT_PORT = 8786


def _add_make_certificates(commands: Any) -> None:
    parser = commands.add_parser(
        "make-certificates", help="make the certificates by which computers know each other"
    )
    parser.add_argument("folder", type=given_path, metavar="DIR", help="new folder for them")
    parser.set_defaults(run=_make_certificates)


def _make_certificates(options: Namespace) -> int:
    return in_worker("certificates", {"folder": str(real_path(options.folder))})


def _add_scheduler(commands: Any) -> None:
    parser = commands.add_parser("scheduler", help="run a Dask scheduler on this computer")
    parser.add_argument(
        "address", nargs="?", default=f"tls://0.0.0.0:{_DEFAULT_PORT}", metavar="tls://HOST:PORT",
        help="where it listens",
    )  # fmt: skip
    add_certificates(parser)
    parser.set_defaults(run=_scheduler)


def _scheduler(options: Namespace) -> int:
    request = {"address": options.address, "certificates": options.certificates}
    return in_worker("scheduler", request)


def _add_worker(commands: Any) -> None:
    parser = commands.add_parser("worker", help="let this computer work for a Dask scheduler")
    parser.add_argument("address", metavar="tls://HOST:PORT", help="of the scheduler")
    add_certificates(parser)
    parser.add_argument(
        "--shared", default="", metavar="DIR",
        help="the folder that all computers share, as this one sees it",
    )  # fmt: skip
    parser.add_argument("--slots", type=int, default=1, help="parts side by side (default: 1)")
    parser.add_argument(
        "--end-with-input", action="store_true",
        help="end when the standard input does, as with a connection by SSH",
    )  # fmt: skip
    parser.set_defaults(run=_worker)


def _worker(options: Namespace) -> int:
    if not 1 <= options.slots <= MAX_PROCESSES:
        raise UsageError("--slots is out of range.", f"Give from 1 to {MAX_PROCESSES}.")
    request = {
        "address": options.address, "certificates": options.certificates,
        "shared": str(real_path(options.shared)) if options.shared else "",
        "slots": options.slots,
    }  # fmt: skip
    try:
        if options.end_with_input:
            threading.Thread(target=_interrupt_at_end_of_input, daemon=True).start()
        return in_worker("worker", request)
    except KeyboardInterrupt:  # before there is a process that it could end
        return EXIT_CANCELLED


def _interrupt_at_end_of_input() -> None:
    while os.read(sys.stdin.fileno(), 1024):
        pass
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, signal.SIGINT)
    else:
        os.kill(os.getpid(), signal.CTRL_C_EVENT)  # type: ignore[attr-defined, unused-ignore]


def _add_doctor(commands: Any) -> None:
    parser = commands.add_parser(
        "doctor", help="check each worker of a Dask scheduler: versions, memory, shared folder"
    )
    parser.add_argument("address", metavar="tls://HOST:PORT", help="of the scheduler")
    add_certificates(parser)
    parser.add_argument(
        "--shared", default="", metavar="DIR",
        help="folder of the jobs, as this computer sees it (default: GW_SHARED)",
    )  # fmt: skip
    parser.add_argument(
        "--limit", type=float, default=120.0, metavar="S",
        help="seconds within which each worker must answer (default: 120)",
    )  # fmt: skip
    parser.set_defaults(run=_doctor)


def _doctor(options: Namespace) -> int:
    folder = options.shared or os.environ.get(SHARED_VARIABLE, "")
    if not folder:
        raise UsageError(
            "No folder is named that all computers share.",
            f"Give --shared DIR, or set {SHARED_VARIABLE}.",
        )
    if not 1.0 <= options.limit <= 3600.0:
        raise UsageError("--limit is out of range.", "Give from 1 to 3600.")
    request: dict[str, Any] = {
        "address": str(scheduler_address(options.address)), "certificates": options.certificates,
        "folder": str(real_path(folder)), "limit_s": options.limit,
    }  # fmt: skip
    return in_worker("doctor", request)


DASK_COMMANDS: tuple[Callable[[Any], None], ...] = (
    _add_make_certificates, _add_scheduler, _add_worker, add_ssh,
    partial(_add_system, "slurm", "SLURM"), partial(_add_system, "pbs", "PBS"), _add_doctor,
)  # fmt: skip
"""In the order shown by ``farm --help``."""


def add_farm(commands: Commands) -> None:
    """Add ``farm`` with its subcommands."""
    parser = commands.add_parser("farm", help="jobs on several computers")
    inner = parser.add_subparsers(dest="farm_command", required=True, parser_class=type(parser))
    for add in DASK_COMMANDS:
        add(inner)

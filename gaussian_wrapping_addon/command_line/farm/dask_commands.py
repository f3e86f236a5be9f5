# SPDX-License-Identifier: GPL-3.0-or-later
"""``farm make-certificates``, ``scheduler``, ``worker`` and ``doctor``; others are beside it."""

from __future__ import annotations

import os
import signal
import sys
import threading
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from .worker_places import add_certificates, add_pbs, add_slurm, add_ssh, in_worker

_DEFAULT_PORT = 8786


def _add_make_certificates(commands: Any) -> None:
    parser = commands.add_parser(
        "make-certificates", help="make the certificates by which computers know each other"
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="new folder for them")
    parser.set_defaults(run=_make_certificates)


def _make_certificates(options: Namespace) -> int:
    from ...core.files import real_path

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
    _add_address(parser)
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
    from ...core.errors import EXIT_CANCELLED, UsageError
    from ...core.files import real_path
    from ...core.settings.declaration import MAX_PROCESSES

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
    _add_address(parser)
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
    from ...core.errors import UsageError
    from ...core.farm.addresses import scheduler_address
    from ...core.files import real_path
    from ...core.names import SHARED_VARIABLE

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


def _add_address(parser: ArgumentParser) -> None:
    parser.add_argument("address", metavar="tls://HOST:PORT", help="of the scheduler")


DASK_COMMANDS = (
    _add_make_certificates, _add_scheduler, _add_worker, add_ssh, add_slurm, add_pbs, _add_doctor,
)  # fmt: skip
"""In the order shown by ``farm --help``."""

# SPDX-License-Identifier: GPL-3.0-or-later
"""The command ``farm``: jobs on several computers."""

from __future__ import annotations

import logging
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .common import Commands

if TYPE_CHECKING:
    from ..core.farm.part_states import PartBoard

_logger = logging.getLogger("gaussian_wrapping")

_DEFAULT_PRIORITY = 50
_DEFAULT_PORT = 8786


def add_farm(commands: Commands) -> None:
    """Add ``farm`` with its subcommands."""
    parser = commands.add_parser("farm", help="jobs on several computers")
    inner = parser.add_subparsers(dest="farm_command", required=True, parser_class=type(parser))
    for add in _FARM_COMMANDS:
        add(inner)


def _add_submit(commands: Commands) -> None:
    parser = commands.add_parser("submit", help="hand job folders to a Flamenco Manager")
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="job folder")
    parser.add_argument(
        "--flamenco", required=True, metavar="URL", help="the Manager, as http://COMPUTER:8080"
    )
    parser.add_argument(
        "--priority", type=int, default=_DEFAULT_PRIORITY, metavar="N",
        help="0 to 100; jobs with higher numbers are first (default: 50)",
    )  # fmt: skip
    parser.add_argument(
        "--tag", default="", metavar="NAME", help="only workers with this tag run the jobs"
    )
    parser.add_argument(
        "--shared", default="", metavar="PATH",
        help="shared folder on this computer (default: GW_SHARED, else as the Manager says)",
    )  # fmt: skip
    parser.add_argument(
        "--root", default="", metavar="PATH",
        help="the same as all workers name it (default: the Manager's variable gw_shared)",
    )  # fmt: skip
    parser.set_defaults(run=_submit)


def _add_status(commands: Commands) -> None:
    parser = commands.add_parser("status", help="how far a submitted job is")
    _add_folder(parser)
    parser.set_defaults(run=_status)


def _add_retry(commands: Commands) -> None:
    parser = commands.add_parser("retry", help="let failed or cancelled parts run again")
    _add_folder(parser)
    parser.set_defaults(run=_retry)


def _add_cancel(commands: Commands) -> None:
    parser = commands.add_parser("cancel", help="stop a submitted job; retry continues it")
    _add_folder(parser)
    parser.set_defaults(run=_cancel)


def _add_job_type(commands: Commands) -> None:
    parser = commands.add_parser("job-type", help="write the job type for Flamenco's scripts")
    parser.add_argument(
        "folder", type=Path, metavar="FOLDER", help="folder scripts beside flamenco-manager"
    )
    parser.set_defaults(run=_job_type)


def _add_folder(parser: ArgumentParser) -> None:
    parser.add_argument("out", type=Path, metavar="DIR", help="job folder of that job")


def _submit(options: Namespace) -> int:
    from ..core.errors import EXIT_DONE
    from ..core.farm.address import parse_address
    from ..core.farm.flamenco.manager import Manager
    from ..core.farm.flamenco.submission import Choices, ask_farm, checked_parts, submit
    from ..core.files import real_path
    from ..core.jobs.parts.planning import plan_if_missing
    from ..core.jobs.store.job_folder import JobFolder

    choices = Choices(options.priority, options.tag, options.shared, options.root).validated()
    manager = Manager(parse_address(options.flamenco))
    targets = [JobFolder(root) for root in dict.fromkeys(map(real_path, options.folders))]
    for target in targets:  # all are looked at before the first one is submitted
        if target.is_job():
            target.check_entries()
            checked_parts(target, plan_if_missing(target, write=False))
        else:
            checked_parts(target)
    farm = ask_farm(manager, choices)
    for note in farm.notes:
        _logger.info("warning: %s", note)
    for target in targets:
        plan_if_missing(target)
        done = submit(farm, target.root, choices)
        _logger.info(
            "%s: job %s of Flamenco %s, %d parts",
            target.root, done.record.job, farm.version, done.parts,
        )  # fmt: skip
    return EXIT_DONE


def _status(options: Namespace) -> int:
    from ..core.errors import EXIT_DONE
    from ..core.farm.flamenco.job_record import submitted
    from ..core.farm.flamenco.job_state import read_state
    from ..core.farm.part_states import PartReader
    from ..core.files import real_path

    root = real_path(options.out)
    record = submitted(root)
    _log_parts(PartReader(root).read())
    state = read_state(record)
    tasks = ", ".join(f"{count} {name}" for name, count in state.counts)
    _logger.info("job %s at %s: %s", record.job, record.address, state.status)
    _logger.info("tasks: %s", tasks or "none")
    for task in state.failed:
        _logger.info("%s: %s on %s", task.name, task.status, task.worker or "no worker")
        for line in task.lines:
            _logger.info("    %s", line)
    return EXIT_DONE


def _log_parts(board: PartBoard) -> None:
    if board.problem:
        _logger.info("%s", board.problem)
        return
    _logger.info("%-10s %6s %8s %7s %6s", "part", "done", "running", "failed", "left")
    for kind, row in (*board.counts, ("all", board.totals)):
        _logger.info("%-10s %6d %8d %7d %6d", kind, *row)


def _retry(options: Namespace) -> int:
    from ..core.errors import EXIT_DONE
    from ..core.farm.flamenco.job_record import submitted
    from ..core.farm.flamenco.job_state import retry
    from ..core.files import real_path

    root = real_path(options.out)
    retry(root, submitted(root))
    _logger.info("queued again; look with: farm status %s", root)
    return EXIT_DONE


def _cancel(options: Namespace) -> int:
    from ..core.errors import EXIT_DONE
    from ..core.farm.flamenco.job_record import submitted
    from ..core.farm.flamenco.job_state import cancel
    from ..core.files import real_path

    root = real_path(options.out)
    cancel(root, submitted(root))
    _logger.info("cancelled; continue with: farm retry %s", root)
    return EXIT_DONE


def _job_type(options: Namespace) -> int:
    from ..core.errors import EXIT_DONE
    from ..core.farm.flamenco.job_type_file import write_job_type

    _logger.info("wrote %s; restart the Manager", write_job_type(options.folder))
    return EXIT_DONE


def _add_make_certificates(commands: Commands) -> None:
    parser = commands.add_parser(
        "make-certificates", help="make the certificates by which computers know each other"
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="new folder for them")
    parser.set_defaults(run=_make_certificates)


def _make_certificates(options: Namespace) -> int:
    from ..core.files import real_path

    return _in_worker("certificates", {"folder": str(real_path(options.folder))})


def _add_scheduler(commands: Commands) -> None:
    parser = commands.add_parser("scheduler", help="run a Dask scheduler on this computer")
    parser.add_argument(
        "address", nargs="?", default=f"tls://0.0.0.0:{_DEFAULT_PORT}", metavar="tls://HOST:PORT",
        help="where it listens",
    )  # fmt: skip
    _add_certificates(parser)
    parser.set_defaults(run=_scheduler)


def _scheduler(options: Namespace) -> int:
    request = {"address": options.address, "certificates": options.certificates}
    return _in_worker("scheduler", request)


def _add_worker(commands: Commands) -> None:
    parser = commands.add_parser("worker", help="let this computer work for a Dask scheduler")
    parser.add_argument("address", metavar="tls://HOST:PORT", help="of the scheduler")
    _add_certificates(parser)
    parser.add_argument(
        "--shared", default="", metavar="DIR",
        help="the folder that all computers share, as this one sees it",
    )  # fmt: skip
    parser.add_argument("--slots", type=int, default=1, help="parts side by side (default: 1)")
    parser.set_defaults(run=_worker)


def _worker(options: Namespace) -> int:
    from ..core.errors import UsageError
    from ..core.files import real_path
    from ..core.settings.choices import MAX_PROCESSES

    if not 1 <= options.slots <= MAX_PROCESSES:
        raise UsageError("--slots is out of range.", f"Give from 1 to {MAX_PROCESSES}.")
    request = {
        "address": options.address, "certificates": options.certificates,
        "shared": str(real_path(options.shared)) if options.shared else "",
        "slots": options.slots,
    }  # fmt: skip
    return _in_worker("worker", request)


def _add_certificates(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--certificates", default="", metavar="DIR", help="folder of the farm's certificates"
    )


def _in_worker(module: str, request: dict[str, Any]) -> int:
    from ..core.jobs.client import worker_python
    from ..core.jobs.commands.run_in_worker import run_in_worker

    return run_in_worker(
        request, python=worker_python(), module=f"jobs.commands.farm.{module}", what="command"
    )


_FARM_COMMANDS = (
    _add_make_certificates, _add_scheduler, _add_worker, _add_submit, _add_status, _add_retry,
    _add_cancel, _add_job_type,
)  # fmt: skip
"""In the order shown by ``farm --help``."""

# SPDX-License-Identifier: GPL-3.0-or-later
"""The command ``farm``: jobs on several computers."""

from __future__ import annotations

import logging
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from .common import Commands
from .farm.dask_commands import DASK_COMMANDS

if TYPE_CHECKING:
    from ..core.farm.part_states import PartBoard

_logger = logging.getLogger("gaussian_wrapping")

_DEFAULT_PRIORITY = 50


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


_FARM_COMMANDS = (
    *DASK_COMMANDS, _add_submit, _add_status, _add_retry, _add_cancel, _add_job_type,
)  # fmt: skip
"""In the order shown by ``farm --help``."""

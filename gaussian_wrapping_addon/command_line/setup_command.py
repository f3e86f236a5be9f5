# SPDX-License-Identifier: GPL-3.0-or-later
"""The command ``set-up-worker``: create or remove the private worker environment."""

from __future__ import annotations

import logging
import sys
import time
from argparse import Namespace
from pathlib import Path

from ..core.errors import EXIT_DONE, EXIT_OTHER, UsageError
from ..core.jobs.install import (
    CPU,
    CUDA_BRINGS,
    SetupRequest,
    SetupTask,
    all_commands,
    as_line,
    check_folders,
    cuda_present,
    find_pythons,
    probe,
    remove,
)
from ..core.worker.environment import (
    EXTRAS,
    WorkerEnvironment,
    default_root,
    known_environments,
    read_extra_names,
    read_requirements,
    requirements_file,
)
from .options import Commands, given_path

_logger = logging.getLogger("gaussian_wrapping")

POLL_S = 0.2
LINE_EVERY_S = 5.0
_OMIT = {False: "Omit --repair.", True: "Give --extras instead of --add, which sets one up."}


def add_set_up_worker(commands: Commands) -> None:
    parser = commands.add_parser(
        "set-up-worker", help="create the private environment that workers run in"
    )
    parser.add_argument(
        "--python", default="", metavar="P", help="Python 3.11 or newer (default: searched for)"
    )
    parser.add_argument(
        "--to", type=given_path, metavar="DIR", help="folder (default: the add-on's own folder)"
    )
    parser.add_argument(
        "--find-links", default="", metavar="DIR", help="install wheels only from this folder"
    )
    parser.add_argument(
        "--torch", choices=("cpu", "cuda", "index"), default="cpu",
        help="build of torch; cuda: training and vacancy on an NVIDIA GPU, for several GiB more; "
        "index: the default of pip's index",
    )  # fmt: skip
    parser.add_argument(
        "--requirements", type=given_path, metavar="FILE", help="another list of packages"
    )
    parser.add_argument(
        "--extras", default="", metavar="NAMES",
        help="optional packages too, separated by commas: "
        + "; ".join(f"{extra.name}: {extra.purpose}" for extra in EXTRAS),
    )  # fmt: skip
    parser.add_argument("--dry-run", action="store_true", help="only show the commands")
    action = parser.add_mutually_exclusive_group()
    action.add_argument(
        "--repair", action="store_true", help="create it again with its present Python and torch"
    )
    action.add_argument("--remove", action="store_true", help="delete the environment")
    action.add_argument(
        "--add", default="", metavar="NAMES", help="add extras to the present environment"
    )
    parser.set_defaults(run=_set_up_worker)


def _set_up_worker(options: Namespace) -> int:
    known = [e.root for e in known_environments() if e.is_ours()]
    change = options.repair or options.remove or options.add
    root = (options.to or (known[0] if change and known else default_root())).absolute()
    environment = WorkerEnvironment(root)
    if options.remove:
        remove(environment)
        _logger.info("removed %s", root)
        return EXIT_DONE
    name, torch = options.python, options.torch
    extras = read_extra_names(options.add or options.extras)
    if options.repair or options.add:
        marker = environment.marker()
        if not marker:
            raise UsageError(f"{root} holds no worker environment.", _OMIT[bool(options.add)])
        extras = extras or environment.extras()
        name, torch = name or str(marker.get("python", "")), str(marker.get("torch", torch))
    python = probe(name) if name else next(iter(find_pythons(sys.executable)), None)
    if python is None:
        raise UsageError("No Python 3.11 or newer was found.", "Name one with --python.")
    requirements = (options.requirements or requirements_file()).absolute()
    wheels = str(Path(options.find_links).absolute()) if options.find_links else ""
    request = SetupRequest(
        str(root), python.path, str(requirements), torch, wheels, extras, bool(options.add)
    )
    read_requirements(requirements)
    check_folders(request)
    if torch == CPU and not options.add and cuda_present():
        _logger.info("An NVIDIA driver was found. With --torch cuda: %s.", CUDA_BRINGS)
    for command in all_commands(request, python):
        _logger.info("$ %s", as_line(command))
    return EXIT_DONE if options.dry_run else _follow(request)


def _follow(request: SetupRequest) -> int:
    """Run the set-up and show its progress; return the exit code."""
    task = SetupTask(request)
    task.start()
    shown_s, shown = 0.0, ""
    while (status := task.status).active:
        try:
            if status.message and (
                status.stage != shown or time.monotonic() - shown_s > LINE_EVERY_S
            ):
                shown, shown_s = status.stage, time.monotonic()
                _logger.info(
                    "[%5.1f %%] %-11s %s", 100 * status.fraction, status.stage, status.message
                )
            time.sleep(POLL_S)
        except KeyboardInterrupt:
            _logger.info("cancelling")
            task.cancel()
    if status.state == "DONE":
        _logger.info("ready: %s", request.environment.worker())
    else:
        _logger.error("error: %s %s", status.error, status.hint)
    return EXIT_OTHER if status.exit_code is None else status.exit_code

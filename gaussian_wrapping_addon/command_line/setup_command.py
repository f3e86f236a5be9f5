# SPDX-License-Identifier: GPL-3.0-or-later
"""``set-up-worker``: make, repair or remove the private environment that workers run in."""

from __future__ import annotations

import logging
import sys
import time
from argparse import Namespace
from pathlib import Path

from .common import Commands

_logger = logging.getLogger("gaussian_wrapping")

POLL_S = 0.2
LINE_EVERY_S = 5.0
CANCEL_WAIT_S = 12.0


def add_set_up_worker(commands: Commands) -> None:
    """Add ``set-up-worker``."""
    parser = commands.add_parser(
        "set-up-worker", help="make the private environment that workers run in"
    )
    parser.add_argument("--python", default="", metavar="P", help="3.11 or newer; found if absent")
    parser.add_argument("--to", type=Path, metavar="DIR", help="the add-on's own folder if absent")
    parser.add_argument(
        "--find-links", default="", metavar="DIR", help="take wheels from here and nowhere else"
    )
    parser.add_argument(
        "--torch", choices=("cpu", "cuda", "index"), default="cpu",
        help="index: whatever pip's own index gives",
    )  # fmt: skip
    parser.add_argument("--requirements", type=Path, metavar="FILE", help="another list")
    parser.add_argument("--dry-run", action="store_true", help="show the commands only")
    action = parser.add_mutually_exclusive_group()
    action.add_argument("--repair", action="store_true", help="put back what is broken")
    action.add_argument("--remove", action="store_true", help="delete what was made")
    parser.set_defaults(run=_set_up_worker)


def _set_up_worker(options: Namespace) -> int:
    from ..core.errors import EXIT_DONE, UsageError
    from ..core.setup.commands import SetupRequest, all_steps, check_folders
    from ..core.setup.install import remove, repair_request
    from ..core.setup.pythons import find_pythons, probe
    from ..core.worker_environment import default_root, known_environments
    from ..core.worker_requirements import read_requirements, requirements_file

    known = [e.root for e in known_environments() if e.is_ours()]
    change = options.repair or options.remove
    root = (options.to or (known[0] if change and known else default_root())).absolute()
    if options.remove:
        remove(SetupRequest(str(root), "", "").environment)
        _logger.info("removed %s", root)
        return EXIT_DONE
    request = SetupRequest(
        str(root),
        options.python,
        str((options.requirements or requirements_file()).absolute()),
        options.torch,
        str(Path(options.find_links).absolute()) if options.find_links else "",
    )
    if options.repair:
        request = repair_request(request)
    elif not request.python:
        found = find_pythons(sys.executable)
        if not found:
            raise UsageError("No Python 3.11 or newer was found.", "Name one with --python.")
        request = SetupRequest(**{**request.to_json(), "python": found[0].path})
    if options.dry_run:
        check_folders(request)
    requirements = read_requirements(Path(request.requirements))
    for step in all_steps(request, probe(request.python), requirements):
        _logger.info("$ %s", step.line)
    return EXIT_DONE if options.dry_run else _follow(request)


def _follow(request: object) -> int:
    """Show progress until it ends; return the exit code."""
    from ..core.errors import EXIT_CANCELLED, EXIT_DONE, EXIT_OTHER
    from ..core.setup.client import SetupClient

    client = SetupClient.start(request)  # type: ignore[arg-type]
    shown_s, shown, interrupted_s = 0.0, "", 0.0
    while True:
        try:
            status = client.poll()
            if not status.active:
                break
            news = (status.message or status.stage).partition(":")[0]
            now_s = time.monotonic()
            if news != shown or now_s - shown_s > LINE_EVERY_S:
                shown, shown_s = news, now_s
                _logger.info(
                    "[%5.1f %%] %-11s %s", 100 * status.fraction, status.stage, status.message
                )
            if interrupted_s and now_s - interrupted_s > CANCEL_WAIT_S:
                client.kill()
                return EXIT_CANCELLED
            time.sleep(POLL_S)
        except KeyboardInterrupt:
            _logger.info("cancelling; the same command goes on later")
            client.cancel()
            interrupted_s = time.monotonic()
    if status.state == "DONE":
        _logger.info("ready: %s", client.request.environment.worker())
        return EXIT_DONE
    _logger.error("error: %s %s", status.error, status.hint)
    return status.exit_code or EXIT_OTHER

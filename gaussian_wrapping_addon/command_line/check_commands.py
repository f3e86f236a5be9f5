# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands ``check`` and ``doctor``: findings about an input and the worker's Python."""

from __future__ import annotations

import logging
from argparse import Namespace
from pathlib import Path

from .common import Commands
from .follow import has_bpy

_logger = logging.getLogger("gaussian_wrapping")


def add_check(commands: Commands) -> None:
    """Add ``check``."""
    parser = commands.add_parser("check", help="findings about an input, without starting anything")
    parser.add_argument("input", type=Path)
    parser.add_argument(
        "--quick", action="store_true", help="do not decode the photos: no blur, no duplicates"
    )
    parser.add_argument(
        "--threads", type=int, default=0, metavar="N", help="threads that decode (default: all)"
    )
    parser.set_defaults(run=_check)


def _check(options: Namespace) -> int:
    from ..core.errors import EXIT_BAD_DATA, EXIT_DONE
    from ..core.jobs.client import worker_if_any
    from ..core.loading.check import check_input
    from ..core.loading.source_kind import WITHOUT_PHOTOS

    findings = check_input(options.input, worker=worker_if_any())
    for finding in findings:
        _logger.info("%s: %s %s", finding.severity, finding.message, finding.hint)
    if any(finding.severity == "error" for finding in findings):
        return EXIT_BAD_DATA
    if options.quick or any(finding.kind in WITHOUT_PHOTOS for finding in findings):
        return EXIT_DONE
    return _look_at_photos(options.input, options.threads)


def _look_at_photos(source: Path, threads: int) -> int:
    """Let the worker decode the photos; return the exit code."""
    from ..core.errors import EXIT_DONE, UsageError
    from ..core.jobs.client import worker_python
    from ..core.jobs.commands.run_in_worker import run_in_worker

    try:
        python = worker_python()
    except UsageError as error:
        _logger.info("fact: Blur, exposure and duplicates were not looked for. %s", error)
        return EXIT_DONE
    return run_in_worker(
        {"source": str(source.absolute()), "threads": threads},
        python=python,
        module="jobs.commands.photo_check_command",
        what="check of the photos",
    )


def add_doctor(commands: Commands) -> None:
    """Add ``doctor``."""
    parser = commands.add_parser("doctor", help="findings about the worker's Python")
    parser.set_defaults(run=_doctor)


def _doctor(_options: Namespace) -> int:
    from ..core.errors import EXIT_BAD_DATA, EXIT_DONE
    from ..core.jobs.commands.doctor import find_and_diagnose

    findings = find_and_diagnose()
    for finding in findings:
        mark = "good" if finding.good else "BAD "
        _logger.info("%s  %-11s %s", mark, finding.subject, finding.finding)
        if not finding.good:
            _logger.info("                 %s", finding.hint)
    _logger.info("bpy               %s", "present" if has_bpy() else "absent: use --no-blend")
    return EXIT_DONE if all(f.good for f in findings) else EXIT_BAD_DATA

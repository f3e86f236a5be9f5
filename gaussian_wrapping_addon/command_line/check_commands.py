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
    parser.set_defaults(run=_check)


def _check(options: Namespace) -> int:
    from ..core.dataset.loading.check import check_input
    from ..core.errors import EXIT_BAD_DATA, EXIT_DONE

    findings = check_input(options.input)
    for finding in findings:
        _logger.info("%s: %s %s", finding.severity, finding.message, finding.hint)
    bad = any(finding.severity == "error" for finding in findings)
    return EXIT_BAD_DATA if bad else EXIT_DONE


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

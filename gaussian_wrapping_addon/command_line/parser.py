# SPDX-License-Identifier: GPL-3.0-or-later
"""The parser of the command line with all commands."""

from __future__ import annotations

import logging
from argparse import ArgumentParser
from typing import Any, NoReturn

from ..core.errors import UsageError
from .check_commands import add_check, add_doctor, add_evaluate
from .farm_commands import add_farm
from .job_commands import add_cancel, add_parts, add_run_part, add_status
from .mesh_commands import add_bake, add_convert_region, add_estimate_mesh, add_export, add_mesh
from .options import SetAction
from .setup_command import add_set_up_worker
from .training_commands import (
    add_continue_training,
    add_estimate,
    add_queue,
    add_resume,
    add_settings,
    add_wrap,
)

_logger = logging.getLogger("gaussian_wrapping")

_COMMANDS = (
    add_wrap, add_queue, add_mesh, add_bake, add_continue_training, add_resume, add_status,
    add_cancel, add_estimate_mesh, add_parts, add_run_part, add_farm, add_export,
    add_convert_region, add_evaluate, add_estimate, add_settings, add_check, add_doctor,
    add_set_up_worker,
)  # fmt: skip
"""In the order shown by ``--help``."""


_MOST_USAGE = 240
"""Characters of a usage that an error quotes, some three lines; ``--help`` has longer ones."""


class Parser(ArgumentParser):
    """Raise :class:`UsageError` instead of exiting the process, so that Blender exits cleanly."""

    def error(self, message: str) -> NoReturn:
        usage = " ".join(self.format_usage().split()[1:])
        short = f"Usage: {usage}" if len(usage) <= _MOST_USAGE else f"See {self.prog} --help."
        raise UsageError(f"{message}.", short)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse unknown options in the command that got them: the main parser names no option."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            message = f"unrecognized arguments: {' '.join(unknown)}"
            word = unknown[0].partition("=")[0].lstrip("-").replace("-", "_")
            known = (a.settings for a in self._actions if isinstance(a, SetAction))
            if any(word in settings for settings in known):
                raise UsageError(f"{message}.", f"Give it as --set {word}=VALUE.")
            self.error(message)
        return found, unknown

    def _print_message(self, message: str, file: Any = None) -> None:
        """Write help as the commands write: ``argparse`` fails on ASCII and hides full disks."""
        from ..core.progress import TerminalHandler

        for handler in _logger.handlers:
            if isinstance(handler, TerminalHandler):
                handler.write(message)
                return
        super()._print_message(message, file)


def build_parser(program: str = "batch.py") -> Parser:
    """Return the parser; the parsed options have ``run``, a function that takes the options."""
    parser = Parser(prog=program, description="Photos in, a textured mesh out.")
    commands = parser.add_subparsers(dest="command", required=True, parser_class=Parser)
    for add in _COMMANDS:
        add(commands)
    return parser

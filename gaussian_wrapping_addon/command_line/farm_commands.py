# SPDX-License-Identifier: GPL-3.0-or-later
"""The command ``farm``: jobs on several computers."""

from __future__ import annotations

from .common import Commands
from .farm.dask_commands import DASK_COMMANDS


def add_farm(commands: Commands) -> None:
    """Add ``farm`` with its subcommands."""
    parser = commands.add_parser("farm", help="jobs on several computers")
    inner = parser.add_subparsers(dest="farm_command", required=True, parser_class=type(parser))
    for add in DASK_COMMANDS:
        add(inner)

# SPDX-License-Identifier: GPL-3.0-or-later
"""What several commands share: their list, and where a job lies."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path
from typing import Any, Protocol

from ..core.settings import declared
from .options.setting_options import add_option


class Commands(Protocol):
    """The list of commands that a parser has."""

    def add_parser(self, name: str, *, help: str) -> Any:
        """Return the parser of a new command."""


def add_out(parser: ArgumentParser) -> None:
    """Add where the job lies."""
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")


def add_threads(parser: ArgumentParser) -> None:
    """Add how many threads may work."""
    threads = declared("threads")
    add_option(parser, threads, default=threads.default)


def add_no_blend(parser: ArgumentParser) -> None:
    """Add whether Blender files are written."""
    parser.add_argument("--no-blend", action="store_true", help="needs no bpy")

# SPDX-License-Identifier: GPL-3.0-or-later
"""Options shared by several commands: job folder, threads, device, Blender files."""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path
from typing import Any, Protocol

from ..core.settings import declared
from .options.setting_options import add_option


class Commands(Protocol):
    """The subcommands of a parser."""

    def add_parser(self, name: str, *, help: str) -> Any:
        """Return the parser of a new command."""


def add_out(parser: ArgumentParser) -> None:
    """Add ``--out``, the job folder."""
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")


def add_threads(parser: ArgumentParser) -> None:
    """Add ``--threads``."""
    threads = declared("threads")
    add_option(parser, threads, default=threads.default)


def add_device(parser: ArgumentParser, *, kept: bool = False) -> None:
    """Add ``--device``; with ``kept``, the job's own is kept where it is not given."""
    device = declared("device")
    if kept:
        help_kept = "another device than the job's: auto, cpu, cuda or cuda:N"
        add_option(parser, device, help=help_kept)
    else:
        add_option(parser, device, default=device.default)


def add_no_blend(parser: ArgumentParser) -> None:
    """Add ``--no-blend``: write no Blender files."""
    parser.add_argument(
        "--no-blend", action="store_true", help="write no scene.blend; needs no bpy"
    )

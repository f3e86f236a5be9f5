# SPDX-License-Identifier: GPL-3.0-or-later
"""The command ``convert-region``: a region file in another format."""

from __future__ import annotations

import logging
from argparse import Namespace
from pathlib import Path

from .common import Commands

_logger = logging.getLogger("gaussian_wrapping")


def add_convert_region(commands: Commands) -> None:
    """Add ``convert-region``."""
    parser = commands.add_parser(
        "convert-region", help="convert a region file: JSON, or .rsbox of RealityScan"
    )
    parser.add_argument("input", type=Path, metavar="FILE")
    parser.add_argument("output", type=Path, metavar="OUT", help="ends with .json or .rsbox")
    parser.set_defaults(run=_convert)


def _convert(options: Namespace) -> int:
    from ..core.errors import EXIT_DONE, UsageError
    from ..core.regions.region_file import read_region_file, write_region_file
    from ..core.regions.rsbox import SUFFIXES

    output: Path = options.output
    if output.suffix.lower() not in (".json", *SUFFIXES):
        raise UsageError(f"{output.name} names no format.", "Let it end with .json or .rsbox.")
    region = read_region_file(options.input)
    if not output.parent.is_dir():
        raise UsageError(f"{output.parent} is no folder.", "Make it first.")
    write_region_file(output, region.name, region.vertices)
    _logger.info("written: %s", output)
    return EXIT_DONE

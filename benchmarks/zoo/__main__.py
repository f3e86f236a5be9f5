# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs on the zoo of scenes: ``python -m benchmarks.zoo [-- ARGUMENTS OF THE COMMAND LINE]``.

Each run leaves a record in ``benchmarks/records/zoo/LABEL``, each scene's alpha shape one in
``benchmarks/records/zoo/baselines``; what has a record is not made again, so that the command may
be stopped at any time. ``--document`` writes ``docs/benchmarks/zoo.md`` from all records.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.errors import WrapError

from ..scenes.contact_sheet import write_contact_sheet
from .build import build_zoo_scene
from .cache import ensure_zoo_scene
from .catalogue import DEVELOPMENT, PARTS, SCENES, zoo_scene

_logger = logging.getLogger("benchmarks")


def _arguments(given: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.zoo", description=__doc__)
    parser.add_argument("--part", choices=(*PARTS, "all"), default=DEVELOPMENT)
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD",
        help="scenes whose names have one of these words in them",
    )  # fmt: skip
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--render", action="store_true", help="render the scenes, make no run")
    parser.add_argument(
        "--sheet", type=Path, metavar="FILE", help="draw a contact sheet of the scenes, make no run"
    )
    # For the child process that holds Blender's state:
    parser.add_argument("--build", help=argparse.SUPPRESS)
    parser.add_argument("--into", type=Path, help=argparse.SUPPRESS)
    return parser.parse_args(given)


def main(given: Sequence[str] | None = None) -> int:
    """Run the command line, return the exit code."""
    options = _arguments(sys.argv[1:] if given is None else given)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    logging.getLogger("PIL").setLevel(logging.WARNING)
    try:
        if options.build:
            build_zoo_scene(zoo_scene(options.build), options.into, options.threads)
            return 0
        names = [
            name
            for name, scene in SCENES.items()
            if options.part in (scene.part, "all")
            and (not options.only or any(word in name for word in options.only))
        ]
        folders = []
        for name in names:
            begun_s = time.monotonic()
            folders.append(ensure_zoo_scene(name, options.threads))
            _logger.info("%s: %.0f s, %s", name, time.monotonic() - begun_s, folders[-1].name)
        if options.sheet is not None:
            write_contact_sheet(folders, options.sheet)
            _logger.info("%s", options.sheet)
    except WrapError as error:
        _logger.error("%s", error)
        return error.exit_code
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

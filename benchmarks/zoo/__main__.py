# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs on the zoo of scenes: ``python -m benchmarks.zoo [-- ARGUMENTS OF THE COMMAND LINE]``.

Each run leaves a record in a folder of ``benchmarks/records`` that its label names, each scene's
alpha shape one beside them; what has a record is not made again, so that the command may be stopped
at any time. ``--document`` writes the page of the zoo among the documents from all records.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.errors import UsageError, WrapError

from ..provenance import DOCUMENTS
from ..study import carry_out, read_records
from .catalogue import DEVELOPMENT, PARTS, SCENES, zoo_scene
from .scene import build_zoo_scene, draw_sheet, ensure_taken_scene, ensure_zoo_scene
from .study import (
    BASELINES,
    TAKEN,
    alpha_case,
    find_scene,
    is_made,
    make_one,
    run_case,
    write_document,
)

_logger = logging.getLogger("benchmarks")

_FURTHER = "--"
"""What follows is given to the command line of every job."""


def _arguments(given: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.zoo", description=__doc__)
    parser.add_argument("--part", choices=(*PARTS, "all"), default=DEVELOPMENT)
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="WORD",
        help="scenes whose names have one of these words in them",
    )  # fmt: skip
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--label", help="folder of the records (default: the preset)")
    parser.add_argument(
        "--clean", action="store_true",
        help="photos as they are rendered; without it they are as a camera takes them, and the "
        f"label gets {TAKEN} at its end",
    )  # fmt: skip
    parser.add_argument("--runs", type=int, default=0, help="make at most so many; 0: no limit")
    parser.add_argument("--again", action="store_true", help="make runs that have a record, too")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--document", action="store_true", help="write the page, make no run")
    parser.add_argument("--out", type=Path, default=DOCUMENTS, help="folder of the page")
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
    words = list(sys.argv[1:] if given is None else given)
    at = words.index(_FURTHER) if _FURTHER in words else len(words)
    options, further = _arguments(words[:at]), words[at + 1 :]
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
        if options.sheet is not None:
            draw_sheet(names, options.sheet, options.threads)
            return 0
        if options.document:
            path = write_document(options.out)
            _logger.info("%s", path or "there is no record yet, so no page")
            return int(path is None)
        if not options.render:
            return _make_runs(names, options, further)
        for name in names:
            begun_s = time.monotonic()
            ensure = ensure_zoo_scene if options.clean else ensure_taken_scene
            folder = ensure(name, options.threads)
            _logger.info("%s: %.0f s, %s", name, time.monotonic() - begun_s, folder.name)
    except WrapError as error:
        _logger.error("%s", error)
        return error.exit_code
    return 0


def _make_runs(names: Sequence[str], options: argparse.Namespace, further: Sequence[str]) -> int:
    """Make the alpha shapes and runs that are missing; return 1 where one failed, else 0."""
    if options.label and options.label.endswith(TAKEN):
        raise UsageError(f"Labels do not end with {TAKEN}.", "Omit it: it is added.")
    label = (options.label or options.preset) + ("" if options.clean else TAKEN)
    if label == BASELINES or (further and not options.label):
        raise UsageError(
            f"Runs of {label!r} need a label of their own.",
            "Give the variant a name: --label NAME.",
        )
    jobs = [run_case(name, label, options.preset, further) for name in names]
    trivial = [alpha_case(name) for name in names]
    if not options.again:
        read_records([*jobs, *trivial])  # raises where a label was made with other arguments
    common = {"threads": options.threads, "maker": make_one, "find_scene": find_scene}
    # One scene after the other, so that a scene is rendered when its turn comes.
    failed = made = 0
    for job, alpha in zip(jobs, trivial, strict=True):
        if is_made(job) and not options.again:
            continue
        if options.runs and made == options.runs:
            break
        made += 1
        if not is_made(alpha):
            failed += carry_out([alpha], again=True, **common)
        failed += carry_out([job], again=True, **common)
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())

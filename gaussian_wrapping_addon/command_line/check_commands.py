# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands ``check``, ``doctor`` and ``evaluate``: what is there, and how good it is."""

from __future__ import annotations

import logging
import math
from argparse import ArgumentTypeError, Namespace
from pathlib import Path

from ..core.errors import EXIT_BAD_DATA, EXIT_DONE, UsageError
from ..core.jobs.commands.doctor import find_and_diagnose
from ..core.settings import JobSettings
from .job_commands import has_bpy, run_in_worker
from .options import Commands, add_threads, given_path

_logger = logging.getLogger("gaussian_wrapping")


def add_check(commands: Commands) -> None:
    parser = commands.add_parser("check", help="findings about an input, without starting anything")
    parser.add_argument("input", type=given_path)
    parser.add_argument(
        "--quick", action="store_true", help="do not decode the photos: no blur, no duplicates"
    )
    parser.add_argument(
        "--threads", type=int, default=0, metavar="N", help="threads that decode (default: all)"
    )
    parser.set_defaults(run=_check)


def _check(options: Namespace) -> int:
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
    from ..core.jobs.client import worker_python

    try:
        worker_python()
    except UsageError as error:
        _logger.info("fact: Blur, exposure and duplicates were not looked for. %s", error)
        return EXIT_DONE
    request = {"source": str(source.absolute()), "threads": threads}
    return run_in_worker(
        request, module="jobs.commands.photo_check_command", what="check of the photos"
    )


def add_doctor(commands: Commands) -> None:
    parser = commands.add_parser("doctor", help="findings about the worker's Python")
    parser.set_defaults(run=_doctor)


def _doctor(_options: Namespace) -> int:
    findings = find_and_diagnose()
    for finding in findings:
        mark = "good" if finding.good else "BAD "
        _logger.info("%s  %-11s %s", mark, finding.subject, finding.finding)
        if not finding.good:
            _logger.info("                 %s", finding.hint)
    _logger.info("bpy               %s", "present" if has_bpy() else "absent: use --no-blend")
    return EXIT_DONE if all(f.good for f in findings) else EXIT_BAD_DATA


MIN_IMAGE_PX = 64
"""Smaller photos hold no surface to speak of."""


def add_evaluate(commands: Commands) -> None:
    parser = commands.add_parser(
        "evaluate", help="score a mesh or a job against a ground truth or photos"
    )
    parser.add_argument(
        "mesh",
        type=given_path,
        metavar="MESH_OR_JOB",
        help="PLY, OBJ, GLB, STL or OFF; or a job folder",
    )
    parser.add_argument(
        "--metric", choices=("surface", "mbr"), default="surface",
        help="surface: distances to a true surface; mbr: mesh-based rendering, a colour field "
        "trained on the mesh and compared with photos that were held out",
    )  # fmt: skip
    parser.add_argument(
        "--truth", type=given_path, metavar="PATH", help="mesh, cloud, scene or data set (surface)"
    )
    parser.add_argument(
        "--test", type=given_path, metavar="PATH",
        help="test photos with cameras: COLMAP, transforms, or a folder with cameras.json and "
        "images (mbr; default: the photos that the job held out)",
    )  # fmt: skip
    parser.add_argument(
        "--max-image-px", type=int, metavar="N", help="long side of the photos compared (mbr)"
    )
    parser.add_argument(
        "--layout", choices=("auto", "scene", "mesh", "tanks", "dtu"), default="auto",
        help="layout of the truth; auto detects it from its files",
    )  # fmt: skip
    parser.add_argument("--scan", type=int, help="number of the DTU scan")
    parser.add_argument("--region", help="region of the job, if it has several")
    parser.add_argument(
        "--cameras",
        type=given_path,
        help="cameras, and photos, of a mesh file: COLMAP, transforms, job",
    )
    parser.add_argument(
        "--thresholds", type=_floats, help="shares of the truth's diagonal, comma separated"
    )
    parser.add_argument(
        "--distances", type=_floats, help="thresholds as lengths instead, comma separated"
    )
    parser.add_argument(
        "--align", choices=("none", "cameras", "icp"),
        help="alignment of the mesh to the truth: none, by cameras of equal names, by nearest "
        "points (default: none; tanks icp, dtu cameras)",
    )  # fmt: skip
    parser.add_argument("--protocols", help="comma separated, of uniform,scan,legacy")
    parser.add_argument("--samples", type=int, help="points drawn on the mesh (uniform protocol)")
    parser.add_argument("--seed", type=int, default=0, help="seed of these points")
    add_threads(parser)
    parser.add_argument(
        "--out", type=given_path, metavar="FILE.json", help="write all figures to this file"
    )
    parser.set_defaults(run=_evaluate)


def _floats(text: str) -> list[float]:
    try:
        values = [float(word) for word in text.split(",") if word]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) for value in values):
        raise ArgumentTypeError(f"{text!r}: give numbers separated by commas")
    return values


def _evaluate(options: Namespace) -> int:

    JobSettings(seed=options.seed, threads=options.threads).validated()
    if options.max_image_px is not None and options.max_image_px < MIN_IMAGE_PX:
        raise UsageError(
            f"--max-image-px {options.max_image_px} is too small.", f"Give at least {MIN_IMAGE_PX}."
        )
    given = vars(options)
    same = (
        "metric", "max_image_px", "layout", "scan", "region", "distances", "align", "samples",
        "seed", "threads",
    )  # fmt: skip
    request = {name: given[name] for name in same} | {"shares": options.thresholds}
    for name in ("mesh", "truth", "test", "cameras", "out"):
        request[name] = None if given[name] is None else str(given[name])
    protocols = options.protocols
    request["protocols"] = None if protocols is None else [p for p in protocols.split(",") if p]
    return run_in_worker(request, module="jobs.commands.evaluate_command", what="evaluation")

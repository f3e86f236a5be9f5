# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands ``export`` and ``convert-region``: results and regions for other programs."""

from __future__ import annotations

import logging
from argparse import Namespace
from pathlib import Path

from .common import Commands
from .follow import has_bpy

_logger = logging.getLogger("gaussian_wrapping")


def add_export(commands: Commands) -> None:
    """Add ``export``."""
    from ..core.names import BLENDER_FORMATS, EXPORT_FORMATS, SHADINGS

    parser = commands.add_parser(
        "export", help="export meshes of a finished job for other programs"
    )
    parser.add_argument("job", type=Path, metavar="JOB", help="job folder, or its result folder")
    parser.add_argument(
        "--format",
        default="glb",
        help=f"comma separated, of {','.join(EXPORT_FORMATS)}; "
        f"{' and '.join(BLENDER_FORMATS)} need bpy or Blender",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument(
        "--placed",
        action="store_true",
        help="coordinates as placed in Blender, instead of the input's world",
    )
    parser.add_argument("--region", nargs="+", action="extend", metavar="NAME", default=[])
    parser.add_argument("--lods", action="store_true", help="levels of detail too")
    parser.add_argument(
        "--shading",
        choices=SHADINGS,
        default="auto",
        help="shading of the material; auto: lit, but unlit for GLB without a normal or occlusion "
        "map",
    )
    parser.add_argument("--pack", action="store_true", help="pack textures into USD and FBX files")
    parser.set_defaults(run=_export)


def _export(options: Namespace) -> int:
    from ..core.errors import UsageError
    from ..core.files import real_path
    from ..core.jobs.client import worker_python
    from ..core.jobs.commands.export_files import result_of
    from ..core.jobs.commands.run_in_worker import run_in_worker
    from ..core.names import BLENDER_FORMATS, EXPORT_FORMATS

    formats = list(dict.fromkeys(f for f in options.format.split(",") if f))
    wrong = [f for f in formats if f not in EXPORT_FORMATS]
    if wrong or not formats:
        raise UsageError(
            f"--format {options.format} names no format." if not formats
            else f"--format {wrong[0]} is not known.",
            f"Use {', '.join(EXPORT_FORMATS)}.",
        )  # fmt: skip
    by_blender = [f for f in formats if f in BLENDER_FORMATS]
    if by_blender and not has_bpy():
        # Raise before anything is written: a partial export is easily mistaken for a complete one.
        raise UsageError(
            f"Writing {by_blender[0].upper()} needs bpy, which this Python does not have.",
            "Run blender --background -P batch.py -- export ..., pip install bpy, or omit the"
            " format.",
        )
    result, out = result_of(options.job), real_path(options.out)
    own = [f for f in formats if f not in BLENDER_FORMATS]
    if own:
        request = {
            "result": str(result), "out": str(out), "formats": own, "placed": options.placed,
            "regions": options.region, "levels": options.lods, "shading": options.shading,
        }  # fmt: skip
        code = run_in_worker(
            request, python=worker_python(), module="jobs.commands.export_files", what="export"
        )
        if code:
            return code
    if by_blender:
        from ..ops.export import ObjectExport, export_result

        requests = [ObjectExport(f, out, options.placed, options.pack) for f in by_blender]
        paths = export_result(
            result, requests,
            regions=tuple(options.region), levels=options.lods, shading=options.shading,
        )  # fmt: skip
        for path in paths:
            _logger.info("written: %s", path)
    return 0


def add_convert_region(commands: Commands) -> None:
    """Add ``convert-region``."""
    parser = commands.add_parser(
        "convert-region", help="convert a region file: JSON, or .rsbox of RealityScan"
    )
    parser.add_argument("input", type=Path, metavar="FILE")
    parser.add_argument("output", type=Path, metavar="OUT", help="ends with .json or .rsbox")
    parser.set_defaults(run=_convert_region)


def _convert_region(options: Namespace) -> int:
    from ..core.errors import EXIT_DONE, UsageError
    from ..core.regions.files import SUFFIXES, read_region_file, write_region_file

    output: Path = options.output
    if output.suffix.lower() not in (".json", *SUFFIXES):
        raise UsageError(f"{output.name} names no format.", "Let it end with .json or .rsbox.")
    region = read_region_file(options.input)
    if not output.parent.is_dir():
        raise UsageError(f"{output.parent} is no folder.", "Make it first.")
    write_region_file(output, region.name, region.vertices)
    _logger.info("written: %s", output)
    return EXIT_DONE

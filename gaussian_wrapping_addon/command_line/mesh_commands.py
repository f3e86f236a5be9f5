# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands that make or write meshes of a finished training.

``mesh``, ``estimate-mesh``, ``bake``, ``export`` and ``convert-region``.
"""

from __future__ import annotations

import logging
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import EXIT_DONE, UsageError
from ..core.files import read_json, real_path
from ..core.jobs.store.job_folder import JobFolder
from ..core.names import (
    AUTOMATIC_REGIONS,
    BLENDER_FORMATS,
    EXPORT_FORMATS,
    RESULT_FORMATS,
    SHADINGS,
)
from ..core.settings import (
    UP_AXES,
    UV_CHOICES,
    Declaration,
    JobSettings,
    MeshingSettings,
    TextureSettings,
    to_json,
)
from .job_commands import has_bpy, run_in_worker, run_job, watch
from .options import (
    Commands,
    add_device,
    add_no_blend,
    add_options,
    add_out,
    add_threads,
    declared_options,
    given_path,
    given_settings,
    method_settings,
    region_settings,
)

if TYPE_CHECKING:
    from ..core.jobs.client import JobClient
    from ..core.jobs.store.job_file import JobFile

_logger = logging.getLogger("gaussian_wrapping")


def add_mesh(commands: Commands) -> None:
    parser = commands.add_parser(
        "mesh", help="mesh another region or resolution of a finished training"
    )
    add_out(parser)
    add_options(parser, declared_options("method", "region"))
    add_threads(parser)
    add_device(parser)
    add_no_blend(parser)
    parser.set_defaults(run=_mesh)


def _mesh(options: Namespace) -> int:
    from ..core.jobs.store.job_file import make_job

    earlier = _trained(options.out)
    job = make_job("mesh", Path(earlier.source), region_settings(earlier.settings, options))
    return run_job(job, options)


def _trained(out: Path) -> JobFile:
    """Return the job of a folder. Raises WrapError: it holds none, or no finished training."""
    from ..core.jobs.store.rollback import finished_job, no_finished_training
    from ..core.jobs.store.stage_folder import read_done

    folder = JobFolder(real_path(out))
    earlier = finished_job(folder)
    if not any(read_done(path) for path in folder.stages.glob("train-*")):
        raise no_finished_training(out)
    return earlier


def add_estimate_mesh(commands: Commands) -> None:
    parser = commands.add_parser(
        "estimate-mesh", help="estimate triangles, time and memory of a region's mesh"
    )
    parser.add_argument("--region", default="auto", metavar="auto|all|REGION.json")
    add_out(parser)
    add_options(parser, declared_options("method"))
    add_threads(parser)
    parser.set_defaults(run=_estimate_mesh)


def _estimate_mesh(options: Namespace) -> int:

    meshing = MeshingSettings(**method_settings(options))
    JobSettings(meshing=meshing, threads=options.threads).validated()
    region = options.region
    request = {
        "out": str(real_path(options.out)), "meshing": to_json(meshing), "threads": options.threads,
        "region": region if region in AUTOMATIC_REGIONS else str(real_path(region)),
    }  # fmt: skip
    return run_in_worker(request, module="jobs.commands.estimate_mesh_command", what="estimate")


def _texture_options() -> list[Declaration]:
    """Return the texture settings that baking uses: no levels of detail are made."""
    textures = (entry for entry in declared_options("region") if entry.group == "texture")
    return [entry for entry in textures if entry.name != "lods"]


def add_bake(commands: Commands) -> None:
    parser = commands.add_parser(
        "bake", help="bake the photos onto an edited, retopologised or foreign mesh"
    )
    add_out(parser)
    parser.add_argument(
        "--mesh", type=given_path, required=True, metavar="FILE", help="OBJ, PLY, GLB, STL or OFF"
    )
    parser.add_argument(
        "--name", default="", metavar="NAME", help="folder below DIR/baked (default: as the file)"
    )
    parser.add_argument(
        "--uvs", choices=UV_CHOICES, default="auto",
        help="auto: the mesh's own UVs if it has any; new: unwrap it",
    )  # fmt: skip
    parser.add_argument(
        "--faces", type=int, default=0, metavar="N",
        help="decimate to N faces first; the detail removed becomes a normal map",
    )  # fmt: skip
    parser.add_argument(
        "--dense", type=given_path, metavar="FILE", help="mesh whose detail becomes a normal map"
    )
    parser.add_argument(
        "--sidecar", type=given_path, metavar="FILE.json",
        help="sidecar of the exported file that the mesh was made from (default: beside it)",
    )  # fmt: skip
    parser.add_argument(
        "--up", choices=UP_AXES, default="auto",
        help="up axis of files without a sidecar (auto: y for GLB and OBJ, z for others)",
    )  # fmt: skip
    add_options(parser, _texture_options())
    parser.add_argument(
        "--export", default="glb", metavar="FORMATS",
        help=f"comma separated, of {','.join(RESULT_FORMATS)} (default: glb)",
    )  # fmt: skip
    add_threads(parser)
    parser.set_defaults(run=_bake)


def _bake(options: Namespace) -> int:
    from ..core.jobs.client import JobClient, worker_python
    from ..core.jobs.store.job_file import BakeRequest, make_bake_job

    given = given_settings(options, _texture_options())
    values = {path.removeprefix("texture."): value for path, value in given.items()}
    if options.dense is not None:
        values = {"normal_map": "on"} | values
    texture = TextureSettings(**values)
    JobSettings(texture=texture, threads=options.threads).validated()
    request = BakeRequest(
        mesh=str(real_path(options.mesh)), name=options.name or options.mesh.stem,
        sidecar=str(real_path(options.sidecar)) if options.sidecar else "",
        up=options.up, uvs=options.uvs, faces=options.faces,
        dense=str(real_path(options.dense)) if options.dense else "", texture=texture,
        export=tuple(dict.fromkeys(f for f in options.export.split(",") if f)),
    )  # fmt: skip
    job = make_bake_job(_trained(options.out), request)
    job = replace(job, settings=replace(job.settings, threads=options.threads))
    return follow_bake(JobClient.start(options.out, job, python=worker_python()), job)


def follow_bake(client: JobClient, job: JobFile) -> int:
    """Show the progress of a bake, then its figures; return the exit code."""
    code = watch(client)
    if code == EXIT_DONE and job.bake is not None:
        _say_figures(client.folder.baked / job.bake.name)
    return code


def _say_figures(folder: Path) -> None:
    """Log where the files are, and what was measured."""
    figures = read_json(folder / "bake.json")
    texture = figures["texture"]
    psnr = figures["mesh_rendering"].get("psnr")
    uvs = "its own" if texture["unwrap"] == "own" else "new"
    _logger.info("results: %s", folder)
    _logger.info(
        "  %d faces, %s UVs, %d x %d px, photos see %.1f %%%s",
        figures["faces"], uvs, texture["atlases"], texture["size_px"], 100 * texture["coverage"],
        "" if psnr is None else f", {psnr:.1f} dB beside the photos",
    )  # fmt: skip
    for warning in texture["warnings"]:
        _logger.info("warning: %s %s", warning["text"], warning["hint"])


def add_export(commands: Commands) -> None:
    parser = commands.add_parser(
        "export", help="export meshes of a finished job for other programs"
    )
    parser.add_argument(
        "job", type=given_path, metavar="JOB", help="job folder, or its result folder"
    )
    parser.add_argument(
        "--format", default="glb",
        help=f"comma separated, of {','.join(EXPORT_FORMATS)}; "
        f"{' and '.join(BLENDER_FORMATS)} need bpy or Blender",
    )  # fmt: skip
    parser.add_argument("--out", type=given_path, required=True, metavar="FOLDER")
    parser.add_argument(
        "--placed", action="store_true",
        help="coordinates as placed in Blender, instead of the input's world",
    )  # fmt: skip
    parser.add_argument("--region", nargs="+", action="extend", metavar="NAME", default=[])
    parser.add_argument("--lods", action="store_true", help="levels of detail too")
    parser.add_argument(
        "--shading", choices=SHADINGS, default="auto",
        help="shading of the material; auto: lit, but unlit for GLB without a normal or occlusion "
        "map",
    )  # fmt: skip
    parser.add_argument("--pack", action="store_true", help="pack textures into USD and FBX files")
    parser.set_defaults(run=_export)


def _export(options: Namespace) -> int:
    from ..core.jobs.commands.export_files import result_of

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
        code = run_in_worker(request, module="jobs.commands.export_files", what="export")
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
    parser = commands.add_parser(
        "convert-region", help="convert a region file: JSON, or .rsbox of RealityScan"
    )
    parser.add_argument("input", type=given_path, metavar="FILE")
    parser.add_argument("output", type=given_path, metavar="OUT", help="ends with .json or .rsbox")
    parser.set_defaults(run=_convert_region)


def _convert_region(options: Namespace) -> int:
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

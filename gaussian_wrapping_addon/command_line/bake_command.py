# SPDX-License-Identifier: GPL-3.0-or-later
"""The command ``bake``: the photos of a finished job onto a mesh from elsewhere."""

from __future__ import annotations

import logging
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .common import Commands, add_out, add_threads
from .follow import watch
from .options.setting_options import add_option, declared_options

if TYPE_CHECKING:
    from ..core.jobs.client import JobClient
    from ..core.jobs.store.job_file import JobFile
    from ..core.settings import Declaration

_logger = logging.getLogger("gaussian_wrapping")


def _texture_options() -> list[Declaration]:
    """Return the texture settings that baking uses: no levels of detail are made."""
    return [
        entry
        for entry in declared_options("region")
        if entry.group == "texture" and entry.name != "lods"
    ]


def add_bake(commands: Commands) -> None:
    """Add ``bake``."""
    from ..core.names import RESULT_FORMATS
    from ..core.settings import UP_AXES, UV_CHOICES

    parser = commands.add_parser(
        "bake", help="bake the photos onto an edited, retopologised or foreign mesh"
    )
    add_out(parser)
    parser.add_argument(
        "--mesh", type=Path, required=True, metavar="FILE", help="OBJ, PLY, GLB, STL or OFF"
    )
    parser.add_argument(
        "--name",
        default="",
        metavar="NAME",
        help="folder below DIR/baked (default: as the file)",
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
        "--dense", type=Path, metavar="FILE", help="mesh whose detail becomes a normal map"
    )
    parser.add_argument(
        "--sidecar", type=Path, metavar="FILE.json",
        help="sidecar of the exported file that the mesh was made from (default: beside it)",
    )  # fmt: skip
    parser.add_argument(
        "--up", choices=UP_AXES, default="auto",
        help="up axis of files without a sidecar (auto: y for GLB and OBJ, z for others)",
    )  # fmt: skip
    for entry in _texture_options():
        add_option(parser, entry)
    parser.add_argument(
        "--export", default="glb", metavar="FORMATS",
        help=f"comma separated, of {','.join(RESULT_FORMATS)} (default: glb)",
    )  # fmt: skip
    add_threads(parser)
    parser.set_defaults(run=_bake)


def _texture(options: Namespace) -> dict[str, Any]:
    values = {}
    for entry in _texture_options():
        assert entry.option is not None
        value = getattr(options, entry.path)
        if value is not None:
            values[entry.name] = entry.option.parse(value) if entry.option.parse else value
    if options.dense is not None and "normal_map" not in values:
        values["normal_map"] = "on"
    return values


def _bake(options: Namespace) -> int:
    from dataclasses import replace

    from ..core.files import real_path
    from ..core.jobs.client import JobClient, worker_python
    from ..core.jobs.store.job_file import BakeRequest, make_bake_job
    from ..core.jobs.store.job_folder import JobFolder
    from ..core.jobs.store.rollback import finished_job, no_finished_training
    from ..core.jobs.store.stage_folder import read_done
    from ..core.settings import JobSettings, TextureSettings

    texture = TextureSettings(**_texture(options))
    JobSettings(texture=texture, threads=options.threads).validated()
    request = BakeRequest(
        mesh=str(real_path(options.mesh)),
        name=options.name or options.mesh.stem,
        sidecar=str(real_path(options.sidecar)) if options.sidecar else "",
        up=options.up,
        uvs=options.uvs,
        faces=options.faces,
        dense=str(real_path(options.dense)) if options.dense else "",
        texture=texture,
        export=tuple(dict.fromkeys(f for f in options.export.split(",") if f)),
    )
    folder = JobFolder(real_path(options.out))
    earlier = finished_job(folder)
    if not any(read_done(path) for path in folder.stages.glob("train-*")):
        raise no_finished_training(options.out)
    job = make_bake_job(earlier, request)
    job = replace(job, settings=replace(job.settings, threads=options.threads))
    return follow_bake(JobClient.start(options.out, job, python=worker_python()), job)


def follow_bake(client: JobClient, job: JobFile) -> int:
    """Show the progress of a bake, then its figures; return the exit code."""
    from ..core.errors import EXIT_DONE

    code = watch(client)
    if code == EXIT_DONE and job.bake is not None:
        _say_figures(client.folder.baked / job.bake.name)
    return code


def _say_figures(folder: Path) -> None:
    """Log where the files are, and what was measured."""
    from ..core.files import read_json

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

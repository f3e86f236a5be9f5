# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands ``mesh`` and ``estimate-mesh``: mesh a finished training."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from .common import Commands, add_device, add_no_blend, add_out, add_threads
from .follow import follow, require_bpy
from .options.meshing_options import (
    add_method_options,
    add_region_options,
    method_settings,
    region_settings,
)


def add_mesh(commands: Commands) -> None:
    """Add ``mesh``."""
    parser = commands.add_parser(
        "mesh", help="mesh another region or resolution of a finished training"
    )
    add_out(parser)
    add_method_options(parser)
    add_region_options(parser)
    add_threads(parser)
    add_device(parser)
    add_no_blend(parser)
    parser.set_defaults(run=_mesh)


def _mesh(options: Namespace) -> int:
    from ..core.files import real_path
    from ..core.jobs.client import JobClient, worker_python
    from ..core.jobs.commands.device_check import require_device
    from ..core.jobs.store.job_file import make_job
    from ..core.jobs.store.job_folder import JobFolder
    from ..core.jobs.store.rollback import finished_job, no_finished_training
    from ..core.jobs.store.stage_folder import read_done

    folder = JobFolder(real_path(options.out))
    earlier = finished_job(folder)
    if not any(read_done(path) for path in folder.stages.glob("train-*")):
        raise no_finished_training(options.out)
    job = make_job("mesh", Path(earlier.source), region_settings(earlier.settings, options))
    require_bpy(job, options)
    require_device(job.settings.device)
    return follow(JobClient.start(options.out, job, python=worker_python()), job, options)


def add_estimate_mesh(commands: Commands) -> None:
    """Add ``estimate-mesh``."""
    parser = commands.add_parser(
        "estimate-mesh", help="estimate triangles, time and memory of a region's mesh"
    )
    parser.add_argument("--region", default="auto", metavar="auto|all|REGION.json")
    add_out(parser)
    add_method_options(parser)
    add_threads(parser)
    parser.set_defaults(run=_estimate_mesh)


def _estimate_mesh(options: Namespace) -> int:
    from ..core.files import real_path
    from ..core.jobs.client import worker_python
    from ..core.jobs.commands.run_in_worker import run_in_worker
    from ..core.names import AUTOMATIC_REGIONS
    from ..core.settings import JobSettings, MeshingSettings, to_json

    meshing = MeshingSettings(**method_settings(options))
    JobSettings(meshing=meshing, threads=options.threads).validated()
    region = options.region
    request = {
        "out": str(real_path(options.out)),
        "region": region if region in AUTOMATIC_REGIONS else str(real_path(region)),
        "meshing": to_json(meshing),
        "threads": options.threads,
    }
    return run_in_worker(
        request,
        python=worker_python(),
        module="jobs.commands.estimate_mesh_command",
        what="estimate",
    )

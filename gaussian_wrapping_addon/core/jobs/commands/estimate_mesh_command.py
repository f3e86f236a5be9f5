# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``estimate-mesh`` command: triangles, time and memory of a finished training's mesh."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ...errors import MeshingError, UsageError
from ...names import AUTOMATIC_REGIONS
from ...parallel import default_threads
from ...progress import Progress, ReportWarning
from ...settings import MeshingSettings, from_json
from ..stages.cameras import scene_stage_name
from ..stages.meshing import (
    estimate_region_mesh,
    estimate_region_pivots,
    field_views,
    free_bytes,
    requested_region,
)
from ..store.job_file import read_job
from ..store.job_folder import JobFolder
from ..store.rollback import finished_job, no_finished_training
from ..store.stage_folder import read_done
from .run_in_worker import run_command

MAX_VIEWS = 24
"""Maximum number of cameras that sample the surface: more cover little more of it."""
MAX_DEPTH_SAMPLES = 60_000


def main(arguments: list[str]) -> int:
    """Estimate ``arguments = [{"out", "region", "meshing", "threads"} as JSON]``."""
    return run_command(lambda: _estimate(json.loads(arguments[0])))


def _newest_stage(stages: Path, name: str) -> Path:
    """Return the folder of the stage that was finished last."""
    done = [(values["finished_unix_s"], path) for path in sorted(stages.glob(f"{name}-*"))
            if (values := read_done(path)) is not None]  # fmt: skip
    if not done:
        raise no_finished_training(stages.parent)
    return max(done)[1]


def _estimate(request: dict[str, Any]) -> list[str | ReportWarning]:
    from ...field.samples import sample_depth_maps
    from ...field.vacancy import VacancyField
    from ...gaussians.files import load_gaussians
    from ...gaussians.model import without_blur
    from ...meshing.spacing import checked_request
    from ...photos.store import PhotoStore
    from ...regions.files import parse_region_file, read_region_body
    from ...scene.frames import snapped_length
    from ...scene.scene import load_refined_scene

    folder = JobFolder(Path(request["out"]))
    if not folder.is_job():
        raise UsageError(f"{folder.root} holds no job.", "Choose the folder given as --out.")
    folder.check_entries()
    meshing = from_json(MeshingSettings, request["meshing"], "meshing")
    threads = int(request["threads"]) or default_threads()
    wanted, body = request["region"], None
    if wanted not in AUTOMATIC_REGIONS:
        body = read_region_body(Path(wanted))
        parse_region_file(body, Path(wanted))  # raises before anything is loaded
    trained = _newest_stage(folder.stages, "train")
    scene_stage = _newest_stage(folder.stages, scene_stage_name(finished_job(folder)))
    scene = load_refined_scene(scene_stage, trained)
    training = read_job(folder.job_path).settings.training
    trained_ones = load_gaussians(trained / "gaussians.npz")
    whole = trained_ones.arrays() if wanted == "all" else None
    region, _ = requested_region(wanted, body, scene, whole)
    gaussians = without_blur(trained_ones, meshing.blur_variance, training.filter_variance)
    arrays = gaussians.arrays()
    photos = PhotoStore(scene, training.max_image_px)
    views = field_views(scene, photos, training.holdout_every, meshing.cameras)
    cameras = [scene.views[index].camera for index in views]
    edge_length = snapped_length(meshing.edge_length / scene.world_from_scene.scale)
    notes = checked_request(edge_length, meshing.points, region).notes  # raises before any work
    depth_samples = sample_depth_maps(
        gaussians, cameras[:: max(1, -(-len(cameras) // MAX_VIEWS))],
        lambda points: region.contains(points, 0.0), Progress(),
        most=MAX_DEPTH_SAMPLES, threads=threads,
    )  # fmt: skip
    if len(depth_samples) == 0:
        raise MeshingError(
            f"The cameras see no surface in region {region.name!r}.",
            "Draw the region around something that was photographed.",
        )
    vacancy = VacancyField(arrays, cameras, threads=threads)
    memory_bytes = free_bytes(folder.root)
    if meshing.method == "pivots":
        by_pivots = estimate_region_pivots(vacancy, arrays, region, meshing, depth_samples)
        by_pivots.refuse(memory_bytes)
        return [*by_pivots.lines()]
    expected = estimate_region_mesh(vacancy, region, meshing, edge_length, depth_samples)
    tiled = meshing.tiles != "off" and (meshing.tiles != "auto" or expected.tiles_for(memory_bytes))
    expected.refuse(memory_bytes, tiled=tiled)
    mode = "it would be meshed in tiles" if tiled else "it would be meshed whole"
    return [*expected.lines(), mode, *notes]

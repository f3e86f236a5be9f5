# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs of a row of spheres with known cameras, whose training is divided into blocks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from PIL import Image

from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.stage_folder import (
    STAGE_VERSIONS,
    Stage,
    read_done,
    source_fingerprint,
    stage_key,
)
from gaussian_wrapping_addon.core.scene.scene import save_scene
from gaussian_wrapping_addon.core.settings import JobSettings, MeshingSettings, TextureSettings
from tests.core.jobs.finished_sphere import write_cube
from tests.core.training.row_scene import SETTINGS, row_scene

TRAINING = dataclasses.replace(
    SETTINGS, iterations=120, blocks=2, checkpoint_every_s=0.2, region_weight=1.0
)


def row_job(root: Path, **changes: object) -> tuple[JobFolder, JobFile]:
    """Write the photos and their finished cameras; return the folder and the job that trains."""
    scene, photos = row_scene()
    images = root / "photos"
    images.mkdir(parents=True)
    views = []
    for view, pixels in zip(scene.views, photos.photos, strict=True):
        path = images / view.camera.name
        Image.fromarray(pixels).save(path)
        views.append(dataclasses.replace(view, photo_path=path))
    settings = JobSettings(
        training=dataclasses.replace(TRAINING, **changes), texture=TextureSettings(size_px=128),
        meshing=MeshingSettings(points=300), export=("ply",), threads=1,
        regions=(str(write_cube(root / "ball.json")),),
    )  # fmt: skip
    job = make_job("wrap", images, settings)
    folder = JobFolder(root / "out")
    folder.create()
    write_job(folder.job_path, job)
    key = stage_key(
        STAGE_VERSIONS["cameras"], job.source, source_fingerprint(images), settings.seed
    )
    cameras = folder.stages / f"cameras-{key}"
    cameras.mkdir()
    write_json(cameras / "done.json", {"finished_unix_s": 1.0, "seconds": 1.0, "warnings": []})
    save_scene(dataclasses.replace(scene, views=tuple(views)), cameras)
    return folder, job


def cameras_of(folder: JobFolder) -> Stage:
    """Return the stage that :func:`row_job` has written."""
    (path,) = folder.stages.glob("cameras-*")
    return Stage("cameras", path.name.partition("-")[2], path, read_done(path) or {}, True)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Make a finished job without training: Gaussians on a sphere, in stage folders."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from PIL import Image

from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.gaussians.files import save_gaussians
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, training_keys, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.jobs.store.stage_folder import (
    STAGE_VERSIONS,
    source_fingerprint,
    stage_key,
)
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.scene import save_scene
from gaussian_wrapping_addon.core.settings import JobSettings, TextureSettings
from tests.core.meshing.meshing_scenes import cube
from tests.core.training.small_scene import sphere_gaussians, sphere_scene

RADIUS = 1.0


def write_finished_sphere(root: Path) -> JobFolder:
    """Write the photos of a sphere at the origin, and the job folder of its finished training."""
    scene, photos = sphere_scene()
    images = root / "photos"
    images.mkdir(parents=True)
    views = []
    for view, pixels in zip(scene.views, photos.photos, strict=True):
        path = images / view.camera.name
        Image.fromarray(pixels).save(path)
        views.append(replace(view, photo_path=path))
    settings = JobSettings(texture=TextureSettings(size_px=128), export=("ply",))
    job = make_job("wrap", images, settings)
    folder = JobFolder(root / "out")
    folder.create()
    write_job(folder.job_path, job)
    key = stage_key(
        STAGE_VERSIONS["cameras"], job.source, source_fingerprint(images), settings.seed
    )
    cameras = folder.stages / f"cameras-{key}"
    training = folder.stages / (f"train-{training_keys(key, job)[0]}")
    for number, stage in enumerate((cameras, training)):
        stage.mkdir()
        done = {"finished_unix_s": 1.0 + number, "seconds": 1.0, "held_out": [], "warnings": []}
        write_json(stage / "done.json", {**done, "history": [], "decisions": [], "pictures": []})
    save_scene(replace(scene, views=tuple(views)), cameras)
    save_gaussians(training / "gaussians.npz", sphere_gaussians(600))
    folder.write_status(JobStatus("DONE", result=str(folder.result)))
    return folder


def write_cube(path: Path, half: float = 1.4) -> Path:
    """Write the region file of a cube around the sphere, named as the file."""
    write_region(path, Region(path.stem, cube(half).vertices))
    return path

# SPDX-License-Identifier: GPL-3.0-or-later
"""What is fuzzed: a good input, the files of it that are changed, and who reads them."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from gaussian_wrapping_addon.core.errors import WrapError
from gaussian_wrapping_addon.core.gaussians.files import load_gaussians, read_foreign_splat
from gaussian_wrapping_addon.core.jobs.commands.export_files import ExportRequest, export_files
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.rollback import finished_job, roll_back
from gaussian_wrapping_addon.core.loading.check import check_input
from gaussian_wrapping_addon.core.photos.exif import read_lens_exif
from gaussian_wrapping_addon.core.photos.formats import read_photo_header
from gaussian_wrapping_addon.core.photos.photo_file import read_mask, read_photo
from gaussian_wrapping_addon.core.readers.colmap import read_colmap
from gaussian_wrapping_addon.core.readers.transforms import read_transforms
from gaussian_wrapping_addon.core.regions.files import read_region_file
from gaussian_wrapping_addon.core.regions.scene_regions import read_region
from gaussian_wrapping_addon.core.scene.scene import load_saved_scene
from tests.hostile.case import Build
from tests.hostile.cases.splats import splat
from tests.hostile.fuzz.mutations import BYTES, JSON, TEXT, Mutation, revalued
from tests.hostile.inputs import colmap, json_file, region, steps, transforms
from tests.hostile.jobs import JOB, locked_by, sphere, this_process, trained, with_result


@dataclass(frozen=True)
class Target:
    """One kind of input."""

    name: str
    build: Build
    """Makes the good input."""
    files: tuple[str, ...]
    """Those that are changed, one at a time; patterns."""
    mutations: tuple[Mutation, ...]
    reads: tuple[Callable[[Path], object], ...]
    """Each is given the folder of the input, and ends or raises a typed error."""
    budget: int
    """Changed inputs of each run of the tests."""


def _check(name: str) -> Callable[[Path], object]:
    def check(folder: Path) -> None:
        for finding in check_input(folder / name):
            if finding.severity == "error" and not finding.hint:
                raise AssertionError(f"no next step: {finding.message}")

    return check


def _finite_model(folder: Path) -> None:
    """What the reader passes has finite numbers."""
    model = read_colmap(folder / "set")
    assert np.isfinite(model.points).all()
    assert all(np.isfinite(photo.cam_from_world).all() for photo in model.photos)
    assert all(photo.lens is not None and not photo.lens.problem() for photo in model.photos)


def _transforms(folder: Path) -> None:
    model = read_transforms(folder / "set" / "transforms.json")
    assert all(np.isfinite(photo.cam_from_world).all() for photo in model.photos)


def _finite_splat(folder: Path) -> None:
    for name, tensor in read_foreign_splat(folder / "set.ply").gaussians.tensors():
        assert bool(tensor.isfinite().all()), name


_PHOTO_NAMES = ("a.jpg", "a.png", "a.webp", "a.tif", "a.bmp", "rotated.jpg")


def _photos(folder: Path) -> None:
    """Write photos of all formats, and one with EXIF entries."""
    pixels = np.random.default_rng(6).integers(0, 255, (24, 32, 3)).astype(np.uint8)
    image = Image.fromarray(pixels)
    for name in _PHOTO_NAMES[:-1]:
        image.save(folder / name)
    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x920A], exif[0xA405] = 6, "Maker", 35.0, 50
    image.save(folder / _PHOTO_NAMES[-1], exif=exif)


def _read_photos(folder: Path) -> None:
    """Read the photos in each way, whatever another way said of them."""
    failure: WrapError | None = None
    for name in _PHOTO_NAMES:
        path = folder / name
        for read in (read_photo_header, read_photo, read_mask):
            try:
                read(path)
            except WrapError as error:
                failure = error
        read_lens_exif(path, 32, 24)
    if failure is not None:
        raise failure


def _job(folder: Path) -> None:
    steps(trained, locked_by(this_process))(folder)
    job = json.loads((folder / JOB / "job.json").read_text())
    kept = {"job": job, "status": {"state": "DONE"}, "stages": ["train-a"]}
    json_file(f"{JOB}/job-finished.json", kept)(folder)


def _look_at_job(folder: Path) -> None:
    """Look at the status and the lock as Blender's main thread does: never an error."""
    job = JobFolder(folder / JOB)
    job.read_status()
    job.locked()
    roll_back(job)


def _zip(data: bytes, random: np.random.Generator) -> bytes:
    """Change an array of a file of arrays and give it a checksum that is right."""
    if not zipfile.is_zipfile(io.BytesIO(data)):  # a JSON file beside the arrays
        return revalued(data, random)
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(stream, "w") as changed:
        names = archive.namelist()
        chosen = names[int(random.integers(len(names)))]
        for name in names:
            content = archive.read(name)
            if name == chosen:
                content = BYTES[int(random.integers(len(BYTES)))](content, random)
            changed.writestr(name, content)
    return stream.getvalue()


def _export(folder: Path) -> None:
    """Export the result as it is placed in Blender."""
    new = folder / "new"
    shutil.rmtree(new, ignore_errors=True)
    request = ExportRequest(folder / JOB / "result", new, ("ply", "glb"), placed=True)
    for path in export_files(request):
        assert path.stat().st_size > 0


_MODEL = "set/sparse/0"
TARGETS = (
    Target(
        "colmap-binary",
        colmap(points=12),
        (f"{_MODEL}/cameras.bin", f"{_MODEL}/images.bin", f"{_MODEL}/points3D.bin"),
        BYTES,
        (_finite_model, _check("set")),
        400,
    ),
    Target(
        "colmap-text",
        colmap(points=12, text=True),
        (f"{_MODEL}/cameras.txt", f"{_MODEL}/images.txt", f"{_MODEL}/points3D.txt"),
        TEXT,
        (_finite_model, _check("set")),
        400,
    ),
    Target(
        "transforms",
        transforms(),
        ("set/transforms.json",),
        JSON,
        (_transforms, _check("set")),
        400,
    ),
    Target(
        "splat",
        splat(),
        ("set.ply",),
        (*BYTES, *TEXT),
        (_finite_splat, _check("set.ply")),
        300,
    ),
    Target(
        "splat-text",
        splat(format="ascii"),
        ("set.ply",),
        TEXT,
        (_finite_splat, _check("set.ply")),
        150,
    ),
    Target(
        "region",
        json_file("box.json", region()),
        ("box.json",),
        JSON,
        (
            lambda folder: read_region(folder / "box.json"),
            lambda folder: read_region_file(folder / "box.json"),
        ),
        500,
    ),
    Target(
        "job",
        _job,
        (f"{JOB}/job.json", f"{JOB}/status.json", f"{JOB}/lock.json", f"{JOB}/job-finished.json"),
        JSON,
        (
            lambda folder: read_job(folder / JOB / "job.json"),
            lambda folder: finished_job(JobFolder(folder / JOB)),
            _look_at_job,
        ),
        500,
    ),
    Target(
        "arrays",
        sphere,
        (f"{JOB}/stages/*/gaussians.npz", f"{JOB}/stages/*/points.npz"),
        (*BYTES, _zip, _zip, _zip),
        (
            lambda folder: load_gaussians(next(folder.glob(f"{JOB}/stages/*/gaussians.npz"))),
            lambda folder: load_saved_scene(next(folder.glob(f"{JOB}/stages/cameras-*"))),
        ),
        250,
    ),
    Target(
        "scene",
        sphere,
        (f"{JOB}/stages/cameras-*/scene.json",),
        JSON,
        (lambda folder: load_saved_scene(next(folder.glob(f"{JOB}/stages/cameras-*"))),),
        250,
    ),
    Target(
        "result",
        with_result,
        (f"{JOB}/result/auto/mesh.npz", f"{JOB}/result/scene.json", f"{JOB}/result/placement.json"),
        (*BYTES, _zip, _zip),
        (_export,),
        300,
    ),
    Target("photos", _photos, _PHOTO_NAMES, BYTES, (_read_photos,), 250),
)

# SPDX-License-Identifier: GPL-3.0-or-later
"""A whole job, from photos to a textured mesh, on an emulated GPU and on the processor."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from gaussian_wrapping_addon.core.devices import choice
from gaussian_wrapping_addon.core.field import cuda_vacancy
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.jobs.runner import run_job
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.render.cuda import device_renderer
from gaussian_wrapping_addon.core.render.cuda.device_renderer import DeviceRenderer
from gaussian_wrapping_addon.core.scene.scene import Scene
from gaussian_wrapping_addon.core.settings import (
    JobSettings,
    MeshingSettings,
    TextureSettings,
    TrainingSettings,
)
from gaussian_wrapping_addon.core.training import device_backend, estimate
from gaussian_wrapping_addon.core.training import start as point_start
from gaussian_wrapping_addon.core.training.splat_start import transform_gaussians
from tests.core.jobs.transforms_file import write_transforms
from tests.core.render.cuda.emulation import EmulatedKernels
from tests.core.training.device_training import emulated_backend, perturbed_sphere
from tests.core.training.small_scene import sphere_scene

SIZE_PX, TRAINED_PX = 64, 32
REGION_RADIUS = 1.35
"""Of the region, an icosphere: all of it is in view. A cube's corners are not: a bit decides what
they are, and before the background they move the textured mesh's PSNR by decibels."""

SETTINGS = JobSettings(
    training=TrainingSettings(
        iterations=40, short_run_power=0.0, max_gaussians=450, sh_degree=1, densify_every=10,
        depth_from=0.2, max_image_px=TRAINED_PX,
        multi_view_pixels=60, multi_view="on", lambda_geometric=0.0, harmonics="on",
        wrapping="on", wrap_rounds=1, dense_start="off", holdout_every=3,
    ),
    meshing=MeshingSettings(points=1000),
    texture=TextureSettings(size_px=128),
    export=("ply",),
)  # fmt: skip


class EmulatedField(cuda_vacancy.CudaVacancyField):
    """The GPU's field with its kernels on the host; says that it is where it was asked to be."""

    kernels: EmulatedKernels

    def __init__(self, arrays: Any, cameras: Any, *, device: str, **options: Any) -> None:
        super().__init__(
            arrays, cameras, device="cpu", kernels=type(self).kernels,
            device_cache_bytes=1 << 30, **options,
        )  # fmt: skip
        self.device = device


def emulate(monkeypatch: pytest.MonkeyPatch, library: Path) -> None:
    """Make this machine one with a GPU whose kernels are emulated."""
    kernels = EmulatedKernels(library)
    monkeypatch.setattr(choice, "_usable", lambda index: (True, "It passed."))
    monkeypatch.setattr(choice, "_card", lambda index: "Some GPU")
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda index: (4 << 30, 8 << 30))
    monkeypatch.setattr(estimate, "speeds", lambda threads, device: (1.0, 1.0))
    monkeypatch.setattr(
        device_backend,
        "chosen_backend",
        lambda device, threads, **_: emulated_backend(kernels, device),
    )
    monkeypatch.setattr(
        device_renderer, "device_renderer",
        lambda device: DeviceRenderer(kernels, torch.device("cpu"), lambda: 1 << 28),
    )  # fmt: skip
    monkeypatch.setattr(EmulatedField, "kernels", kernels, raising=False)
    monkeypatch.setattr(cuda_vacancy, "CudaVacancyField", EmulatedField)


def start_near(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start trainings near the sphere, on Gaussians whose gradients are not rounding.

    The few iterations that an emulated device has time for find no surface from sparse points, and
    where there is none, a mesh depends on every bit of the Gaussians.
    """

    def start(scene: Scene, *_: Any, **__: Any) -> OrientedGaussians:
        near = perturbed_sphere(400, 1, factor=0.05, opacity=0.97)
        moved = transform_gaussians(near, scene.world_from_scene.inverse())
        return OrientedGaussians(**{name: t.float() for name, t in moved.tensors()})

    monkeypatch.setattr(point_start, "initial_gaussians", start)


def write_photos(folder: Path) -> Path:
    """Write the photos of a sphere of radius 1 with their cameras and sparse points."""
    scene, photos = sphere_scene(views=12, size_px=SIZE_PX)
    (folder / "images").mkdir(parents=True)
    for camera, pixels in zip(scene.cameras, photos.photos, strict=True):
        Image.fromarray(pixels).save(folder / "images" / camera.name)
    write_transforms(folder, scene.cameras, scene.points)
    return folder


def finished(source: Path, out: Path, device: str) -> tuple[dict[str, Any], trimesh.Trimesh]:
    """Run the job; return its report and the mesh."""
    region = Region("ball", np.asarray(trimesh.creation.icosphere(1, REGION_RADIUS).vertices))
    path = source.parent / "ball.json"
    write_region(path, region)
    settings = dataclasses.replace(SETTINGS, device=device, regions=(str(path),))
    folder = JobFolder(out)
    folder.create()
    job = make_job("wrap", source, settings)
    write_job(folder.job_path, job)
    run_job(folder, job, lambda event: None, lambda: False)
    report = json.loads((folder.result / "report.json").read_text())
    return report, trimesh.load(folder.result / "ball" / "mesh.ply", process=False)


def distances(mesh: trimesh.Trimesh, other: trimesh.Trimesh) -> np.ndarray:
    """Return the distances of a mesh's points from another mesh."""
    points = np.concatenate([mesh.vertices, mesh.sample(4000, seed=1)])
    return np.asarray(trimesh.proximity.closest_point(other, points)[1])


def mean_psnr(report: dict[str, Any]) -> float:
    """Return how well the textured mesh shows the held-out photos."""
    return float(report["regions"]["ball"]["mesh_rendering"]["psnr"])


@pytest.mark.proof
def test_the_mesh_of_a_gpu_is_that_of_the_processor(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    emulator_library: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    source = write_photos(tmp_path / "input")
    start_near(monkeypatch)
    here, mesh = finished(source, tmp_path / "cpu", "cpu")
    emulate(monkeypatch, emulator_library)
    there, other = finished(source, tmp_path / "gpu", "auto")
    assert not [line for line in caplog.messages if "on the processor" in line]
    for report, device in ((here, "cpu"), (there, "cuda:0")):
        assert report["device"] == device
        assert report["training"]["device"] == device
        assert report["regions"]["ball"]["provenance"]["field_device"] == device
        assert "device-failed" not in [warning["code"] for warning in report["warnings"]]
    one, two = (report["training"] for report in (here, there))
    a, b = (training["history"][-1] for training in (one, two))
    assert a["gaussians"] == b["gaussians"]
    assert b["loss"] == pytest.approx(a["loss"], rel=1e-3)
    assert two["held_out_psnr"] == pytest.approx(one["held_out_psnr"], abs=0.02)
    assert two["held_out_psnr"] > 25.0
    # Gaussians moved by 1e-6 change the processor's own by 0.12 dB, its mesh by 0.4 %.
    assert mean_psnr(there) == pytest.approx(mean_psnr(here), abs=0.3)
    assert mean_psnr(here) > 26.0
    assert mesh.is_watertight
    assert other.is_watertight
    gaps = [distances(*pair) for pair in ((mesh, other), (other, mesh))]
    diagonal = 2.0 * REGION_RADIUS * 3**0.5
    for gap in gaps:
        assert np.quantile(gap, 0.99) < 0.004 * diagonal
        assert gap.max() < 0.01 * diagonal

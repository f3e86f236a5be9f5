# SPDX-License-Identifier: GPL-3.0-or-later
"""The mesh stage on a finished training: its cameras, and the mesh of the pivots alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gaussian_wrapping_addon.core.devices import DeviceChoice, choice, choose_device
from gaussian_wrapping_addon.core.errors import DeviceError, MeshingError
from gaussian_wrapping_addon.core.field import cuda_vacancy, samples
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.gaussians.files import load_gaussians
from gaussian_wrapping_addon.core.jobs.stages import meshing
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.stage_folder import Stage
from gaussian_wrapping_addon.core.mesh.surface_mesh import load_mesh
from gaussian_wrapping_addon.core.meshing.delaunay import bounding_points, delaunay
from gaussian_wrapping_addon.core.meshing.marching_tetrahedra import bisect, marching_tetrahedra
from gaussian_wrapping_addon.core.meshing.pivots import pivot_rule
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.cuda import device_renderer
from gaussian_wrapping_addon.core.render.cuda.device_renderer import DeviceRenderer
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.scene import load_saved_scene
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.jobs.finished_sphere import write_cube, write_finished_sphere
from tests.core.jobs.mesh_walk import walk_mesh
from tests.core.render.cuda.emulation import EmulatedKernels

PROCESSOR = choose_device("cpu")
HELD_OUT = {"000.png", "008.png"}
"""Of the twelve photos of the sphere, every eighth."""


def mesh_of(folder: JobFolder, meshing: MeshingSettings, device: DeviceChoice = PROCESSOR) -> Stage:
    """Mesh the cube around the sphere."""
    earlier = read_job(folder.job_path)
    path = write_cube(folder.root / "ball.json")
    settings = dataclasses.replace(earlier.settings, meshing=meshing, regions=(str(path),))
    job: JobFile = make_job("mesh", Path(earlier.source), settings)
    return walk_mesh(folder, job, "ball", device)


@pytest.mark.parametrize("method", ["pam", "pivots"])
def test_every_part_of_the_mesh_stage_uses_the_chosen_cameras(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_finished_sphere(tmp_path)
    sampled = []
    honest = samples.sample_depth_maps

    def watched(gaussians, cameras, *arguments, **named):  # type: ignore[no-untyped-def]
        sampled.append({camera.name for camera in cameras})
        return honest(gaussians, cameras, *arguments, **named)

    monkeypatch.setattr(samples, "sample_depth_maps", watched)
    settings = MeshingSettings(method=method, points=300 if method == "pam" else 0)
    by_default = mesh_of(folder, settings)
    by_all = mesh_of(folder, dataclasses.replace(settings, cameras="all"))
    assert by_default.folder != by_all.folder
    assert by_default.done["provenance"]["cameras"] == "training"
    assert by_default.done["provenance"]["field_cameras"] == 10
    assert by_all.done["provenance"]["field_cameras"] == 12
    assert by_all.done["check"]["good"] is by_default.done["check"]["good"] is True
    assert sampled[1] - sampled[0] == HELD_OUT


@pytest.mark.parametrize(("pivots", "box"), [(2, "normal"), (9, "normal"), (9, "gof")])
def test_a_job_makes_the_mesh_of_the_pivots_alone(
    pivots: int, box: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_finished_sphere(tmp_path)
    monkeypatch.setattr(
        samples, "sample_depth_maps", lambda *_, **__: pytest.fail("sampled depth maps")
    )
    settings = MeshingSettings(
        method="pivots", pivots=pivots, pivot_box=box, pivot_samples="none", min_component_share=0.0
    )
    made = mesh_of(folder, settings)
    mesh = load_mesh(made.folder / "mesh.npz")
    assert made.done["check"]["good"] is True
    # The same by hand: Delaunay tetrahedra of exactly these points, labels, crossing edges.
    arrays = load_gaussians(next(folder.stages.glob("train-*")) / "gaussians.npz").arrays()
    own = pivot_rule(pivots, box)(arrays, np.arange(len(arrays.means)))
    assert made.done["provenance"]["pivots"] == len(own) == pivots * 600
    scene = load_saved_scene(next(folder.stages.glob("cameras-*")))
    ten = [camera for camera in scene.cameras if camera.name not in HELD_OUT]
    field = VacancyField(arrays, ten, threads=1)
    points = np.concatenate([own, bounding_points(own, 0)])
    tetrahedra = delaunay(points, seed=0, progress=Progress())
    inside = np.zeros(len(points), np.bool_)
    inside[: len(own)] = ~field.is_empty(own)
    edges, _ = marching_tetrahedra(tetrahedra, inside)
    begin, end = points[edges[:, 0]], points[edges[:, 1]]
    ends = bisect(begin, end, field.is_empty, np.full(len(edges), 1e-5), Progress())
    expected = (ends[0] + ends[1]) / 2
    # The region's corners lie in the ball's shadow: what the cut there adds is left out.
    found = mesh.vertices[np.linalg.norm(mesh.vertices, axis=1) < 1.2]
    tolerance = 0.02 * 4.5 / 48  # the job brackets to this share of a pixel
    for here, there in ((found, expected), (expected, found)):
        assert np.quantile(cKDTree(there).query(here)[0], 0.99) < tolerance
    assert len(found) == pytest.approx(len(expected), rel=0.05)


class _EmulatedField(cuda_vacancy.CudaVacancyField):
    """The GPU's field with its kernels on the host; says that it is where it was asked to be."""

    library: Path

    def __init__(self, arrays, cameras, *, device, **options):  # type: ignore[no-untyped-def]
        super().__init__(
            arrays, cameras, device="cpu", kernels=EmulatedKernels(self.library),
            device_cache_bytes=1 << 30, **options,
        )  # fmt: skip
        self.device = device


GPU = DeviceChoice("cuda:0", "Some GPU", "It passed.")


@pytest.mark.parametrize(
    ("free_gib", "device", "renderers"),
    [
        (4, "cuda:0", [DeviceRenderer]),
        (1, "cuda:0", [DeviceRenderer, ViewRenderer]),
        (0, "cpu", [ViewRenderer]),
    ],
)
def test_on_a_gpu_the_field_and_the_depth_maps_are_there_if_they_fit(
    free_gib: int,
    device: str,
    renderers: list[type],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    emulator_library: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    folder = write_finished_sphere(tmp_path)
    monkeypatch.setattr(_EmulatedField, "library", emulator_library, raising=False)
    monkeypatch.setattr(cuda_vacancy, "CudaVacancyField", _EmulatedField)
    monkeypatch.setattr(choice, "_usable", lambda index: (True, "It passed."))
    monkeypatch.setattr(choice, "_card", lambda index: "Some GPU")
    free = (free_gib << 30, 8 << 30)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda index: free)
    kernels = EmulatedKernels(emulator_library)
    budget = 1 << 28 if free_gib > 1 else 1  # for tile intersections
    asked = []

    def renderer_of(device: str) -> DeviceRenderer:
        asked.append(device)
        return DeviceRenderer(kernels, torch.device("cpu"), lambda: budget)

    monkeypatch.setattr(device_renderer, "device_renderer", renderer_of)
    sampled = []
    honest = samples.sample_depth_maps

    def watched(gaussians, *arguments, renderer, **named):  # type: ignore[no-untyped-def]
        assert {tensor.device.type for _, tensor in gaussians.tensors()} == {"cpu"}
        sampled.append(type(renderer))
        return honest(gaussians, *arguments, renderer=renderer, **named)

    monkeypatch.setattr(samples, "sample_depth_maps", watched)
    made = mesh_of(folder, MeshingSettings(points=300), GPU)
    assert made.done["provenance"]["field_device"] == device
    assert made.done["check"]["good"] is True
    assert sampled == renderers
    assert asked == ["cuda:0"] * (device == "cuda:0")
    told = [line for line in caplog.messages if line.startswith("Vacancy runs on the processor")]
    assert len(told) == (device == "cpu")
    told = [line for line in caplog.messages if line.startswith("Depth maps are rendered on the")]
    assert len(told) == (len(renderers) == 2)


class _FailingField(VacancyField):
    """A GPU's field that fails after some evaluations."""

    left = 0

    def __init__(self, arrays, cameras, *, device, **options):  # type: ignore[no-untyped-def]
        super().__init__(arrays, cameras, **options)
        self.device = device

    def vacancy(self, points, progress=None):  # type: ignore[no-untyped-def]
        type(self).left -= 1
        if self.left < 0:
            raise DeviceError("The launch failed.", "")
        return super().vacancy(points, progress)


@pytest.mark.parametrize("tiles", ["off", "8"])
def test_a_gpu_that_fails_in_the_middle_leaves_the_mesh_of_the_processor(
    tiles: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(device: str) -> DeviceRenderer:
        raise DeviceError("The launch failed.", "")

    settings = MeshingSettings(points=300, tiles=tiles)
    (tmp_path / "cpu").mkdir()
    (tmp_path / "gpu").mkdir()
    here = mesh_of(write_finished_sphere(tmp_path / "cpu"), settings)
    monkeypatch.setattr(cuda_vacancy, "CudaVacancyField", _FailingField)
    monkeypatch.setattr(meshing, "stage_device", lambda chosen, *_: chosen)
    monkeypatch.setattr(device_renderer, "device_renderer", fail)
    monkeypatch.setattr(_FailingField, "left", 7)
    there = mesh_of(write_finished_sphere(tmp_path / "gpu"), settings, GPU)
    assert _FailingField.left < 0
    provenance = there.done["provenance"]
    assert provenance["field_device"] == "cpu"
    assert [warning["code"] for warning in provenance["warnings"]] == ["device-failed"]
    assert "The launch failed." in caplog.text
    one, two = (load_mesh(stage.folder / "mesh.npz") for stage in (here, there))
    assert np.array_equal(one.vertices, two.vertices)
    assert np.array_equal(one.faces, two.faces)


def test_what_no_device_would_have_met_ends_the_stage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(*_: object, **__: object) -> VacancyField:
        raise MeshingError("No surface.", "")

    monkeypatch.setattr(meshing, "region_field", wrong)
    with pytest.raises(MeshingError, match="No surface"):
        mesh_of(write_finished_sphere(tmp_path), MeshingSettings(points=300), GPU)


def test_a_finished_mesh_is_re_used_on_another_device(tmp_path: Path) -> None:
    folder = write_finished_sphere(tmp_path)
    settings = MeshingSettings(
        method="pivots", pivots=2, pivot_samples="none", min_component_share=0.0
    )
    assert not mesh_of(folder, settings).reused
    assert mesh_of(folder, settings, GPU).reused

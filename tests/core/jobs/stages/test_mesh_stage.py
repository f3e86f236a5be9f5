# SPDX-License-Identifier: GPL-3.0-or-later
"""The mesh stage on a finished training: cameras, pivots, the region's field."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gaussian_wrapping_addon.core.devices import DeviceChoice, choose_device
from gaussian_wrapping_addon.core.errors import (
    DatasetError,
    DeviceError,
    MeshingError,
    ResourceError,
)
from gaussian_wrapping_addon.core.field import cuda_vacancy, samples
from gaussian_wrapping_addon.core.field.vacancy import VacancyField, VacancyResult
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.gaussians.files import load_gaussians, save_gaussians
from gaussian_wrapping_addon.core.jobs.parts.graph import Part, read_state
from gaussian_wrapping_addon.core.jobs.parts.runner import InProcess, PartResult, PartRunner, Walk
from gaussian_wrapping_addon.core.jobs.stages import meshing
from gaussian_wrapping_addon.core.jobs.stages.meshing import (
    field_figures,
    field_views,
    load_region,
    region_field,
    requested_region,
)
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.stage_folder import Stage, read_done
from gaussian_wrapping_addon.core.mesh.surface_mesh import load_mesh
from gaussian_wrapping_addon.core.meshing import pivot_meshing
from gaussian_wrapping_addon.core.meshing.delaunay import bounding_points, delaunay
from gaussian_wrapping_addon.core.meshing.marching_tetrahedra import bisect, marching_tetrahedra
from gaussian_wrapping_addon.core.meshing.pivot_meshing import mesh_by_pivots
from gaussian_wrapping_addon.core.meshing.pivots import pivot_rule
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.surface_points import Field, halo_bounds
from gaussian_wrapping_addon.core.photos.store import PhotoStore
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.render.cuda import device_renderer
from gaussian_wrapping_addon.core.render.cuda.device_renderer import DeviceRenderer
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View, load_saved_scene
from gaussian_wrapping_addon.core.settings import (
    JobSettings,
    MeshingSettings,
    TrainingSettings,
    preset,
)
from tests.core.field.field_scenes import camera_at, cameras_around, shell_arrays
from tests.core.jobs.finished_sphere import write_cube, write_finished_sphere
from tests.core.jobs.test_device_job import emulate
from tests.core.meshing.meshing_scenes import ShapeField, cube, gaussians_on, sphere
from tests.core.render.cuda.emulation import EmulatedKernels
from tests.proofs import first_then_proofs

PROCESSOR = choose_device("cpu")
GPU = DeviceChoice("cuda:0", "Some GPU", "It passed.")
HELD_OUT = {"000.png", "008.png"}
"""Of the twelve photos of the sphere, every eighth."""


class MeshRunner(PartRunner):
    """Runs the parts of the mesh; keeps which ones were finished before."""

    reused: dict[str, bool]

    def run(self, part: Part, progress: Progress) -> PartResult:
        """Run a part; texture and export make nothing."""
        if part.kind in ("texture", "export"):
            return PartResult(())
        result = super().run(part, progress)
        self.__dict__.setdefault("reused", {})[part.name] = result.reused
        return result


def mesh_of(folder: JobFolder, meshing: MeshingSettings, device: DeviceChoice = PROCESSOR) -> Stage:
    """Mesh the cube around the sphere in this process, without texture and export."""
    earlier = read_job(folder.job_path)
    path = write_cube(folder.root / "ball.json")
    settings = dataclasses.replace(earlier.settings, meshing=meshing, regions=(str(path),))
    job = make_job("mesh", Path(earlier.source), settings)
    runner = MeshRunner(folder, job, lambda: walk.graph, threads=1, device=device, begun_s=0.0)
    engine = InProcess(folder.root, runner, lambda part: Progress())
    walk = Walk(folder, job, engine, engine, lambda *_: None, lambda: False)
    walk.run()
    state = read_state(folder.root, "mesh-ball")
    assert state is not None
    stage = folder.root / state.outputs[0]
    key, done = stage.name.rpartition("-")[2], read_done(stage)
    assert done is not None
    return Stage("mesh-ball", key, stage, done, runner.reused["plan-ball"])


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


@pytest.mark.parametrize(("pivots", "box"), [(2, "normal"), (9, "gof")])
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
    assert mesh_of(folder, settings, GPU).reused, "a finished mesh is one on another device, too"
    mesh = load_mesh(made.folder / "mesh.npz")
    assert made.done["check"]["good"] is True
    expected = made.done["estimate"]
    tetrahedra = made.done["provenance"]["tetrahedra"]
    assert expected["tetrahedra_low"] < tetrahedra < expected["tetrahedra_high"]
    assert expected["free_memory_bytes"] > 0
    # The same by hand: Delaunay tetrahedra of exactly these points, labels, crossing edges.
    arrays = load_gaussians(next(folder.stages.glob("train-*")) / "gaussians.npz").arrays()
    own = pivot_rule(pivots, box)(arrays, np.arange(len(arrays.means)))
    assert made.done["provenance"]["pivots"] == len(own) == pivots * 600
    scene = load_saved_scene(next(folder.stages.glob("cameras-*")))
    ten = [camera for camera in scene.cameras if camera.name not in HELD_OUT]
    field = VacancyField(arrays, ten, threads=1)
    points = np.concatenate([own, bounding_points(own, 0)])
    tetrahedra = delaunay(points, seed=0, progress=Progress())
    inside = np.concatenate([~field.is_empty(own), np.zeros(len(points) - len(own), np.bool_)])
    edges, _ = marching_tetrahedra(tetrahedra, inside)
    begin, end = points[edges[:, 0]], points[edges[:, 1]]
    ends = bisect(begin, end, field.is_empty, np.full(len(edges), 1e-5), Progress())
    wanted = (ends[0] + ends[1]) / 2
    # The region's corners lie in the ball's shadow: what the cut there adds is left out.
    found = mesh.vertices[np.linalg.norm(mesh.vertices, axis=1) < 1.2]
    tolerance = 0.02 * 4.5 / 48  # the job brackets to this share of a pixel
    for here, there in ((found, wanted), (wanted, found)):
        assert np.quantile(cKDTree(there).query(here)[0], 0.99) < tolerance
    assert len(found) == pytest.approx(len(wanted), rel=0.05)


@pytest.mark.parametrize(
    ("free_gib", "device", "renderers"),
    first_then_proofs(
        [
            (1, "cuda:0", [DeviceRenderer, ViewRenderer]),
            (0, "cpu", [ViewRenderer]),
            (4, "cuda:0", [DeviceRenderer]),
        ],
        2,
        names=3,
    ),
)
def test_on_a_gpu_the_field_and_the_depth_maps_are_there_if_they_fit(
    free_gib: int, device: str, renderers: list[type], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, emulator_library: Path, caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    folder = write_finished_sphere(tmp_path)
    emulate(monkeypatch, emulator_library)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda index: (free_gib << 30, 8 << 30))
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
    for begins, told in (
        ("Vacancy runs on the processor", device == "cpu"),
        ("Depth maps are rendered on the", len(renderers) == 2),
    ):
        assert len([line for line in caplog.messages if line.startswith(begins)]) == told


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


def scene_with_masks(folder: Path, kept: slice) -> Scene:
    """Cameras around the unit shell whose masks keep some columns of each image."""
    views = []
    for index, camera in enumerate(cameras_around(6)):
        mask = np.zeros((camera.height, camera.width), np.uint8)
        mask[:, kept] = 255
        Image.fromarray(mask).save(folder / f"mask{index}.png")
        Image.fromarray(np.stack([mask] * 3, -1)).save(folder / f"{index}.png")
        views.append(View(camera, folder / f"{index}.png", folder / f"mask{index}.png"))
    return Scene(tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), Similarity())


def test_masks_and_their_mode_come_from_the_training(tmp_path: Path) -> None:
    scene, arrays = scene_with_masks(tmp_path, slice(0, 40)), shell_arrays(0.9)
    ignoring, background = (
        region_field(
            scene, arrays, cube(1.5), replace(TrainingSettings(), mask_mode=mode),
            MeshingSettings(unseen="occupied"), threads=1,
        )
        for mode in ("ignore", "background")
    )  # fmt: skip
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (400, 3))
    blind, seen = ignoring.vacancy(points), background.vacancy(points).vacancy
    assert (blind.camera < 0).any(), "where all masks are black nobody looks"
    assert (blind.vacancy[blind.camera < 0] == 0.0).all()
    assert (seen >= blind.vacancy).all()
    assert (seen == 1.0).sum() > (blind.vacancy == 1.0).sum()


def test_unseen_space_is_what_the_settings_say_and_is_counted(tmp_path: Path) -> None:
    scene = scene_with_masks(tmp_path, slice(None))
    far = np.array([[0, 0, 2.0], [0, 0, -2.0]])
    few = replace(scene, views=scene.views[:1])
    for unseen in ("empty", "occupied"):
        field = region_field(
            few, shell_arrays(0.9), cube(1.5), TrainingSettings(), MeshingSettings(unseen=unseen),
            threads=1,
        )  # fmt: skip
        behind = 2 * field.cameras[0].center - far[:1]
        assert field.is_empty(behind).tolist() == [unseen == "empty"]
        assert field_figures(field) == {
            "field_device": "cpu", "field_cameras": 1, "unseen": unseen, "field_evaluations": 1,
            "unseen_evaluations": 1,
        }  # fmt: skip


def test_bounds_change_nothing_in_and_around_the_region(tmp_path: Path) -> None:
    scene, arrays = scene_with_masks(tmp_path, slice(None)), shell_arrays(0.9)
    region = Region.box("part", np.array([0.3, -0.4, -0.4]), np.array([1.2, 0.5, 0.4]))
    training = TrainingSettings(holdout_every=0)
    field = region_field(scene, arrays, region, training, MeshingSettings(), threads=1)
    low, high = halo_bounds(region)
    points = np.random.default_rng(1).uniform(low, high, (500, 3))
    whole = VacancyField(arrays, scene.cameras, threads=1)
    assert np.array_equal(field.is_empty(points), whole.is_empty(points))


def scene_looked_into() -> Scene:
    """Cameras around the unit shell, and two held-out ones (first and last by name) within it."""
    around = [replace(c, name=f"b{i}") for i, c in enumerate(cameras_around(7))]
    within = [
        replace(camera_at(0.5 * place, focal=100.0), name=name)
        for name, place in (("a", np.array([0.0, 0.0, 1.0])), ("c", np.array([0.0, 1.0, 0.0])))
    ]
    views = tuple(View(camera, Path("unused.png")) for camera in [*around, *within])
    none = np.zeros((0, 3))
    return Scene(views, none, none.astype(np.uint8), Similarity())


@pytest.mark.parametrize(("cameras", "walls"), [("training", 1), ("all", 2)])
def test_a_ball_that_only_held_out_cameras_look_into_is_meshed_solid(
    cameras: str, walls: int
) -> None:
    scene, arrays = scene_looked_into(), shell_arrays(0.95, sigma_n=0.05)
    settings = MeshingSettings(method="pivots", cameras=cameras)
    field = region_field(scene, arrays, cube(1.5), TrainingSettings(), settings, threads=1)
    mesh = mesh_by_pivots(field, arrays, field.cameras, cube(1.5), settings, Progress(), seed=0)
    assert mesh.provenance["components"] == walls


def test_the_mesh_lies_at_the_level() -> None:
    scene, arrays = scene_looked_into(), shell_arrays(0.95, sigma_n=0.05)
    region = cube(1.5)
    plain = region_field(scene, arrays, region, TrainingSettings(), MeshingSettings(), threads=1)
    for level in (0.3, 0.7):
        settings = MeshingSettings(method="pivots", level=level)
        field = region_field(scene, arrays, region, TrainingSettings(), settings, threads=1)
        mesh = mesh_by_pivots(field, arrays, field.cameras, region, settings, Progress(), seed=0)
        at = plain.vacancy(mesh.vertices).vacancy
        assert abs(float(np.median(at)) - level) < 0.02


@pytest.mark.parametrize("blur", [0.25, 0.0])
def test_fields_take_the_opacity_without_blur_and_regions_the_trained_one(
    tmp_path: Path, blur: float
) -> None:
    """Of rods half a pixel wide; what is one of them is faint enough to widen no region."""
    folder = write_finished_sphere(tmp_path)
    cameras, train = (
        Stage(name, "", next(folder.stages.glob(f"{name}-*")), {}, True)
        for name in ("cameras", "train")
    )
    training = TrainingSettings()
    rods = load_gaussians(train.folder / "gaussians.npz")
    pixel = 0.01
    rods.log_scales[:] = torch.log(torch.tensor([0.2, 0.6 * pixel, 0.5 * pixel]))
    rods.opacity_logits[:] = -0.5
    rods.filter_3d[:] = math.sqrt(training.filter_variance) * pixel
    rods.means[0], rods.opacity_logits[0] = torch.tensor([9.0, 0.0, 0.0]), -2.3
    save_gaussians(train.folder / "gaussians.npz", rods)
    earlier = read_job(folder.job_path)
    settings = dataclasses.replace(
        earlier.settings, meshing=MeshingSettings(blur_variance=blur), regions=("all",)
    )
    job = make_job("mesh", Path(earlier.source), settings)
    inputs = load_region(job, "all", cameras, train, PROCESSOR, 1)
    trained = rods.arrays().log_opacities
    rise = inputs.arrays.log_opacities - trained
    wide_sq = 0.6**2 + training.filter_variance
    wanted = 0.5 * math.log(wide_sq / (wide_sq - blur))
    assert rise == pytest.approx(wanted, abs=1e-5)
    assert (blur > 0) == (wanted > 0.4)
    assert inputs.region.vertices.max() < 5.0, "the faint one is not within the region"
    assert JobSettings().meshing.blur_variance == 0.25
    assert preset("paper").meshing.blur_variance == 0.0


def test_the_method_asks_the_cameras_that_were_trained_on(tmp_path: Path) -> None:
    assert MeshingSettings().cameras == "training"
    scene = scene_with_masks(tmp_path, slice(None))
    black = tmp_path / "mask3.png"
    Image.fromarray(np.zeros((300, 400), np.uint8)).save(black)
    photos = PhotoStore(scene, 400)
    assert field_views(scene, photos, 8, "training") == [1, 2, 4, 5]
    assert field_views(scene, photos, 0, "training") == [0, 1, 2, 4, 5]
    assert field_views(scene, photos, 8, "all") == [0, 1, 2, 3, 4, 5]
    for index in range(6):
        Image.fromarray(np.zeros((300, 400), np.uint8)).save(tmp_path / f"mask{index}.png")
    with pytest.raises(DatasetError, match="cover every photo"):
        field_views(scene, PhotoStore(scene, 400), 8, "training")


def test_without_a_usable_gpu_the_log_says_why_and_the_report_where(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    scene = scene_with_masks(tmp_path, slice(None))
    monkeypatch.setattr(cuda_vacancy, "cuda_available", lambda _: (False, "The driver is too old."))
    fields = [
        region_field(
            scene, shell_arrays(0.9), cube(1.5), TrainingSettings(), MeshingSettings(), threads=1,
            device=device,
        )
        for device in ("cpu", "cuda:1")
    ]  # fmt: skip
    assert [type(field) for field in fields] == [VacancyField, VacancyField]
    assert [field_figures(field)["field_device"] for field in fields] == ["cpu", "cpu"]
    assert caplog.messages == [
        "Vacancy is evaluated on the processor, not on the GPU: The driver is too old."
    ]


def test_gaussians_on_a_gpu_get_its_field_with_the_same_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, arrays = scene_with_masks(tmp_path, slice(0, 40)), shell_arrays(0.9)
    given = {}

    class OnGpu(VacancyField):
        def __init__(self, arrays, cameras, *, device, **options):  # type: ignore[no-untyped-def]
            super().__init__(arrays, cameras, **options)
            given.update(options)
            self.device = device

    monkeypatch.setattr(cuda_vacancy, "CudaVacancyField", OnGpu)
    training = TrainingSettings(mask_mode="background", holdout_every=0)
    settings = training, MeshingSettings(unseen="occupied")
    field = region_field(scene, arrays, cube(1.5), *settings, threads=1, device="cuda:1")
    assert isinstance(field, OnGpu)
    assert field_figures(field)["field_device"] == "cuda:1"
    assert (given["mask_mode"], given["unseen"]) == ("background", "occupied")
    assert len(given["masks"]) == 6
    assert np.array_equal(given["region_bounds"], halo_bounds(cube(1.5)))


@pytest.mark.parametrize("method", ["pam", "pivots"])
def test_nobody_asks_beyond_the_halo(method: str) -> None:
    region = Region.box("part", np.array([0.3, -0.4, -0.4]), np.array([1.2, 0.5, 0.4]))
    low, high = halo_bounds(region)

    class WatchedField(ShapeField):
        def vacancy(self, points: np.ndarray) -> VacancyResult:
            assert ((points >= low) & (points <= high)).all()
            return super().vacancy(points)

    field = WatchedField(sphere(), 0.05)
    arrays = gaussians_on(sphere(), cube(1.5), 3000, 0.05)
    settings, common = MeshingSettings(points=800), (arrays, field.cameras, region)
    if method == "pam":
        mesh_region(Field(field, field, 1), *common, settings, Progress(), seed=0)
    else:
        mesh_by_pivots(field, *common, MeshingSettings(), Progress(), seed=0)


def test_too_little_memory_is_refused_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(meshing, "free_bytes", lambda *_: 1 << 20)
    monkeypatch.setattr(pivot_meshing, "mesh_by_pivots", lambda *_, **__: pytest.fail("began"))
    with pytest.raises(ResourceError, match="by pivots needs at least"):
        mesh_of(write_finished_sphere(tmp_path), MeshingSettings(method="pivots"))


def test_a_region_file_comes_out_of_a_job_bit_by_bit(tmp_path: Path) -> None:
    """Meshed from what an earlier mesh has left, again and again, a region does not wander."""
    turn = Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix()
    world_from_scene = Similarity(0.317, turn, np.array([5e5, 4.1e6, 87.3]))
    vertices = np.random.default_rng(3).normal(size=(30, 3)) * 7.7 + world_from_scene.translation
    path = tmp_path / "0.json"
    write_region(path, Region("Würfel 1", vertices))
    first = path.read_bytes()
    for number in range(1, 4):
        scene = cast(Any, SimpleNamespace(world_from_scene=world_from_scene))
        inside, region = requested_region(str(path), read_json(path), scene, cast(Any, None))
        back = world_from_scene.points(inside.vertices)
        np.testing.assert_allclose(back, vertices, rtol=0, atol=4e-6 * region.diagonal)
        path = tmp_path / f"{number}.json"
        write_region(path, region)
        assert path.read_bytes() == first

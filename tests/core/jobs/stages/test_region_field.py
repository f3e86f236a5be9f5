# SPDX-License-Identifier: GPL-3.0-or-later
"""The vacancy field of a region: photo masks, unseen space, bounds with the halo."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.field import cuda_vacancy
from gaussian_wrapping_addon.core.field.vacancy import VacancyField
from gaussian_wrapping_addon.core.jobs.stages.meshing import (
    field_figures,
    field_views,
    region_field,
)
from gaussian_wrapping_addon.core.meshing.pivot_meshing import mesh_by_pivots
from gaussian_wrapping_addon.core.meshing.primal_adaptive import mesh_region
from gaussian_wrapping_addon.core.meshing.surface_points import Field, halo_bounds
from gaussian_wrapping_addon.core.photos.store import PhotoStore
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from gaussian_wrapping_addon.core.settings import MeshingSettings, TrainingSettings
from tests.core.field.field_scenes import camera_at, cameras_around, shell_arrays
from tests.core.meshing.meshing_scenes import ShapeField, cube, gaussians_on, sphere


def scene_with_masks(folder: Path, kept: slice) -> Scene:
    """Cameras around the unit shell whose masks keep some columns of each image."""
    views = []
    for index, camera in enumerate(cameras_around(6)):
        mask = np.zeros((camera.height, camera.width), np.uint8)
        mask[:, kept] = 255
        Image.fromarray(mask).save(folder / f"mask{index}.png")
        Image.fromarray(np.stack([mask] * 3, -1)).save(folder / f"{index}.png")
        views.append(View(camera, folder / f"{index}.png", folder / f"mask{index}.png"))
    return Scene(
        tuple(views),
        np.zeros((0, 3)),
        np.zeros((0, 3), np.uint8),
        Similarity(1.0, np.eye(3), np.zeros(3)),
    )


POINTS = np.random.default_rng(0).uniform(-1.4, 1.4, (400, 3))


def test_masks_and_their_mode_come_from_the_training(tmp_path: Path) -> None:
    scene, arrays = scene_with_masks(tmp_path, slice(0, 40)), shell_arrays(0.9)
    ignoring, background = (
        region_field(
            scene, arrays, cube(1.5), replace(TrainingSettings(), mask_mode=mode),
            MeshingSettings(unseen="occupied"), threads=1,
        )
        for mode in ("ignore", "background")
    )  # fmt: skip
    blind = ignoring.vacancy(POINTS)
    assert (blind.camera < 0).any(), "where all masks are black nobody looks"
    assert (blind.vacancy[blind.camera < 0] == 0.0).all()
    assert (background.vacancy(POINTS).vacancy >= blind.vacancy).all()
    assert (background.vacancy(POINTS).vacancy == 1.0).sum() > (blind.vacancy == 1.0).sum()


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
    return Scene(views, none, none.astype(np.uint8), Similarity(1.0, np.eye(3), np.zeros(3)))


def within_reach_of_both() -> np.ndarray:
    points = np.random.default_rng(2).normal(size=(200, 3))
    return 0.2 * points / np.linalg.norm(points, axis=1)[:, None]


@pytest.mark.parametrize(
    ("holdout_every", "cameras", "carved"),
    [(8, "training", False), (8, "all", True), (0, "training", True), (0, "all", True)],
)
def test_held_out_cameras_carve_only_if_all_cameras_are_asked_for(
    holdout_every: int, cameras: str, carved: bool
) -> None:
    scene, training = scene_looked_into(), TrainingSettings(holdout_every=holdout_every)
    field = region_field(
        scene, shell_arrays(0.95), cube(1.5), training, MeshingSettings(cameras=cameras), threads=1
    )
    used = {camera.name for camera in field.cameras}
    assert used == {f"b{i}" for i in range(7)} | ({"a", "c"} if carved else set())
    assert (field.is_empty(within_reach_of_both()) == carved).all()


@pytest.mark.parametrize(("cameras", "walls"), [("training", 1), ("all", 2)])
def test_a_ball_that_only_held_out_cameras_look_into_is_meshed_solid(
    cameras: str, walls: int
) -> None:
    scene, arrays = scene_looked_into(), shell_arrays(0.95, sigma_n=0.05)
    settings = MeshingSettings(method="pivots", cameras=cameras)
    field = region_field(scene, arrays, cube(1.5), TrainingSettings(), settings, threads=1)
    mesh = mesh_by_pivots(field, arrays, field.cameras, cube(1.5), settings, Progress(), seed=0)
    assert mesh.provenance["components"] == walls


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


class WatchedField(ShapeField):
    """Notes the box of all points that are asked for."""

    low, high = np.full(3, np.inf), np.full(3, -np.inf)

    def distance_of(self, points: np.ndarray) -> None:
        self.low = np.minimum(self.low, points.min(0, initial=np.inf))
        self.high = np.maximum(self.high, points.max(0, initial=-np.inf))

    def vacancy(self, points: np.ndarray):  # type: ignore[no-untyped-def]
        self.distance_of(points)
        return super().vacancy(points)


@pytest.mark.parametrize("method", ["pam", "pivots"])
def test_nobody_asks_beyond_the_halo(method: str) -> None:
    region = Region.box("part", np.array([0.3, -0.4, -0.4]), np.array([1.2, 0.5, 0.4]))
    field = WatchedField(sphere(), 0.05)
    arrays = gaussians_on(sphere(), cube(1.5), 3000, 0.05)
    if method == "pam":
        mesh_region(
            Field(field, field, 1),
            arrays,
            field.cameras,
            region,
            MeshingSettings(points=800),
            Progress(),
            seed=0,
        )
    else:
        mesh_by_pivots(field, arrays, field.cameras, region, MeshingSettings(), Progress(), seed=0)
    low, high = halo_bounds(region)
    assert (field.low >= low).all()
    assert (field.high <= high).all()

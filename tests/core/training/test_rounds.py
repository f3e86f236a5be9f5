# SPDX-License-Identifier: GPL-3.0-or-later
"""Updates between iterations: what they keep, and what settings and decisions switch off."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthPrior
from gaussian_wrapping_addon.core.training.cpu_backend import CpuBackend
from gaussian_wrapping_addon.core.training.iteration import Stepper
from gaussian_wrapping_addon.core.training.rounds import Rounds
from gaussian_wrapping_addon.core.training.schedule import Schedule
from gaussian_wrapping_addon.core.training.state import TrainingState
from tests.core.training.small_scene import PhotosInMemory, sphere_gaussians, sphere_scene

SIZE_PX = 32
SETTINGS = TrainingSettings(
    iterations=60, max_gaussians=400, max_image_px=SIZE_PX, sh_degree=1, densify_every=5,
    wrap_rounds=2,
)  # fmt: skip


def street(views: int) -> tuple[Scene, PhotosInMemory, OrientedGaussians]:
    """Return cameras in a row, 10 units apart, each looking at an opaque disc of its own."""
    places = 10.0 * np.arange(views)
    cameras = []
    for index, place in enumerate(places):
        pose = np.concatenate([np.eye(3), [[-place], [0.0], [0.0]]], 1)
        half = SIZE_PX / 2
        cameras.append(
            Camera(f"{index:03d}.png", SIZE_PX, SIZE_PX, SIZE_PX, SIZE_PX, half, half, pose)
        )
    template = sphere_gaussians(views)
    means = np.stack([places, np.zeros(views), np.full(views, 4.0)], 1)
    discs = template.replaced(
        means=torch.from_numpy(means.astype(np.float32)),
        log_scales=torch.log(torch.tensor([[0.5, 0.5, 0.05]])).repeat(views, 1),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(views, 1),
    )
    scene = Scene(
        tuple(View(c, Path(c.name)) for c in cameras),
        means, np.full((views, 3), 128, np.uint8), Similarity(),
    )  # fmt: skip
    grey = np.full((SIZE_PX, SIZE_PX, 3), 128, np.uint8)
    return scene, PhotosInMemory(scene, [grey] * views), discs


def rounds_of(scene: Scene, photos: PhotosInMemory, settings: TrainingSettings) -> Rounds:
    views = list(range(len(scene.views)))
    neighbours = {view: np.zeros(0, np.int64) for view in views}
    stepper = Stepper(photos, Schedule(settings, SIZE_PX), views, neighbours, CpuBackend(1), 1)
    return Rounds(stepper, Progress("train"))


def run(
    settings: TrainingSettings, iterations: int = 0, start: OrientedGaussians | None = None
) -> tuple[Rounds, TrainingState]:
    """Train a sphere for some iterations, all where 0, and return rounds and state."""
    scene, photos = sphere_scene(views=8, size_px=24)
    rounds = rounds_of(scene, photos, settings)
    state = TrainingState.start(start or sphere_gaussians(), 0)
    rounds.filter(state)
    for _ in range(iterations or settings.iterations):
        rounds.before_step(state)
        rounds.stepper.step(state)
        rounds.after_step(state)
    return rounds, state


@pytest.mark.parametrize("views", [20, 61, 120])
def test_pruning_keeps_what_only_one_of_many_views_shows(views: int) -> None:
    scene, photos, discs = street(views)
    rounds = rounds_of(scene, photos, SETTINGS)
    state = TrainingState.start(discs, 0)
    rounds._prune(state)
    assert len(state.adam) == views


@pytest.mark.parametrize("views", [20, 61, 120])
def test_every_view_votes_for_orientations(views: int) -> None:
    scene, photos, discs = street(views)
    rounds = rounds_of(scene, photos, dataclasses.replace(SETTINGS, wrapping="on", orient_from=0.0))
    state = TrainingState.start(discs.replaced(orientation=torch.zeros(views, 4)), 0)
    rounds.before_step(state)
    normals = state.adam.gaussians().normals().numpy()
    assert (normals[:, 2] < -0.4).all()  # towards the cameras


@pytest.mark.parametrize("views", [20, 61, 120])
def test_normal_errors_are_measured_in_every_view(views: int) -> None:
    scene, photos, discs = street(views)
    away = torch.tensor([[0.0, 0.0, 1.0, 1.0]]).repeat(views, 1)
    state = TrainingState.start(discs.replaced(orientation=away), 0)
    errors = rounds_of(scene, photos, SETTINGS)._normal_errors(state)
    assert (errors > 0.5).all()


def test_growth_off_keeps_the_number_of_gaussians() -> None:
    settings = dataclasses.replace(SETTINGS, growth="off", wrapping="off", prune_share=0.4)
    faint = sphere_gaussians()
    faint.opacity_logits[:5] = -8.0  # density control would remove them
    scene, photos = sphere_scene(views=8, size_px=24)
    rounds = rounds_of(scene, photos, settings)
    state = TrainingState.start(faint, 0)
    rounds.filter(state)
    before = state.adam.array("means").copy()
    for _ in range(settings.iterations):
        rounds.before_step(state)
        rounds.stepper.step(state)
        rounds.after_step(state)
        assert len(state.adam) == len(before)


def test_the_footprint_regulariser_belongs_to_density_control() -> None:
    def means(growth: str, price: float) -> np.ndarray:
        settings = dataclasses.replace(
            SETTINGS, growth=growth, wrapping="off", prune_share=0.0, overlap_price=price
        )
        return run(settings, 4)[1].adam.array("log_scales")

    assert np.array_equal(means("off", 0.0), means("off", 0.5))
    assert not np.array_equal(means("on", 0.0), means("on", 0.5))


@pytest.mark.parametrize(("free_views", "left"), [(2, 0), (0, 1)])
def test_density_control_empties_the_space_that_photos_see_through(
    free_views: int, left: int
) -> None:
    """A Gaussian away from the sphere, where some photos show what is far in its pixel."""
    scene, photos = sphere_scene(views=8, size_px=24)
    settings = dataclasses.replace(SETTINGS, growth="on", free_views=free_views)
    rounds, place = rounds_of(scene, photos, settings), np.array([[1.15, 1.15, 0.0]])
    for view in rounds.views:
        camera = photos.camera(view, 1)
        nothing = np.zeros((camera.height, camera.width), np.float32)
        free = nothing.copy()
        column, row = camera.project(place)[0][0].astype(int)
        if 0 <= column < camera.width and 0 <= row < camera.height:
            free[row, column] = 1e6
        rounds.stepper.priors[view] = DepthPrior(camera, nothing, nothing, nothing, free)
    start = sphere_gaussians()
    means = start.means.clone()
    means[0] = torch.from_numpy(place[0].astype(np.float32))
    state = TrainingState.start(start.replaced(means=means), 0)
    rounds.filter(state)
    before = len(state.adam)
    state.iteration = next(i for i in range(60) if rounds.schedule.densifies(i))
    rounds.after_step(state)
    assert (np.linalg.norm(state.adam.array("means"), axis=1) > 1.5).sum() == left
    assert len(state.adam) > 0.9 * before


@pytest.mark.parametrize("word", ["on", "auto"])
def test_growth_changes_the_number(word: str) -> None:
    """Also by the word that jobs of 0.1.0 have for it."""
    _, state = run(dataclasses.replace(SETTINGS, growth=word, wrapping="off"))
    assert len(state.adam) != len(sphere_gaussians())


@pytest.mark.parametrize("word", ["off", "auto", "on"])
def test_orientations_and_clones_are_asked_for(word: str) -> None:
    """Version 0.1.0 stored "auto"; it means off."""
    settings = dataclasses.replace(SETTINGS, wrapping=word, growth="off")
    sphere = sphere_gaussians()
    start = sphere.replaced(orientation=torch.zeros_like(sphere.orientation))
    rounds, state = run(settings, start=start)
    assert rounds.schedule.is_oriented(settings.iterations - 1) == (word == "on")
    assert bool(state.adam.array("orientation").any()) == (word == "on")
    assert (len(state.adam) > len(sphere)) == (word == "on")


@pytest.mark.parametrize(
    ("orient_from", "wrap_from", "wrap_until"),
    [(0.7, 0.7, 0.9), (0.8, 0.4, 0.9), (0.2, 0.9, 0.5), (0.0, 0.0, 0.5)],
)
def test_nothing_is_cloned_before_orientations(
    orient_from: float, wrap_from: float, wrap_until: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the order of the milestones."""
    wrap = Rounds._wrap
    oriented: list[bool] = []

    def watched(self: Rounds, state: TrainingState) -> bool:
        before = bool(state.adam.array("orientation").any())
        if cloned := wrap(self, state):
            oriented.append(before)
        return cloned

    monkeypatch.setattr(Rounds, "_wrap", watched)
    settings = dataclasses.replace(
        SETTINGS, wrapping="on", orient_from=orient_from, wrap_from=wrap_from,
        wrap_until=wrap_until,
    )  # fmt: skip
    sphere = sphere_gaussians()
    run(settings, start=sphere.replaced(orientation=torch.zeros_like(sphere.orientation)))
    assert oriented
    assert all(oriented)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Dense start, and what lies far away."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.progress import Progress, ProgressEvent
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.scene.scene import PhotoSource, Scene
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.stereo.depth_maps import CELL_PX, FILE_NAME, DepthMap
from gaussian_wrapping_addon.core.training import trainer
from gaussian_wrapping_addon.core.training.focus import OUTSIDE_SIZE, Focus
from gaussian_wrapping_addon.core.training.rounds import Rounds
from gaussian_wrapping_addon.core.training.start import (
    FLATNESS,
    LEAST_CONFIRMED,
    LEAST_REACH,
    OPACITY,
    REACH_FACTOR,
    DenseStart,
    dense_start,
    far_shell,
)
from gaussian_wrapping_addon.core.training.state import TrainingState
from tests.core.stereo.ball_scene import (
    SIDE_PX,
    ball_scene,
    surface_distance,
    true_normals,
    with_photos,
)
from tests.core.training.small_scene import PhotosInMemory, sphere_gaussians
from tests.synthetic import look_at

# -- The start on surfaces found by stereo: flat Gaussians on the ball scene, and the decision ----

FEW = range(3, 8)


def start(
    setting: str = "on",
    photos: PhotoSource | None = None,
    scene: Scene | None = None,
    *,
    max_gaussians: int = 3000,
    seed: int = 0,
    focus: Focus | None = None,
) -> DenseStart:
    own_scene, own_photos = ball_scene()
    settings = TrainingSettings(dense_start=setting, match_px=SIDE_PX, sh_degree=1)
    return dense_start(
        scene or own_scene, photos or own_photos, FEW, settings, Progress(),
        max_gaussians=max_gaussians, seed=seed, threads=1, focus=focus,
    )  # fmt: skip


@functools.cache
def plain_start() -> DenseStart:
    return start()


def started() -> OrientedGaussians:
    gaussians = plain_start().gaussians
    assert gaussians is not None
    return gaussians


def one_colour() -> PhotosInMemory:
    photos = ball_scene()[1]
    return with_photos(photos, [np.full_like(p, 120) for p in photos.photos])


def third_axes(gaussians: OrientedGaussians) -> np.ndarray:
    w, x, y, z = gaussians.quats.numpy().astype(float).T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)


def test_confirmed_gaussians_lie_flat_on_the_surfaces() -> None:
    gaussians = started()
    scales = gaussians.log_scales.numpy().astype(float)
    flat = np.exp(scales[:, 2] - scales[:, 0])
    confirmed = np.abs(flat - FLATNESS) < 1e-3
    confirmed &= np.linalg.norm(gaussians.means.numpy(), axis=1) < 2.5
    assert confirmed.sum() > 400
    opacities = torch.sigmoid(gaussians.opacity_logits).numpy()
    assert opacities[confirmed] == pytest.approx(OPACITY, abs=1e-5)
    points = gaussians.means.numpy()[confirmed].astype(float)
    assert np.median(surface_distance(points)) < 0.03
    cosine = (third_axes(gaussians)[confirmed] * true_normals(points)).sum(1)
    assert np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1)))) < 12.0
    assert np.array_equal(scales[:, 0], scales[:, 1])
    assert gaussians.sh_degree == 1
    assert all(torch.isfinite(t).all() for _, t in gaussians.tensors())
    # No larger than the photos' resolution and the number allow, no gaps either.
    assert 0.01 < np.median(np.exp(scales[confirmed, 0])) < 0.2


def test_points_are_closer_together_where_the_training_is_for() -> None:
    half = Focus([Region.box("half", np.array([0.0, -9.0, -9.0]), np.array([9.0, 9.0, 9.0]))])
    found = start(focus=half).gaussians
    assert found is not None
    shares, spacings = [], []
    for gaussians in (started(), found):
        near = gaussians.select(torch.linalg.norm(gaussians.means, dim=1) < 2.5)
        right = half.contains(near.means.numpy())
        size = np.exp(near.log_scales.numpy()[:, 0])
        shares.append(right.mean())
        spacings.append(np.median(size[~right]) / np.median(size[right]))
    assert 1.5 < spacings[1] / spacings[0] < 1.2 * OUTSIDE_SIZE
    assert shares[0] < 0.7
    assert shares[1] > 0.75
    assert len(found) == pytest.approx(len(started()), rel=0.3)


def test_the_decision_tells_how_much_was_confirmed() -> None:
    decision = plain_start().decision
    assert (decision.name, decision.setting, decision.chosen) == ("dense_start", "on", "on")
    assert decision.figures["photos"] == len(FEW)
    assert decision.figures["limit"] == LEAST_CONFIRMED
    assert 0.3 < decision.figures["confirmed"] < 1.0
    assert f"{100 * decision.figures['confirmed']:.0f} %" in decision.evidence
    automatic = start("auto")
    assert automatic.decision.chosen == "on"
    assert automatic.gaussians is not None
    assert torch.equal(automatic.gaussians.means, started().means)


@pytest.mark.parametrize("setting", ["auto", "on"])
def test_photos_of_one_colour_start_from_sparse_points(setting: str) -> None:
    found = start(setting, one_colour())
    assert found.gaussians is None
    assert (found.decision.setting, found.decision.chosen) == (setting, "off")
    assert found.decision.figures["confirmed"] == 0.0


def test_too_few_points_or_only_excluded_pixels_start_from_sparse_points() -> None:
    scene, photos = ball_scene()
    few = dataclasses.replace(scene, points=scene.points[:5], point_colors=scene.point_colors[:5])
    found = start("on", scene=few)
    assert found.gaussians is None
    assert found.decision.chosen == "off"
    assert "Too few" in found.decision.evidence
    masks = [np.zeros(p.shape[:2], bool) for p in photos.photos]
    assert start("on", with_photos(photos, photos.photos, masks)).decision.chosen == "off"


def test_on_takes_less_than_auto_does() -> None:
    photos = ball_scene()[1]
    grey = [np.full_like(p, 120) for p in photos.photos]
    for changed, photo in zip(grey, photos.photos, strict=True):
        changed[36:70, 44:84] = photo[36:70, 44:84]
    little = with_photos(photos, grey)
    automatic, asked = start("auto", little), start("on", little)
    assert 0.0 < asked.decision.figures["confirmed"] < LEAST_CONFIRMED
    assert automatic.gaussians is None
    assert automatic.decision.chosen == "off"
    assert asked.gaussians is not None
    assert asked.decision.chosen == "on"


@pytest.mark.parametrize("limit", [1, 5, 200, 900])
def test_there_are_never_more_than_allowed(limit: int) -> None:
    found = start(max_gaussians=limit)
    assert found.gaussians is not None
    assert 0.5 * limit <= len(found.gaussians) <= limit


def test_sparse_points_away_from_dense_ones_are_kept_round() -> None:
    scene, _ = ball_scene()
    away = np.array([[0.0, 0.0, 5.0], [0.3, -0.2, 6.0]])
    more = dataclasses.replace(
        scene,
        points=np.concatenate([scene.points, away, [[np.nan] * 3]]),
        point_colors=np.concatenate([scene.point_colors, np.full((3, 3), 200, np.uint8)]),
    )
    gaussians = start(scene=more).gaussians
    assert gaussians is not None
    means = gaussians.means.numpy()
    for point in away:
        nearest = np.linalg.norm(means - point, axis=1).argmin()
        assert means[nearest] == pytest.approx(point, abs=1e-6)
        assert np.ptp(gaussians.log_scales[nearest].numpy()) < 1e-6
        assert torch.sigmoid(gaussians.opacity_logits[nearest]) == pytest.approx(0.1, abs=1e-5)
    # Those on the surfaces that stereo found say nothing new.
    near = scene.points[np.abs(np.linalg.norm(scene.points, axis=1) - 1.0) < 1e-6]
    gap = np.linalg.norm(means[:, None] - near[None], axis=2).min(0)
    assert (gap < 1e-6).mean() < 0.5


def test_joined_gaussians_are_those_of_both() -> None:
    first, second = sphere_gaussians(5), sphere_gaussians(3)
    both = first.joined(second)
    for name, tensor in both.tensors():
        expected = torch.cat([getattr(first, name), getattr(second, name)])
        assert torch.equal(tensor, expected), name


SETTINGS = TrainingSettings(
    iterations=4, max_gaussians=1500, max_image_px=128, sh_degree=1, wrapping="off", growth="off",
    harmonics="off", exposure="off", multi_view="off", holdout_every=0,
)  # fmt: skip


def first_state(setting: str, folder: Path, events: list[ProgressEvent]) -> TrainingState:
    scene, photos = ball_scene()
    few = dataclasses.replace(scene, views=scene.views[3:8])
    own = PhotosInMemory(few, photos.photos[3:8])
    settings = dataclasses.replace(SETTINGS, dense_start=setting)
    progress = Progress("train", events.append)
    run = trainer._Trainer(few, own, settings, folder, 0, 1, progress=progress)
    return run._start(Rounds(run.stepper, progress), "key")


def test_the_training_starts_from_what_the_setting_says(tmp_path: Path) -> None:
    events: list[ProgressEvent] = []
    dense, sparse = (first_state(setting, tmp_path, events) for setting in ("on", "off"))
    decisions = [
        {d.name: d for d in state.model_selection}["dense_start"] for state in (dense, sparse)
    ]
    assert [(d.setting, d.chosen, d.measured) for d in decisions] == [
        ("on", "on", True), ("off", "off", False),
    ]  # fmt: skip
    scales = [state.to_arrays() for state in (dense, sparse)]
    flat = [
        np.ptp(next(v for k, v in arrays.items() if k.endswith("log_scales")), axis=1)
        for arrays in scales
    ]
    assert (flat[0] > 1.0).mean() > 0.4
    assert (flat[1] < 1e-5).all()
    # Matching comes before the training, whose share of the work is counted from 0.
    matching = [event for event in events if "matching" in event.message]
    assert len(matching) == 25
    assert {event.fraction for event in matching} == {0.0}
    assert matching[-1].message.endswith("100%")


def stopping_at(iteration: int) -> Progress:
    """Return progress that cancels once an iteration was reported."""
    reached: list[float] = []

    def look(event: ProgressEvent) -> None:
        if event.figures.get("iteration", 0.0) >= iteration:
            reached.append(event.fraction)

    return Progress("train", look, lambda: bool(reached))


def test_the_opacity_prior_leaves_fewer_half_transparent_gaussians(tmp_path: Path) -> None:
    scene, photos = ball_scene()
    few = dataclasses.replace(scene, views=scene.views[3:8])
    own = PhotosInMemory(few, photos.photos[3:8])
    settings = dataclasses.replace(SETTINGS, dense_start="on", iterations=60, depth_from=0.1)
    shares, psnr = [], []
    for weight in (0.0, settings.lambda_opacity):
        folder = tmp_path / str(weight)
        folder.mkdir()
        asked = dataclasses.replace(settings, lambda_opacity=weight)
        result = trainer.train(few, own, asked, folder, Progress(), threads=1)
        opacity = result.gaussians.log_opacities().exp().numpy()
        shares.append(float((opacity[opacity > 0.2] < 0.8).mean()))
        psnr.append(result.history[-1]["psnr"])
    assert shares[1] < 0.7 * shares[0]
    assert psnr[1] > psnr[0] - 0.5


@pytest.mark.parametrize("lost", [False, True])
def test_a_resumed_training_holds_the_same_depths(tmp_path: Path, lost: bool) -> None:
    """Bit for bit, also where the file of the depths is lost and they are made again."""
    scene, photos = ball_scene()
    few = dataclasses.replace(scene, views=scene.views[3:8])
    own = PhotosInMemory(few, photos.photos[3:8])
    settings = dataclasses.replace(
        SETTINGS, dense_start="on", iterations=20, depth_from=0.0, lambda_depth_prior=5.0
    )
    for name in ("whole", "free", "cut"):
        (tmp_path / name).mkdir()
    whole = trainer.train(few, own, settings, tmp_path / "whole", Progress(), threads=1)
    free = dataclasses.replace(settings, lambda_depth_prior=0.0)
    without = trainer.train(few, own, free, tmp_path / "free", Progress(), threads=1)
    assert not torch.equal(whole.gaussians.means, without.gaussians.means)
    with pytest.raises(Cancelled):
        trainer.train(few, own, settings, tmp_path / "cut", stopping_at(10), threads=1)
    if lost:
        (tmp_path / "cut" / FILE_NAME).unlink()
    resumed = trainer.train(few, own, settings, tmp_path / "cut", Progress(), threads=1)
    for (name, value), (_, expected) in zip(
        resumed.gaussians.tensors(), whole.gaussians.tensors(), strict=True
    ):
        assert torch.equal(value, expected), name
    assert (tmp_path / "cut" / FILE_NAME).is_file()


# -- Points on a far sphere where photos show a sky that nothing explains -------------------------

WIDTH, HEIGHT = 96, 64
NO_POINTS = np.zeros((0, 3))


def sky_color(directions: np.ndarray) -> np.ndarray:
    """Return (..., 3) grey levels of unit directions: smooth, different to all sides."""
    return 128 + 100 * directions


def sky_map(camera: Camera) -> DepthMap:
    """Return the map of a photo of nothing but sky."""
    shape = (HEIGHT, WIDTH)
    rays = camera.rays() @ camera.rotation
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return DepthMap(
        camera=camera,
        depth=np.full(shape, 3.0, np.float32),
        normal=np.zeros((*shape, 3), np.float32),
        confidence=np.zeros(shape, np.float32),
        agreeing=np.zeros(shape, np.uint8),
        cost=np.ones(shape, np.float32),
        color=np.round(sky_color(rays)).astype(np.uint8),
        mask=None,
    )


def cameras() -> list[Camera]:
    places = np.array([[0.0, 0, 0], [0.3, 0.2, 0], [-0.2, 0.1, 0.1]])
    targets = np.array([[5.0, 0, 2], [5.0, 1, 2], [0, 5.0, 3]])
    return [
        look_at(p, t, str(i), WIDTH, HEIGHT, 90.0)
        for i, (p, t) in enumerate(zip(places, targets, strict=True))
    ]


MAPS = [sky_map(camera) for camera in cameras()]


def test_the_sky_lands_on_the_sphere_in_its_colours() -> None:
    shell, radius = far_shell(MAPS, NO_POINTS, 1000)
    assert radius == LEAST_REACH
    assert 100 < len(shell) <= 3 * (WIDTH // CELL_PX) * (HEIGHT // CELL_PX)
    assert np.linalg.norm(shell.positions, axis=1) == pytest.approx(radius)
    assert shell.normals == pytest.approx(-shell.positions / radius)
    assert np.abs(shell.colors - sky_color(shell.positions / radius)).max() < 6
    seen = np.zeros(len(shell), bool)
    for camera in cameras():
        pixels, depth = camera.project(shell.positions)
        size = np.array([WIDTH, HEIGHT])
        seen |= (depth > 0) & (pixels > 0).all(1) & (pixels < size).all(1)
    assert seen.all()
    gap = np.linalg.norm(shell.positions[:, None] - shell.positions[None], axis=2)
    np.fill_diagonal(gap, np.inf)
    assert np.median(gap.min(1)) == pytest.approx(shell.sizes[0], rel=0.5)


def test_one_photo_gives_each_cell_its_direction() -> None:
    shell, radius = far_shell(MAPS[:1], NO_POINTS, 10_000)
    pixels, _ = cameras()[0].project(shell.positions)
    middles = (np.floor(pixels / CELL_PX) + 0.5) * CELL_PX
    assert np.median(np.abs(pixels - middles)) < 0.5
    assert radius > 0


def test_the_sphere_is_far_behind_all_points() -> None:
    points = np.random.default_rng(0).normal(size=(500, 3))
    points *= 40.0 / np.linalg.norm(points, axis=1, keepdims=True)
    shell, radius = far_shell(MAPS, points, 1000)
    assert radius == pytest.approx(REACH_FACTOR * 40.0)
    assert np.linalg.norm(shell.positions, axis=1) == pytest.approx(radius)


def test_points_cover_their_cells() -> None:
    camera = cameras()[0]
    left = camera.rays()[4::8, 4 : WIDTH // 2 : 8].reshape(-1, 3) * 3.0
    points = camera.center + left @ camera.rotation
    shell, _ = far_shell(MAPS[:1], points, 1000)
    assert len(shell) > 20
    assert camera.project(shell.positions)[0][:, 0].min() > WIDTH / 2
    behind = camera.center - left @ camera.rotation
    assert len(far_shell(MAPS[:1], behind, 1000)[0]) > 1.5 * len(shell)


def test_explained_and_masked_pixels_give_nothing() -> None:
    shape = (HEIGHT, WIDTH)
    for change in (
        {"agreeing": np.ones(shape, np.uint8)},
        {"cost": np.full(shape, 0.3, np.float32)},
        {"mask": np.zeros(shape, bool)},
    ):
        maps = [dataclasses.replace(m, **change) for m in MAPS]
        shell, radius = far_shell(maps, NO_POINTS, 1000)
        assert len(shell) == 0
        assert shell.positions.shape == shell.normals.shape == shell.colors.shape == (0, 3)
        assert radius == LEAST_REACH


@pytest.mark.parametrize("wanted", [0, 1, 7, 40])
def test_there_are_no_more_than_wanted(wanted: int) -> None:
    shell, _ = far_shell(MAPS, NO_POINTS, wanted)
    assert min(1, wanted) <= len(shell) <= wanted
    assert np.isfinite(shell.positions).all()


def test_photos_smaller_than_a_cell_have_no_open_cells() -> None:
    camera = cameras()[0].resized(7, 5)
    small = dataclasses.replace(
        MAPS[0], camera=camera,
        **{
            name: getattr(MAPS[0], name)[:5, :7]
            for name in ("depth", "normal", "confidence", "agreeing", "cost", "color")
        },
    )  # fmt: skip
    assert len(far_shell([small], NO_POINTS, 100)[0]) == 0

# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth maps of the ball scene against its exact depths and normals."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.progress import Progress, ProgressEvent
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo import depth_maps as depth_maps_module
from gaussian_wrapping_addon.core.stereo.depth_maps import (
    MOST_PIXELS,
    SINGLE_COST,
    DepthMap,
    _depth_range,
    estimate_depth_maps,
    matching_divisor,
)
from gaussian_wrapping_addon.core.stereo.matching import WORST_COST, in_image
from tests.core.stereo.ball_scene import (
    SIDE_PX,
    ball_maps,
    ball_scene,
    surface_points,
    true_depth,
    true_normals,
    with_photos,
)
from tests.core.training.small_scene import PhotosInMemory

FEW = range(4, 8)
"""Views of the tests that match again."""

match = functools.partial(estimate_depth_maps, side_px=SIDE_PX)


def few_maps(
    photos: PhotosInMemory, *, views: range = FEW, seed: int = 0, threads: int = 1
) -> list[DepthMap]:
    points = ball_scene()[0].points
    return match(photos, views, points, Progress(), seed=seed, threads=threads)


def errors(depth_maps: list[DepthMap] | tuple[DepthMap, ...]) -> np.ndarray:
    """Return the relative errors of the confirmed depths."""
    return np.concatenate(
        [np.abs(m.depth / true_depth(m.camera) - 1)[m.confidence > 0] for m in depth_maps]
    )


def test_confirmed_depths_and_normals_are_true() -> None:
    depth_maps = ball_maps()
    confirmed = [float((m.confidence > 0).mean()) for m in depth_maps]
    assert min(confirmed) > 0.4
    assert np.mean(confirmed) > 0.55
    assert (errors(depth_maps) < 0.01).mean() > 0.75
    assert np.median(errors(depth_maps)) < 0.003
    angles = []
    for m in depth_maps:
        truth = true_normals(surface_points(m.camera).reshape(-1, 3)).reshape(m.normal.shape)
        assert np.linalg.norm(m.normal, axis=-1) == pytest.approx(1.0, abs=1e-5)
        cosine = (truth * m.normal).sum(-1)[m.confidence > 0]
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    assert np.median(np.concatenate(angles)) < 7.0


def test_more_certain_depths_are_more_accurate() -> None:
    depth_maps = ball_maps()
    certain = np.concatenate([m.confidence[m.confidence > 0] for m in depth_maps])
    order = np.argsort(certain)
    found, third = errors(depth_maps)[order], len(order) // 3
    assert certain.max() <= 1.0
    assert (found[-third:] < 0.01).mean() > (found[:third] < 0.01).mean() + 0.05


@pytest.mark.parametrize(("least_px", "least"), [(10.0, 0.02), (1e9, 0.0)])
def test_one_source_confirms_from_aside_alone(
    least_px: float, least: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(depth_maps_module, "SINGLE_PARALLAX_PX", least_px)
    found = few_maps(ball_scene()[1])
    single = [(m.confidence > 0) & (m.agreeing == 1) for m in found]
    share = np.mean([part.mean() for part in single])
    assert share > least if least else share == 0.0
    for m, part in zip(found, single, strict=True):
        assert (m.cost[part] < SINGLE_COST).all()
        assert (m.confidence[part] <= 0.25).all()


def test_the_number_of_threads_does_not_matter_and_the_seed_does() -> None:
    photos = ball_scene()[1]
    one, two, other = few_maps(photos), few_maps(photos, threads=2), few_maps(photos, seed=1)
    for a, b in zip(one, two, strict=True):
        for name in ("depth", "normal", "confidence", "agreeing", "cost"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert not np.array_equal(one[0].depth, other[0].depth)


def test_a_mask_excludes_pixels() -> None:
    photos = ball_scene()[1]
    mask = np.ones(photos.photos[0].shape[:2], bool)
    mask[:, :50] = False
    masks = [mask] * len(photos.photos)
    masks[5] = np.zeros_like(mask)
    found = few_maps(with_photos(photos, photos.photos, masks))
    assert (found[0].confidence[:, 50:] > 0).mean() > 0.3
    assert not found[0].confidence[:, :50].any()
    assert not found[1].confidence.any()


def test_few_points_few_views_and_tiny_photos_give_nothing() -> None:
    scene, photos = ball_scene()
    assert few_maps(photos, views=range(2)) == []
    assert match(photos, FEW, scene.points[:19], Progress(), threads=1) == []
    assert match(photos, FEW, np.zeros((0, 3)), Progress(), threads=1) == []
    views = tuple(dataclasses.replace(v, camera=v.camera.resized(128, 1)) for v in scene.views[:4])
    flat = dataclasses.replace(scene, views=views)
    lines = PhotosInMemory(flat, [photo[:1] for photo in photos.photos[:4]])
    assert match(lines, range(4), scene.points, Progress(), threads=1) == []


def test_photos_of_one_colour_confirm_nothing() -> None:
    photos = ball_scene()[1]
    grey = [np.full_like(photo, 120) for photo in photos.photos]
    for found in few_maps(with_photos(photos, grey)):
        assert not found.confidence.any()
        assert found.cost.min() > 0.9


def test_exposure_changes_little() -> None:
    photos = ball_scene()[1]
    changed = list(photos.photos)
    changed[5] = np.round(0.6 * changed[5].astype(float)).astype(np.uint8)
    plain, darker = few_maps(photos), few_maps(with_photos(photos, changed))
    for before, after in zip(plain, darker, strict=True):
        shares = [(m.confidence > 0).mean() for m in (before, after)]
        assert shares[1] == pytest.approx(shares[0], abs=0.06)
    assert (errors(darker) < 0.01).mean() > (errors(plain) < 0.01).mean() - 0.05


def test_a_view_that_shares_no_points_confirms_and_guesses_nothing() -> None:
    scene, photos = ball_scene()
    camera = scene.views[3].camera
    turn = np.diag([-1.0, 1.0, -1.0])  # it looks the other way
    views = list(scene.views)
    views[3] = dataclasses.replace(
        views[3], camera=dataclasses.replace(camera, cam_from_world=turn @ camera.cam_from_world)
    )
    near = scene.points[np.linalg.norm(scene.points, axis=1) < 1.5]
    turned = PhotosInMemory(dataclasses.replace(scene, views=tuple(views)), photos.photos)
    found = match(turned, range(3, 7), near, Progress(), threads=1)
    assert not found[0].confidence.any()
    assert not found[0].agreeing.any()
    assert (found[0].cost == WORST_COST).all()
    assert (found[2].confidence > 0).mean() > 0.2


def test_progress_never_falls_and_ends_at_1() -> None:
    scene, photos = ball_scene()
    events: list[ProgressEvent] = []
    match(photos, FEW, scene.points, Progress("train", events.append), threads=2)
    fractions = [event.fraction for event in events]
    assert fractions == sorted(fractions)
    assert fractions[0] > 0.0
    assert fractions[-1] == pytest.approx(1.0)
    assert len(fractions) == 5 * len(FEW)


@pytest.mark.parametrize("threads", [1, 2])
def test_it_can_be_cancelled(threads: int) -> None:
    scene, photos = ball_scene()
    events: list[ProgressEvent] = []
    progress = Progress("train", events.append, lambda: len(events) >= 3)
    with pytest.raises(Cancelled):
        match(photos, FEW, scene.points, progress, threads=threads)
    assert len(events) <= 3 + threads


def _camera(width: int, height: int) -> Camera:
    return ball_scene()[0].views[0].camera.resized(width, height)


@pytest.mark.parametrize(
    ("width", "height", "count", "divisor"),
    [(640, 480, 10, 1), (641, 480, 10, 2), (300, 2561, 10, 8), (400, 300, 101, 2), (60, 40, 1, 1)],
)
def test_both_limits_are_kept_by_the_least_divisor(
    width: int, height: int, count: int, divisor: int
) -> None:
    cameras = [_camera(width, height), *[_camera(min(width, 640), height)] * (count - 1)]
    assert matching_divisor(cameras, 640) == divisor
    assert max(width, height) / divisor <= 640
    assert sum(c.width * c.height for c in cameras) / divisor**2 <= MOST_PIXELS


def test_the_range_of_depths_is_finite_wherever_the_points_are() -> None:
    camera = _camera(128, 96)
    points = ball_scene()[0].points
    inside, depth = in_image(camera, points)
    low, high = _depth_range(camera, points)
    assert low < 0.1 / depth[inside].max()
    assert 1 / depth[inside].min() < high < 2 / depth[inside].min()
    at_the_camera = np.tile(camera.center, (30, 1))
    low, high = _depth_range(camera, at_the_camera)
    assert 0 < low < high < 100

# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth maps of all photos: matched, checked, filled, fused, kept."""

from __future__ import annotations

import dataclasses
import functools
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.progress import Progress, ProgressEvent
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo import depth_maps as depth_maps_module
from gaussian_wrapping_addon.core.stereo.depth_maps import (
    FILE_NAME,
    MOST_PIXELS,
    PLANE_SHARE,
    PLANE_STEP_PX,
    SINGLE_COST,
    DepthMap,
    _depth_range,
    count_views,
    estimate_depth_maps,
    fill_gaps,
    fuse,
    lifted,
    load_priors,
    matching_divisor,
    merged,
    planar_pixels,
    plane_normals,
    points_in_view,
    priors_of,
    save_priors,
    seen_through,
    shown_open,
    triangle_planes,
)
from gaussian_wrapping_addon.core.stereo.matching import in_image
from gaussian_wrapping_addon.core.stereo.matching_cost import WORST_COST
from tests.core.stereo.ball_scene import (
    SIDE_PX,
    arc_cameras,
    ball_maps,
    ball_scene,
    exact_map,
    surface_distance,
    surface_points,
    true_depth,
    true_normals,
    with_photos,
)
from tests.core.stereo.textured_plane import NORMAL, cameras, true_planes
from tests.core.training.small_scene import PhotosInMemory
from tests.synthetic import trace

# -- Depth maps of the ball scene against its exact depths and normals ----------------------------

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


# -- Confirmed depths on disk, and what they weigh ------------------------------------------------

VIEW = 5


def exact_prior():
    _, photos = ball_scene()
    return photos.camera(VIEW), exact_map(photos.camera(VIEW))


def test_what_is_saved_is_loaded_bit_for_bit(tmp_path: Path) -> None:
    camera, found = exact_prior()
    priors = priors_of([VIEW], [dataclasses.replace(found, free=2.0 * found.depth)])
    save_priors(tmp_path, priors, "key")
    loaded = load_priors(tmp_path, {VIEW: camera}, "key")
    assert loaded is not None
    assert list(loaded) == [VIEW]
    assert np.array_equal(loaded[VIEW].depth, priors[VIEW].depth)
    assert np.array_equal(loaded[VIEW].confidence, priors[VIEW].confidence)
    assert np.array_equal(loaded[VIEW].known, np.where(found.confidence > 0, found.depth, 0))
    assert np.array_equal(loaded[VIEW].free, 2.0 * found.depth)
    assert loaded[VIEW].camera == camera


def test_without_parts_that_have_no_texture_nothing_is_known_to_be_free() -> None:
    _, found = exact_prior()
    assert not priors_of([VIEW], [found])[VIEW].free.any()


def test_other_keys_views_and_sizes_are_not_loaded(tmp_path: Path) -> None:
    camera, found = exact_prior()
    assert load_priors(tmp_path, {VIEW: camera}, "key") is None
    save_priors(tmp_path, priors_of([VIEW], [found]), "key")
    assert load_priors(tmp_path, {VIEW: camera}, "other") is None
    assert load_priors(tmp_path, {VIEW + 1: camera}, "key") is None
    half = camera.resized(camera.width // 2, camera.height // 2)
    assert load_priors(tmp_path, {VIEW: half}, "key") is None


def test_a_damaged_file_is_not_loaded(tmp_path: Path) -> None:
    camera, found = exact_prior()
    priors = priors_of([VIEW], [found])
    save_priors(tmp_path, priors, "key")
    whole = (tmp_path / FILE_NAME).read_bytes()
    for content in (b"", b"nothing", whole[: len(whole) // 2]):
        (tmp_path / FILE_NAME).write_bytes(content)
        assert load_priors(tmp_path, {VIEW: camera}, "key") is None
    for place in np.random.default_rng(0).integers(0, len(whole), 60).tolist():
        changed = bytearray(whole)
        changed[place] ^= 1
        (tmp_path / FILE_NAME).write_bytes(changed)
        loaded = load_priors(tmp_path, {VIEW: camera}, "key")
        # Some bytes of an archive, such as times, say nothing about its content.
        assert loaded is None or np.array_equal(loaded[VIEW].depth, priors[VIEW].depth)


def test_a_file_that_unpacks_to_more_than_the_photos_have_is_not_loaded(tmp_path: Path) -> None:
    camera, _ = exact_prior()
    layers = ("depth", "confidence", "known", "free")
    huge = {f"{layer}.{VIEW}": np.zeros((4000, 4000), np.float32) for layer in layers}
    np.savez_compressed(tmp_path / FILE_NAME, key=np.array("key"), **huge)
    tracemalloc.start()
    assert load_priors(tmp_path, {VIEW: camera}, "key") is None
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


def plane_map(tilt: float = 0.3) -> tuple[DepthMap, np.ndarray]:
    """Return a confirmed map of a tilted plane in every pixel, and the plane's normal."""
    _, found = exact_prior()
    camera = found.camera
    normal = np.array([tilt, -0.2, -1.0])
    normal /= np.linalg.norm(normal)
    rays = camera.rays()
    depth = (4.0 * normal[2]) / (rays @ normal)
    normals = np.broadcast_to(normal @ camera.rotation, found.normal.shape)
    changed = dataclasses.replace(
        found, depth=depth.astype(np.float32), normal=normals.astype(np.float32)
    )
    return changed, normal


def test_all_pixels_of_a_plane_count_but_those_near_the_border() -> None:
    found, _ = plane_map()
    inner = np.zeros(found.depth.shape, bool)
    inner[PLANE_STEP_PX:-PLANE_STEP_PX, PLANE_STEP_PX:-PLANE_STEP_PX] = True
    assert np.array_equal(planar_pixels(found), inner)
    prior = priors_of([VIEW], [found])[VIEW]
    assert np.array_equal(prior.confidence, np.where(inner, found.confidence, 0))
    assert np.array_equal(prior.depth, np.where(inner, found.depth, 0))


def test_steps_noise_and_unconfirmed_neighbours_do_not_count() -> None:
    found, _ = plane_map()
    half = found.depth.shape[1] // 2
    step = found.depth.copy()
    step[:, half:] *= np.float32(1.0 + 2.0 * PLANE_SHARE)
    planar = planar_pixels(dataclasses.replace(found, depth=step))
    assert not planar[:, half - PLANE_STEP_PX : half + PLANE_STEP_PX].any()
    assert planar[8:-8, 8 : half - PLANE_STEP_PX].all()
    noise = np.random.default_rng(0).normal(0.0, 2.0 * PLANE_SHARE, step.shape)
    noisy = (found.depth * (1.0 + noise)).astype(np.float32)
    assert planar_pixels(dataclasses.replace(found, depth=noisy)).mean() < 0.01
    holes = found.confidence.copy()
    holes[20, 30] = 0.0
    planar = planar_pixels(dataclasses.replace(found, confidence=holes))
    assert not planar[20, 30]
    assert not planar[20 + PLANE_STEP_PX, 30]
    assert planar[21 + PLANE_STEP_PX, 30]


def test_the_ball_does_not_count_and_the_floor_does() -> None:
    """Exact depths of a ball deviate from its tangent planes within five pixels."""
    _, found = exact_prior()
    points = surface_points(found.camera)
    on_ball = np.abs(np.linalg.norm(points, axis=-1) - 1.0) < 1e-3
    on_floor = (np.abs(points[..., 2] + 1.0) < 1e-3) & ~on_ball
    planar = planar_pixels(found)
    assert planar[on_ball].mean() < 0.05
    assert planar[on_floor].mean() > 0.5


# -- Points fused from exact and from estimated depth maps ----------------------------------------

EXACT = [exact_map(camera) for camera in arc_cameras()[:4]]


@pytest.mark.parametrize("wanted", [500, 2000, 8000])
def test_there_are_about_as_many_points_as_wanted_on_the_surfaces(wanted: int) -> None:
    found = fuse(EXACT, wanted)
    assert 0.7 * wanted < len(found) <= wanted
    distance = surface_distance(found.positions)
    assert np.median(distance) < 1e-4
    assert np.percentile(distance, 95) < 0.05
    assert (distance < 0.5 * found.sizes + 1e-6).mean() > 0.98


def test_a_wall_at_one_distance_gives_as_many_points_too() -> None:
    shape = EXACT[0].depth.shape
    normal = np.broadcast_to(-EXACT[0].camera.forward.astype(np.float32), (*shape, 3))
    wall = dataclasses.replace(EXACT[0], depth=np.full(shape, 4.0, np.float32), normal=normal)
    for wanted in (300, 500, 700, 1000):
        assert 0.7 * wanted < len(fuse([wall], wanted)) <= wanted


def test_estimated_depths_give_points_near_the_surfaces() -> None:
    found = fuse(ball_maps(), 3000)
    inner = np.linalg.norm(found.positions, axis=1) < 4.0  # ball and floor before the arc
    distance = surface_distance(found.positions[inner])
    assert inner.sum() > 500
    assert np.median(distance) < 0.02
    assert np.percentile(distance, 90) < 0.3


def test_normals_and_colours_are_those_of_the_pixels() -> None:
    found = fuse(EXACT, 6000)
    cosine = (found.normals * true_normals(found.positions)).sum(1)
    assert np.percentile(cosine, 5) > 0.98
    nearest = EXACT[1].camera.center
    towards = ((nearest - found.positions) * found.normals).sum(1)
    assert (towards > 0).mean() > 0.95
    near = np.linalg.norm(found.positions, axis=1) < 3.0
    eye = np.array([0.0, 0.0, 3.5])
    up = near & (found.positions[:, 2] > 0.5)  # of the ball, seen from above
    truth = 255 * trace(eye, found.positions[up] - eye)
    assert up.sum() > 50
    assert np.median(np.abs(found.colors[up] - truth)) < 6.0


def test_points_of_like_normal_are_averaged_and_outliers_left_out() -> None:
    flat = exact_map(arc_cameras()[0])
    random = np.random.default_rng(0)
    noisy = dataclasses.replace(
        flat, depth=(flat.depth * (1 + 0.003 * random.normal(size=flat.depth.shape))).astype("f4")
    )
    single, fused = lifted([noisy], [noisy.confidence]), fuse([noisy], 700)
    before = np.median(surface_distance(single.positions))
    assert np.median(surface_distance(fused.positions)) < 0.75 * before
    assert len(single) == flat.depth.size


def test_pixels_without_confidence_give_no_points() -> None:
    confidence = np.zeros_like(EXACT[0].confidence)
    nothing = dataclasses.replace(EXACT[0], confidence=confidence)
    assert len(fuse([nothing], 100)) == 0
    assert len(fuse([], 100)) == 0
    confidence = confidence.copy()
    confidence[3, 4] = 0.5
    one = fuse([dataclasses.replace(EXACT[0], confidence=confidence)], 100)
    assert one.positions.shape == (1, 3)
    pixel, depth = EXACT[0].camera.project(one.positions)
    assert pixel[0] == pytest.approx([4.5, 3.5], abs=1e-3)
    assert depth[0] == pytest.approx(EXACT[0].depth[3, 4], rel=1e-6)
    assert len(merged(one, 5)) == 1


# -- Guesses stay where nothing is known, and go where photos see through them --------------------

OTHERS = [exact_map(camera) for camera in arc_cameras()[4:8]]


def with_gap(depth_map: DepthMap, factor: float, cost: float = 0.5) -> DepthMap:
    """Return a map whose middle is a guess at ``factor`` times the depth."""
    gap = np.zeros(depth_map.depth.shape, bool)
    gap[30:60, 40:90] = True
    return dataclasses.replace(
        depth_map,
        depth=np.where(gap, factor * depth_map.depth, depth_map.depth).astype(np.float32),
        confidence=np.where(gap, 0, depth_map.confidence).astype(np.float32),
        agreeing=np.where(gap, 0, depth_map.agreeing).astype(np.uint8),
        cost=np.where(gap, cost, depth_map.cost).astype(np.float32),
    )


def test_guesses_away_from_confirmed_points_are_kept() -> None:
    gaps = [with_gap(m, 1.0) for m in OTHERS]
    known = fuse(gaps, 3000)
    found = fill_gaps(gaps, known, 1500)
    assert len(found) > 50
    assert np.percentile(surface_distance(found.positions), 95) < 0.05
    distance = np.linalg.norm(found.positions[:, None] - known.positions[None], axis=2)
    near = distance <= 0.5 * np.maximum(found.sizes[:, None], known.sizes[None])
    nearest = distance.argmin(1)
    assert not near[np.arange(len(found)), nearest].any()


def test_guesses_where_photos_see_through_are_dropped() -> None:
    before = [with_gap(OTHERS[0], 0.7), *OTHERS[1:]]
    behind = [with_gap(OTHERS[0], 1.0), *OTHERS[1:]]
    nothing = fuse(OTHERS, 10).select(np.zeros(0, int))
    some = fuse([OTHERS[0]], 10).select(np.arange(1))
    assert len(fill_gaps(before, nothing, 500)) > 50  # without confirmed points all stay
    assert len(fill_gaps(before, some, 500)) < 0.1 * len(fill_gaps(behind, some, 500))


def test_guesses_near_confirmed_points_are_dropped() -> None:
    gaps = [with_gap(OTHERS[0], 1.0), *OTHERS[1:]]
    alone = fill_gaps(gaps, fuse(gaps, 10).select(np.arange(1)), 1000)
    beside = fill_gaps(gaps, fuse(OTHERS, 8000), 1000)
    assert len(beside) < 0.5 * len(alone)


def test_guesses_where_nothing_matches_in_two_other_photos_are_dropped() -> None:
    """Where one photo shows them among what nothing explains, they stay."""
    some = fuse([OTHERS[0]], 10).select(np.arange(1))
    kept, in_open = [], []
    for opened in range(4):
        costs = [0.5] + [0.9] * opened + [0.0] * (3 - opened)
        maps = [with_gap(m, 1.0, cost=c) for m, c in zip(OTHERS, costs, strict=True)]
        found = fill_gaps(maps, some, 500)
        kept.append(len(found))
        in_open.append(count_views(found.positions, maps, shown_open).max())
    assert kept[1] > 50
    assert in_open == [0, 1, 1, 1]
    assert kept[3] < kept[2] < 0.8 * kept[1]


def test_where_nothing_matches_and_where_masks_exclude_nothing_is_guessed() -> None:
    nothing = fuse(OTHERS, 10).select(np.zeros(0, int))
    assert len(fill_gaps([with_gap(OTHERS[0], 1.0, cost=0.9)], nothing, 500)) == 0
    mask = np.zeros(OTHERS[0].depth.shape, bool)
    masked = dataclasses.replace(with_gap(OTHERS[0], 1.0), mask=mask)
    assert len(fill_gaps([masked], nothing, 500)) == 0
    assert len(fill_gaps([], nothing, 500)) == 0


@pytest.mark.parametrize(("share", "count"), [(0.9, 4), (0.99, 0), (1.0, 0), (1.2, 0)])
def test_views_that_see_through_points_are_counted(share: float, count: int) -> None:
    top = np.array([[0.0, 0.0, 1.0]])
    points = np.concatenate(
        [m.camera.center + share * (top - m.camera.center) for m in OTHERS]
    )  # (4, 3), each on its own camera's ray
    own = [count_views(p[None], [m], seen_through)[0] for p, m in zip(points, OTHERS, strict=True)]
    assert sum(own) == count


def test_points_outside_the_photos_are_not_seen_through() -> None:
    away = OTHERS[0].camera.center - OTHERS[0].camera.forward
    assert count_views(away[None], [OTHERS[0]], seen_through).tolist() == [0]
    blind = dataclasses.replace(OTHERS[0], confidence=np.zeros_like(OTHERS[0].confidence))
    before = OTHERS[0].camera.center + OTHERS[0].camera.forward
    assert count_views(before[None], [OTHERS[0], blind], seen_through).tolist() == [1]


# -- Planes of triangles between samples of a plane; which points a photo shows -------------------

CAMERA = cameras(1)[0]
PLANES = true_planes(CAMERA)


def sampled(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    pixels = random.uniform((12, 10), (52, 38), (count, 2))
    middle = PLANES[24, 32]
    return pixels, middle[0] + middle[1] * (pixels[:, 0] - 32) + middle[2] * (pixels[:, 1] - 24)


def test_the_plane_of_its_points_is_reproduced_and_nothing_beside_them() -> None:
    pixels, inverse = sampled()
    found = triangle_planes(pixels, inverse, CAMERA)
    there = found[..., 0] > 0
    assert found.dtype == np.float32
    assert there[16:32, 20:44].all()
    assert found[there] == pytest.approx(PLANES[there], rel=1e-5)
    row, column = np.nonzero(there)
    assert column.min() >= pixels[:, 0].min()
    assert column.max() <= pixels[:, 0].max()
    assert row.min() >= pixels[:, 1].min()
    assert row.max() <= pixels[:, 1].max()
    assert not found[~there].any()


def test_triangles_across_an_edge_are_dropped() -> None:
    random = np.random.default_rng(1)
    pixels = random.uniform((2, 2), (62, 46), (400, 2))
    inverse = np.where(pixels[:, 0] < 32, 1.0, 0.1)  # near on the left, far on the right
    found = triangle_planes(pixels, inverse, CAMERA)[4:44, 4:60]
    there = found[..., 0] > 0
    assert np.isin(np.round(found[there][:, 0], 3), (1.0, 0.1)).mean() > 0.99
    assert there.mean() > 0.8
    assert not there[:, 27:29].all()


def test_few_points_and_points_on_a_line_give_nothing() -> None:
    pixels, inverse = sampled()
    assert not triangle_planes(pixels[:3], inverse[:3], CAMERA).any()
    assert not triangle_planes(pixels[:0], inverse[:0], CAMERA).any()
    line = np.stack([np.arange(10.0), np.full(10, 7.0)], 1)
    assert not triangle_planes(line, np.ones(10), CAMERA).any()
    same = np.tile(pixels[:1], (10, 1))
    assert not triangle_planes(same, np.ones(10), CAMERA).any()


def test_normals_are_those_of_the_plane() -> None:
    normals = plane_normals(PLANES, CAMERA) @ CAMERA.rotation
    assert normals == pytest.approx(np.broadcast_to(-NORMAL, normals.shape), abs=1e-9)


def test_points_behind_others_are_hidden() -> None:
    ray = (CAMERA.rays()[20, 30] + [0.001, 0.001, 0]) @ CAMERA.rotation
    points = CAMERA.center + np.array([2.0, 2.1, 3.0])[:, None] * ray
    beside = CAMERA.center + 3.0 * CAMERA.rays()[40, 50] @ CAMERA.rotation
    away = CAMERA.center - ray
    pixels, inverse = points_in_view(CAMERA, np.concatenate([points, [beside, away]]))
    assert sorted(1 / inverse) == pytest.approx([2.0, 2.1, 3.0])
    assert pixels[np.argmax(np.abs(pixels[:, 0] - 30))] == pytest.approx([50, 40], abs=1e-6)


def test_points_behind_known_depths_are_hidden() -> None:
    pixels = np.array([[30.0, 20.0], [40.0, 20.0], [50.0, 20.0]])
    depth = np.array([0.9, 1.0, 1.1]) / PLANES[20, [30, 40, 50], 0]
    rays = CAMERA.rays()[20, [30, 40, 50]]
    points = CAMERA.center + depth[:, None] * rays @ CAMERA.rotation
    shown, inverse = points_in_view(CAMERA, points, PLANES[..., 0])
    assert shown == pytest.approx(pixels[:2], abs=1e-6)
    assert inverse == pytest.approx(1 / depth[:2])


def test_a_photo_may_show_no_point() -> None:
    for known in (None, PLANES[..., 0]):
        pixels, inverse = points_in_view(CAMERA, np.array([[0.0, 0.0, 99.0]]), known)
        assert pixels.shape == (0, 2)
        assert inverse.shape == (0,)

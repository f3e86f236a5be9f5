# SPDX-License-Identifier: GPL-3.0-or-later
"""PatchMatch: cost, propagation, source views, consistency."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.matching import (
    GOOD_COST,
    MOST_SOURCES,
    MatchingLevel,
    grey_levels,
    in_image,
    source_views,
)
from gaussian_wrapping_addon.core.stereo.matching_cost import (
    AT_X,
    AT_Y,
    GAIN,
    LEAST_TOLERANCE_LEVELS,
    MAX_BACK_ERROR_PX,
    NO_BRIGHTNESS,
    RATE,
    SAMPLES,
    SHADING_COST,
    WEIGHT,
    WEIGHTED_GREY,
    WINDOW,
    WORST_COST,
    back_error_px,
    fill_window,
    normal_of,
    random_share,
    slopes_of,
    view_cost,
)
from tests.core.stereo.textured_plane import (
    HEIGHT,
    NORMAL,
    WIDTH,
    cameras,
    grey_photo,
    level_of,
    plane_photos,
    true_planes,
)
from tests.synthetic import look_at

# -- Cost of true and of moved planes in photos of a plane with a pattern -------------------------

PIXELS = [(20, 32), (16, 26), (30, 36), (24, 30)]
"""Rows and columns whose windows all photos show."""

NEAR, ALIKE = np.ones(SAMPLES, np.float32), np.ones(256, np.float32)


def costs(
    other: np.ndarray,
    pixels: list[tuple[int, int]] = PIXELS,
    *,
    depth: float = 1.0,
    geometric: float = 0.0,
    brightness: tuple[float, float] = (1.0, 0.0),
    first: np.ndarray | None = None,
) -> np.ndarray:
    """Return the cost of planes at ``depth`` times the true one, in the second photo."""
    given, photos = plane_photos()
    first = photos[0] if first is None else first
    level = level_of([first, other, photos[2]], list(given))
    for view, camera in enumerate(given):
        level.planes_of(view)[:] = true_planes(camera)
    maps, back_maps, sizes, bases = level._joined[0]
    table = np.empty((6, SAMPLES), np.float32)
    table[AT_X], table[AT_Y] = WINDOW.T
    found = []
    for row, column in pixels:
        mean, variance = fill_window.py_func(first, row, column, NEAR, ALIKE, table)
        plane = (true_planes(given[0])[row, column] / depth).astype(np.float32)
        found.append(
            view_cost.py_func(
                0, np.float32(column), np.float32(row), *plane, maps, back_maps, level._quads,
                sizes, bases, level._stride, np.tile(np.float32(brightness), (2, 1)),
                level.inverse_depths(), np.float32(geometric), table, np.empty(SAMPLES, np.int32),
                np.float32(mean), np.float32(variance),
            )
        )  # fmt: skip
    return np.array(found)


def test_true_planes_cost_nothing_and_moved_ones_much_more() -> None:
    _, photos = plane_photos()
    assert costs(photos[1]).max() < 0.05
    for depth in (0.94, 1.06):
        assert costs(photos[1], depth=depth).min() > 0.07
    assert costs(photos[1], depth=0.75).min() > 0.5


def test_gain_and_offset_of_the_other_photo_do_not_matter() -> None:
    _, photos = plane_photos()
    darker = np.round(0.6 * photos[1].astype(float) + 30).astype(np.uint8)
    assert np.abs(costs(darker) - costs(photos[1])).max() < 0.02
    negative = 255 - photos[1]
    assert costs(negative).min() == WORST_COST


def test_a_photo_of_one_grey_costs_1_for_all_planes() -> None:
    flat = np.full_like(plane_photos()[1][1], 90)
    for depth in (0.9, 1.0, 1.1):
        assert costs(flat, depth=depth) == pytest.approx(1.0, abs=1e-3)


def test_a_plain_window_costs_by_how_much_its_brightness_differs() -> None:
    tolerance = 10.0
    plain = np.full_like(plane_photos()[1][0], 90)
    for level, gain, added in ((90, 1.0, 0.0), (91, 1.0, 0.1), (100, 1.0, 1.0), (80, 1.125, 0.0)):
        other = np.full_like(plain, level)
        found = costs(other, first=plain, brightness=(gain, 1.0 / tolerance))
        expected = min(1.0 + added * float(SHADING_COST), float(WORST_COST))
        assert found == pytest.approx(expected, abs=2e-3)


def test_brightness_hardly_counts_where_there_is_texture() -> None:
    _, photos = plane_photos()
    assert costs(photos[1], brightness=(1.2, 1.0)).max() < 0.15


def test_windows_that_leave_the_photo_cost_most() -> None:
    _, photos = plane_photos()
    assert (costs(photos[1], [(0, 0), (47, 63), (24, 1)]) == WORST_COST).all()


def test_depths_that_do_not_lead_back_cost_more() -> None:
    _, photos = plane_photos()
    plain = costs(photos[1])
    assert costs(photos[1], geometric=0.5) == pytest.approx(plain, abs=0.1)
    moved, checked = (costs(photos[1], depth=1.03, geometric=g) for g in (0.0, 0.5))
    assert (checked - moved).min() > 0.1


def test_the_window_is_weighted_and_clamped_at_the_border() -> None:
    random = np.random.default_rng(0)
    grey = random.integers(0, 256, (20, 30)).astype(np.uint8)
    near = random.uniform(0.1, 1, SAMPLES).astype(np.float32)
    alike = np.exp(-np.arange(256) / 40).astype(np.float32)
    table = np.empty((6, SAMPLES), np.float32)
    for row, column in ((10, 15), (0, 29)):
        mean, variance = fill_window.py_func(grey, row, column, near, alike, table)
        rows = np.clip(row + WINDOW[:, 1], 0, 19)
        columns = np.clip(column + WINDOW[:, 0], 0, 29)
        levels = grey[rows, columns].astype(float)
        weight = near * alike[np.abs(levels - grey[row, column]).astype(int)]
        weight = weight / weight.sum()
        assert table[WEIGHT] == pytest.approx(weight, rel=1e-4)
        assert mean == pytest.approx(weight @ levels, rel=1e-4)
        assert variance == pytest.approx(weight @ (levels - weight @ levels) ** 2, rel=1e-3)
        assert table[WEIGHTED_GREY] == pytest.approx(weight * (levels - mean), abs=1e-3)


# -- Levels of photos of different sizes, and planes handed to the next finer one -----------------


def test_grey_levels_are_the_luma() -> None:
    photo = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]]], np.uint8)
    assert grey_levels(photo).tolist() == [[76, 150, 29, 255]]


def test_a_finer_level_starts_on_the_same_planes() -> None:
    given = list(plane_photos()[0])
    fine = level_of(list(plane_photos()[1]), given)
    halves = [camera.resized(WIDTH // 2, HEIGHT // 2) for camera in given]
    coarse = level_of([grey_photo(camera) for camera in halves], halves)
    for view, camera in enumerate(halves):
        coarse.planes_of(view)[:] = true_planes(camera)
        coarse.costs[view][:] = 0.25 + view
        fine.start_from(coarse, view)
        assert np.abs(fine.planes_of(view) / true_planes(given[view]) - 1).max() < 1e-4
        assert (fine.costs[view] == np.float32(0.25 + view)).all()


def test_photos_of_different_sizes_confirm_each_other() -> None:
    given = cameras()
    given[1] = given[1].resized(48, 36)
    given[2] = given[2].resized(31, 23)
    level = level_of([grey_photo(camera) for camera in given], given)
    assert level.planes.shape == (3, HEIGHT, WIDTH, 3)
    for view, camera in enumerate(given):
        level.planes_of(view)[:] = true_planes(camera)
    depths = level.inverse_depths()
    for view, camera in enumerate(given):
        means = level.confirm(view, depths)
        assert means.shape == (camera.height, camera.width)
        assert means == pytest.approx(true_planes(camera)[..., 0], rel=2e-3)
        assert (level.confirmed[view] == 3).mean() > 0.4


def test_sweeps_over_photos_of_different_sizes_find_the_plane() -> None:
    given = cameras()
    given[1] = given[1].resized(48, 36)
    level = level_of([grey_photo(camera) for camera in given], given)
    random = np.random.default_rng(0)
    level.planes[..., 0] = random.uniform(0.1, 0.6, level.planes.shape[:3])
    for turn in range(3):
        level.sweep(1, turn, 0, fresh=True)
    found, truth = level.planes_of(1)[..., 0], true_planes(given[1])[..., 0]
    assert (np.abs(found / truth - 1) < 0.01)[8:-8, 10:-10].mean() > 0.8
    assert (level.planes[1, 36:, :, 1:] == 0).all()  # beyond the photo


def test_photos_smaller_than_the_window_match_nothing() -> None:
    given = [camera.resized(7, 5) for camera in cameras()]
    level = MatchingLevel(
        given, [grey_photo(c) for c in given], [np.array([1, 2]), np.array([0]), np.array([0])],
        np.tile([0.1, 0.6], (3, 1)),
    )  # fmt: skip
    level.planes[..., 0] = 0.3
    for turn in range(3):
        level.sweep(0, turn, 0, fresh=True)
    assert level.costs[0].min() > 1.0
    assert np.isfinite(level.planes).all()


# -- Sweeps find the plane of photos of a plane, from random ones ---------------------------------

INSIDE = (slice(8, 40), slice(12, 56))
"""Pixels whose windows other photos show."""


def random_level(photos: list[np.ndarray] | None = None) -> MatchingLevel:
    given, own = plane_photos()
    level = level_of(list(own) if photos is None else photos, list(given))
    random = np.random.default_rng(3)
    for view in range(len(level)):
        planes = level.planes_of(view)
        planes[..., 0] = random.uniform(0.1, 0.6, planes.shape[:2])
    return level


def share_right(level: MatchingLevel, view: int = 1) -> float:
    truth = true_planes(level.cameras[view])[..., 0]
    return float((np.abs(level.planes_of(view)[..., 0] / truth - 1) < 0.01)[INSIDE].mean())


def test_more_sweeps_find_the_plane_in_more_pixels() -> None:
    level = random_level()
    shares = [share_right(level)]
    for turn in range(3):
        level.sweep(1, turn, 0, fresh=True)
        shares.append(share_right(level))
    assert shares[0] < 0.1
    assert shares == sorted(shares)
    assert shares[-1] > 0.9
    assert np.median(level.costs[1][INSIDE]) < 0.05
    slopes, truth = level.planes_of(1)[..., 1:], true_planes(level.cameras[1])[..., 1:]
    assert np.median(np.abs(slopes - truth)[INSIDE]) < 0.1 * np.abs(truth).max()


def test_equal_seeds_give_equal_planes() -> None:
    first, again, other = random_level(), random_level(), random_level()
    for level, seed in ((first, 5), (again, 5), (other, 6)):
        level.sweep(0, 0, seed, fresh=True)
    assert np.array_equal(first.planes, again.planes)
    assert np.array_equal(first.costs[0], again.costs[0])
    assert not np.array_equal(first.planes, other.planes)


@pytest.mark.parametrize("seed", [0, 2**31 - 1, 2**40])
def test_every_seed_is_taken(seed: int) -> None:
    level = random_level()
    level.sweep(1, 0, seed, fresh=True)
    assert share_right(level) > 0.2


def test_planes_stay_in_the_range_of_depths() -> None:
    level = random_level([np.full_like(photo, 128) for photo in plane_photos()[1]])
    for turn in range(2):
        level.sweep(1, turn, 0, fresh=True)
    depths = level.planes_of(1)[..., 0]
    assert depths.min() >= np.float32(0.03)
    assert depths.max() <= np.float32(0.6)
    assert level.costs[1].min() > 0.9


def test_the_prior_decides_where_there_is_no_texture() -> None:
    level = random_level([np.full_like(photo, 128) for photo in plane_photos()[1]])
    prior = true_planes(level.cameras[1]).astype(np.float32)
    prior[:, :20] = 0.0
    level.sweep(1, 0, 0, prior=prior)
    truth = prior[..., 0]
    right = np.abs(level.planes_of(1)[:, 20:, 0] / truth[:, 20:] - 1) < 0.005
    assert right.mean() > 0.95


def test_a_photo_without_sources_is_left_alone_and_matches_nothing() -> None:
    given, photos = plane_photos()
    level = MatchingLevel(given, photos, [np.zeros(0, int)] * 3, np.tile([0.1, 0.6], (3, 1)))
    level.planes[..., 0] = 0.3
    level.sweep(0, 0, 0, fresh=True)
    assert (level.planes[..., 0] == np.float32(0.3)).all()
    assert (level.costs[0] == WORST_COST).all()
    assert not level.confirm(0, level.inverse_depths()).any()
    assert not level.confirmed[0].any()


def test_one_source_is_enough_to_find_planes() -> None:
    given, photos = plane_photos()
    sources = [np.array([1]), np.array([0])]
    level = MatchingLevel(given[:2], photos[:2], sources, np.tile([0.1, 0.6], (2, 1)))
    level.planes[..., 0] = np.random.default_rng(0).uniform(0.1, 0.6, level.planes.shape[:3])
    for turn in range(3):
        level.sweep(1, turn, 0, fresh=True)
    assert share_right(level) > 0.7


def level_with_kept_sources(kept_photos: str) -> MatchingLevel:
    """Return true planes whose pixels of photo 2 kept the sources 0 and 1, of these photos."""
    given = cameras(5)
    photos = [grey_photo(camera) for camera in given]
    random = np.random.default_rng(4)
    for k in (0, 1):
        noisy = photos[k] + random.normal(0.0, 5.0, photos[k].shape)
        changed = noisy if kept_photos == "noisy" else random.uniform(0, 255, noisy.shape)
        photos[k] = np.clip(changed, 0, 255).astype(np.uint8)
    level = level_of(photos, given)
    level.planes_of(2)[:] = true_planes(given[2])
    level._best_sources[2][:] = 0b0011
    level.sweep(2, 0, 0)
    return level


SHOWN = (slice(12, 36), slice(26, 38))
"""Pixels whose windows all five photos show."""


def test_sources_that_were_good_enough_are_kept() -> None:
    """Unless a neighbour hands on better ones: pixels at the border had to look for others."""
    level = level_with_kept_sources("noisy")
    kept = (level._best_sources[2] == 0b0011)[SHOWN]
    assert kept.mean() > 0.1  # judged in all sources, a noisy one is hardly ever among the best
    assert level.costs[2][SHOWN][kept].max() < GOOD_COST


def test_other_sources_are_asked_where_those_that_were_kept_do_not_match() -> None:
    level = level_with_kept_sources("others")
    assert (level._best_sources[2] == 0b1100)[SHOWN].mean() > 0.9
    assert np.median(level.costs[2][SHOWN]) < 0.05


# -- Plane hypotheses against vectors, cameras and closed forms -----------------------------------

LENS = np.array([90.0, 110.0, 31.5, 20.0])


def test_normal_and_slopes_are_inverse_of_each_other() -> None:
    random = np.random.default_rng(0)
    for _ in range(200):
        u, v = random.uniform(0, 60, 2)
        w, (a, b) = random.uniform(0.1, 2.0), random.normal(size=2) * 0.01
        *normal, cosine = normal_of.py_func(u, v, w, a, b, LENS)
        ray = np.array([(u - LENS[2]) / LENS[0], (v - LENS[3]) / LENS[1], 1.0])
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        assert cosine == pytest.approx(np.dot(normal, ray) / np.linalg.norm(ray))
        assert slopes_of.py_func(u, v, w, *normal, LENS) == pytest.approx((a, b), abs=1e-12)


def test_the_normal_is_that_of_the_plane() -> None:
    (camera, *_), photos = plane_photos()
    lens = level_of(list(photos), list(plane_photos()[0])).lenses[0].astype(float)
    w, a, b = true_planes(camera)[13, 40]
    normal = np.array(normal_of.py_func(40.0, 13.0, w, a, b, lens)[:3])
    assert normal @ camera.rotation == pytest.approx(-NORMAL, abs=1e-6)


def test_maps_agree_with_the_projection_of_the_cameras() -> None:
    given, photos = plane_photos()
    level = level_of(list(photos), list(given))
    points = np.random.default_rng(1).uniform(-1, 1, (300, 3))
    pixels, depth = given[0].project(points)
    homogeneous = np.concatenate([pixels - 0.5, np.ones((300, 1))], 1)
    maps, back_maps, sizes, bases = level._joined[0]
    for s, source in enumerate(level.sources[0]):
        there, depth_there = given[source].project(points)
        mapped = homogeneous @ maps[s, :9].reshape(3, 3).T + maps[s, 9:] / depth[:, None]
        assert np.abs(mapped[:, :2] / mapped[:, 2:] - (there - 0.5)).max() < 1e-4
        assert mapped[:, 2] * depth == pytest.approx(depth_there, rel=1e-5)
        back = np.concatenate([there - 0.5, np.ones((300, 1))], 1)
        back = back @ back_maps[s, :9].reshape(3, 3).T + back_maps[s, 9:] / depth_there[:, None]
        assert np.abs(back[:, :2] / back[:, 2:] - (pixels - 0.5)).max() < 1e-4
        assert tuple(sizes[s]) == (WIDTH - 1, HEIGHT - 1)
        assert bases[s] == source * WIDTH * HEIGHT


def test_the_back_error_is_0_for_consistent_depths_and_else_the_shift() -> None:
    given, photos = plane_photos()
    level = level_of(list(photos), list(given))
    for view, camera in enumerate(given):
        level.planes_of(view)[:] = true_planes(camera)
    _, back_maps, _, bases = level._joined[0]
    x, y = 30.0, 20.0
    place = given[1].rays()[20, 30] / true_planes(given[1])[20, 30, 0]
    world = (place - given[1].cam_from_world[:, 3]) @ given[1].rotation
    u, v = given[0].project(world[None])[0][0] - 0.5

    def error(factor: float) -> float:
        depths = level.inverse_depths() * np.float32(factor)
        return float(
            back_error_px.py_func(0, u, v, x, y, back_maps, depths, bases[0], np.float32(WIDTH))
        )

    assert error(1.0) < 1e-3
    moved = (place / 1.02 - given[1].cam_from_world[:, 3]) @ given[1].rotation
    shift = np.linalg.norm(given[0].project(moved[None])[0][0] - 0.5 - (u, v))
    assert 0.1 < shift < 2.0
    assert error(1.02) == pytest.approx(shift, abs=1e-3)
    assert error(0.0) == error(-1.0) == error(5.0) == MAX_BACK_ERROR_PX


def test_random_shares_are_even() -> None:
    state = np.array([7], np.uint32)
    with np.errstate(over="ignore"):
        shares = np.array([random_share.py_func(state) for _ in range(4000)])
    assert shares.min() >= 0.0
    assert shares.max() < 1.0
    counts = np.histogram(shares, 10, (0, 1))[0]
    assert np.abs(counts - 400).max() < 90
    assert abs(np.corrcoef(shares[:-1], shares[1:])[0, 1]) < 0.06


# -- Sources confirm true depths and no others; how bright photos are beside each other -----------


def confirmed(factors: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return bits and means of the first photo where depths are wrong by these factors."""
    given, photos = plane_photos()
    level = level_of(list(photos), list(given))
    for view, camera in enumerate(given):
        level.planes_of(view)[:] = true_planes(camera) / factors[view]
    means = level.confirm(0, level.inverse_depths())
    return level.confirmed[0], means


def test_both_sources_confirm_what_both_show() -> None:
    given, _ = plane_photos()
    bits, means = confirmed((1, 1, 1))
    truth = true_planes(given[0])[..., 0]
    assert means == pytest.approx(truth, rel=1e-3)
    points = (given[0].rays() / truth[..., None] - given[0].cam_from_world[:, 3]) @ given[
        0
    ].rotation
    for source in (1, 2):
        pixels, _ = given[source].project(points.reshape(-1, 3))
        size = np.array([given[source].width, given[source].height])
        inside = ((pixels > 1) & (pixels < size - 1)).all(1).reshape(bits.shape)
        outside = ((pixels < 0) | (pixels > size)).any(1).reshape(bits.shape)
        bit = (bits >> (source - 1)) & 1
        assert bit[inside].all()
        assert not bit[outside].any()
        assert outside.any()


def test_a_wrong_source_does_not_confirm() -> None:
    bits, _ = confirmed((1, 1, 1.1))
    assert set(np.unique(bits)) == {0, 1}
    bits, means = confirmed((1.1, 1, 1))
    assert not bits.any()
    truth = true_planes(plane_photos()[0][0])[..., 0]
    assert means == pytest.approx(truth / 1.1, rel=1e-5)


def test_the_mean_is_over_the_pixel_and_its_sources() -> None:
    bits, means = confirmed((1.0, 1.004, 1.004))
    truth = true_planes(plane_photos()[0][0])[..., 0]
    both = bits == 3
    assert both.mean() > 0.3
    # A plane through the other camera's centre at 1.004 of the distance is nearly 1.004 here.
    assert np.median(means[both] / truth[both]) == pytest.approx((1 + 2 / 1.004) / 3, abs=1e-3)


DARKER = 0.7


def compared(photos: list[np.ndarray], given: list[Camera] | None = None) -> MatchingLevel:
    """Return the level of the true planes of photos, brightness compared."""
    level = level_of(photos, list(plane_photos()[0]) if given is None else given)
    for view, camera in enumerate(level.cameras):
        level.planes_of(view)[:] = true_planes(camera)
    depths = level.inverse_depths()
    for view in range(len(level)):
        level.confirm(view, depths)
    level.compare_brightness()
    return level


def test_gains_of_exposure_are_found() -> None:
    first, second, third = plane_photos()[1]
    level = compared([first, np.round(DARKER * second).astype(np.uint8), third])
    assert level.brightness[0][:, GAIN] == pytest.approx([1 / DARKER, 1.0], rel=0.03)
    assert level.brightness[1][:, GAIN] == pytest.approx([DARKER, DARKER], rel=0.03)
    tolerances = 1.0 / np.concatenate(level.brightness)[:, RATE]
    assert tolerances.min() >= LEAST_TOLERANCE_LEVELS
    assert tolerances.max() < 12.0


def test_differences_count_less_where_the_light_has_changed() -> None:
    first, second, third = plane_photos()[1]
    across = np.linspace(-40.0, 40.0, second.shape[1])
    lit = np.clip(second + across, 0, 255).astype(np.uint8)
    tolerances = 1.0 / compared([first, lit, third]).brightness[0][:, RATE]
    assert tolerances[0] > 30.0
    assert tolerances[1] < 12.0


def test_brightness_is_not_compared_where_hardly_a_pixel_agrees() -> None:
    level = level_of(list(plane_photos()[1]), list(plane_photos()[0]))
    level.planes_of(1)[:] = true_planes(level.cameras[1])
    level.compare_brightness()  # nothing was confirmed
    for found in level.brightness:
        assert (found == NO_BRIGHTNESS).all()


def shaded_photo(camera: Camera) -> np.ndarray:
    """Return a photo of the plane without texture: a ramp of shading along x, and its noise."""
    rays = camera.rays() / true_planes(camera)[..., :1]
    points = (rays - camera.cam_from_world[:, 3]) @ camera.rotation
    noise = np.random.default_rng(len(camera.name)).normal(0.0, 0.5, points.shape[:2])
    return np.round(128 + 40 * points[..., 0] + noise).clip(0, 255).astype(np.uint8)


def test_a_ramp_of_shading_tells_the_depth() -> None:
    """A window sees but a ramp, which correlates with itself at any depth."""
    given = cameras(5)
    photos = [shaded_photo(camera) for camera in given]
    errors = []
    for compare in (False, True):
        level = compared(photos, given)
        if not compare:
            level.brightness = [np.tile(NO_BRIGHTNESS, (len(s), 1)) for s in level.sources]
        level.planes_of(2)[..., 0] *= np.random.default_rng(1).uniform(0.9, 1.1, (48, 64))
        for turn in range(3):
            level.sweep(2, turn, 0)
        truth = true_planes(given[2])[..., 0]
        inside = (slice(12, 36), slice(16, 48))
        errors.append(float(np.median(np.abs(level.planes_of(2)[..., 0] / truth - 1)[inside])))
    assert errors[1] < 0.01
    assert errors[1] < 0.4 * errors[0]


# -- Which photos are compared: near enough to look alike, far enough apart to tell depths --------

POINTS = np.random.default_rng(0).uniform(-0.4, 0.4, (300, 3))


def around(angle_deg: float, distance: float = 4.0) -> Camera:
    angle = np.radians(angle_deg)
    center = distance * np.array([np.cos(angle), np.sin(angle), 0.0])
    return look_at(center, np.zeros(3), f"{angle_deg}", 64, 48, 80.0)


def test_neighbours_at_12_degrees_come_first() -> None:
    angles = [0, 2, 12, 40, 80, -12]
    sources = source_views([around(a) for a in angles], POINTS)[0]
    assert set(sources[:2]) == {2, 5}
    assert 0 not in sources
    assert list(sources).index(2) < list(sources).index(3)


def test_photos_of_the_same_scale_come_first() -> None:
    sources = source_views([around(0), around(12, 8.0), around(-12, 4.0)], POINTS)[0]
    assert sources[0] == 2


def test_there_are_no_more_than_a_byte_holds_and_each_once() -> None:
    cameras = [around(3.0 * i) for i in range(30)]
    for view, sources in enumerate(source_views(cameras, POINTS)):
        assert len(sources) == MOST_SOURCES == 8
        assert len(set(sources.tolist())) == len(sources)
        assert view not in sources


def test_photos_that_share_no_points_are_not_compared() -> None:
    away = look_at(np.array([4.0, 0, 0]), np.array([9.0, 0, 0]), "away", 64, 48, 80.0)
    sources = source_views([around(0), around(12), away], POINTS)
    assert [s.tolist() for s in sources] == [[1], [0], []]
    assert [len(s) for s in source_views([around(0), around(12)], np.zeros((0, 3)))] == [0, 0]
    assert [len(s) for s in source_views([around(0)], POINTS)] == [0]


def test_more_than_255_photos_have_sources() -> None:
    cameras = [around(360.0 * i / 300) for i in range(300)]
    sources = source_views(cameras, POINTS[:40])
    assert max(s.max() for s in sources) == 299
    angle = np.abs((sources[280] - 280 + 150) % 300 - 150) * 1.2
    assert angle.max() < 60.0


def test_points_in_the_image_lie_before_the_camera() -> None:
    camera = around(0)
    points = np.array([[0.0, 0, 0], [8.0, 0, 0], [3.9, 0, 0], [0, 5.0, 0]])
    inside, depth = in_image(camera, points)
    assert inside.tolist() == [True, False, False, False]
    assert depth == pytest.approx([4.0, -4.0, 0.1, 4.0])

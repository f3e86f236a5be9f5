# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes through parts without texture: noise, segments, candidates."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from gaussian_wrapping_addon.core.stereo.plane_fitting import (
    BLOCK,
    INSIDE_WEIGHT,
    LEAST_SPREAD,
    LEAST_WEIGHT,
    SPARSE_WEIGHT,
    Plane,
    Segment,
    fit_plane,
    image_plane,
    lifted_pixels,
    noise_levels,
    plain_pixels,
    pooled,
    proposed_planes,
    refined,
    segments_of,
    smoothed_noise,
    smoothed_step_noise,
    spreads,
    with_ones,
)
from tests.core.stereo.plain_room import (
    SKY,
    WALL,
    WALL_Y,
    cameras,
    depth_maps,
    near,
    noisy_maps,
    sparse_points,
    traced,
)

# -- How noisy photos are, and what filters leave of it -------------------------------------------

SHAPE = (240, 320)


def noisy(noise: float, seed: int = 0) -> np.ndarray:
    """Return noise on a ramp of shading."""
    row, column = np.indices(SHAPE)
    shading = 90.0 + 0.2 * row + 30.0 * np.sin(column / 80.0)
    return (shading + noise * np.random.default_rng(seed).normal(size=SHAPE)).astype(np.float32)


WHOLE = np.ones(SHAPE, bool)


@pytest.mark.parametrize("noise", [0.5, 1.5, 6.0])
def test_noise_of_shaded_photos_is_found(noise: float) -> None:
    color = np.stack([noisy(noise, 0), noisy(noise, 1), noisy(2.0 * noise, 2)], -1)
    assert noise_levels(color, WHOLE) == pytest.approx([noise, noise, 2.0 * noise], rel=0.03)


@pytest.mark.parametrize(
    ("processed", "tolerance"),
    [
        (lambda clean, noise: as_jpeg(clean + noise, 95), 0.15),
        (lambda clean, noise: as_jpeg(clean + noise, 90), 0.35),
        (lambda clean, noise: made_smaller(clean, noise), 0.1),
    ],
    ids=["jpeg_95", "jpeg_90", "lanczos"],
)
def test_noise_of_resized_and_compressed_photos_is_that_of_their_texture(
    processed, tolerance: float
) -> None:
    """Single pixels show three quarters of it after resizing, a quarter after JPEG."""
    clean = noisy(0.0)
    with_noise = processed(clean, 2.0 * np.random.default_rng(0).normal(size=SHAPE))
    without = processed(clean, np.zeros(SHAPE))
    band = [ndimage.gaussian_filter(with_noise - without, sigma) for sigma in (0.7, 5.0)]
    left = (band[0] - band[1])[8:-8, 8:-8].std()
    said = smoothed_noise(noise_levels(with_noise[..., None], WHOLE)[0], 0.7)
    assert said == pytest.approx(left, rel=tolerance)


def as_jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    into = io.BytesIO()
    levels = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    Image.fromarray(levels).save(into, "JPEG", quality=quality)
    return np.asarray(Image.open(into), np.float32)


def made_smaller(clean: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the image made from one of twice the size, whose noise is four times as much."""
    large = (
        np.kron(clean, np.ones((2, 2)))
        + 2.0 * np.random.default_rng(1).normal(size=(2 * SHAPE[0], 2 * SHAPE[1])) * noise.std()
    )
    levels = Image.fromarray(large.astype(np.float32))
    return np.asarray(levels.resize(SHAPE[::-1], Image.Resampling.LANCZOS), np.float32)


def test_texture_beside_plain_pixels_is_no_noise() -> None:
    image, plain = noisy(1.0), WHOLE.copy()
    image[:, :160] += 40.0 * np.random.default_rng(1).normal(size=(240, 160))
    plain[:, :161] = False
    assert noise_levels(image[..., None], plain)[0] == pytest.approx(1.0, rel=0.03)


@pytest.mark.parametrize("level", [0.0, 255.0])
def test_black_and_saturated_parts_tell_nothing(level: float) -> None:
    image = np.rint(noisy(3.0))
    image[:, 100:] = level
    assert noise_levels(image[..., None], WHOLE)[0] == pytest.approx(3.0, rel=0.06)


def test_photos_without_plain_pixels_tell_nothing() -> None:
    few = np.zeros(SHAPE, bool)
    few[:BLOCK, : 3 * BLOCK] = True
    assert noise_levels(noisy(2.0)[..., None], few)[0] == 0.0
    assert noise_levels(noisy(0.0)[..., None], WHOLE)[0] < 0.05


@pytest.mark.parametrize("sigma_px", [0.7, 1.4, 2.0])
def test_filters_leave_as_much_as_is_said(sigma_px: float) -> None:
    smooth = ndimage.gaussian_filter(noisy(5.0) - noisy(0.0), sigma_px, truncate=6.0)
    # The formulas are of continuous filters: samples of a narrow one differ by some per cent.
    assert smoothed_noise(5.0, sigma_px) == pytest.approx(smooth.std(), rel=0.05)
    step = np.diff(smooth, axis=1).std()
    assert smoothed_step_noise(5.0, sigma_px) == pytest.approx(step, rel=0.06)


# -- Which pixels are plain, and what is known around them ----------------------------------------


def test_wall_and_sky_are_plain_and_texture_is_not() -> None:
    for camera, found in zip(cameras(), depth_maps(), strict=True):
        part = traced(camera)[1]
        plain, _ = plain_pixels(found)
        for number in (WALL, SKY):
            assert plain[(part == number) & ~near(part != number, 3)].all()
        textured = (part != WALL) & (part != SKY)
        assert plain[textured].mean() < 0.5


@pytest.mark.parametrize("noise", [1.5, 3.0, 5.0])
def test_noise_neither_breaks_the_wall_nor_makes_texture_plain(noise: float) -> None:
    for camera, found in zip(cameras(), noisy_maps(noise), strict=True):
        part = traced(camera)[1]
        plain, _ = plain_pixels(found)
        inner = (part == WALL) & ~near(part != WALL, 7)
        assert plain[inner].mean() > 0.98
        textured = (part != WALL) & (part != SKY)
        assert plain[textured].mean() < 0.5


def test_masks_are_left_out() -> None:
    mask = np.zeros(depth_maps()[0].depth.shape, bool)
    mask[:, :80] = True
    plain, _ = plain_pixels(dataclasses.replace(depth_maps()[0], mask=mask))
    assert not plain[:, 80:].any()
    assert plain[:, :80].any()


def test_large_segments_are_wall_and_sky_with_depths_around_the_wall() -> None:
    for view, camera in enumerate(cameras()):
        depth, part, _ = traced(camera)
        found = [s for s in segments_of(depth_maps()[view : view + 1], sparse_points()) if s.large]
        inside = {int(np.median(part[s.rows, s.columns])): s for s in found}
        assert {WALL, SKY} <= set(inside)
        wall = inside[WALL]
        column, row = np.rint(wall.places).astype(int).T
        exact = np.abs(wall.inverse_depths * depth[row, column] - 1.0) < 0.05
        assert exact.mean() > 0.98
        assert wall.unknown > 0.5
        assert set(np.unique(wall.weights)) <= {INSIDE_WEIGHT, 1.0, SPARSE_WEIGHT}


def test_extent_is_the_covariance_of_the_pixels() -> None:
    segment = segments_of(depth_maps()[:1], sparse_points())[0]
    assert np.allclose(segment.extent, np.cov(np.stack([segment.columns, segment.rows])))


# -- Planes in photos and through points ----------------------------------------------------------


def wall_plane(offset: float = WALL_Y, support: float = 10.0, view: int = 0) -> Plane:
    random = np.random.default_rng(view)
    points = np.stack(
        [random.uniform(-2, 2, 400), np.full(400, offset), random.uniform(0, 2, 400)], 1
    )
    return Plane(
        np.array([0.0, 1.0, 0.0]), offset, points.mean(0), points, np.full(400, 0.1), support,
        frozenset([view]), 3.5,
    )  # fmt: skip


def test_inverse_depths_of_a_plane_are_linear_in_the_pixel() -> None:
    for camera in cameras():
        depth, part, points = traced(camera)
        row, column = np.nonzero(part == WALL)
        pixels = np.stack([column, row], 1).astype(float)
        inverse = with_ones(pixels) @ image_plane(wall_plane(), camera)
        assert np.abs(inverse * depth[row, column] - 1.0).max() < 1e-9
        lifted = lifted_pixels(camera, pixels, inverse)
        assert np.abs(lifted - points[row, column]).max() < 1e-9


def test_least_squares_and_robust_fit() -> None:
    exact = wall_plane()
    normal, offset, _ = fit_plane(exact.points, exact.weights)
    assert abs(normal[1]) > 1 - 1e-12
    assert abs(abs(offset) - WALL_Y) < 1e-9
    points = exact.points.copy()
    points[:120, 1] -= np.random.default_rng(0).uniform(0.05, 0.4, 120)  # 30 % lie before the wall
    start = Plane(
        np.array([0.0, np.cos(0.01), np.sin(0.01)]), 0.99 * WALL_Y, exact.center, points,
        exact.weights, 10.0, exact.views, 3.5,
    )  # fmt: skip
    found = refined(start)
    assert abs(found.normal[1]) > 1 - 1e-5
    assert abs(found.normal @ [0.0, WALL_Y, 1.0] - found.offset) < 2e-3


def test_equal_planes_of_several_photos_become_one() -> None:
    same = [wall_plane(WALL_Y + 0.01 * view, 10.0 + view, view) for view in range(3)]
    other = wall_plane(WALL_Y + 0.5, 5.0, 4)
    found = pooled([*same, other])
    assert len(found) == 2
    assert found[0].views == {0, 1, 2}
    assert found[0].support == sum(plane.support for plane in same)
    assert abs(abs(found[0].offset) - WALL_Y) < 0.02
    assert found[1].views == {4}


def test_a_moved_plane_keeps_its_evidence() -> None:
    plane = wall_plane()
    moved = plane.moved(np.array([1.0, 0.0, 0.0]), 2.0)
    assert (moved.offset, moved.views, moved.support) == (2.0, plane.views, plane.support)
    assert moved.points is plane.points


# -- What the known depths of one segment propose, and what they cannot tell ----------------------


def wall_segment(view: int) -> Segment:
    part = traced(cameras()[view])[1]
    found = [s for s in segments_of(depth_maps()[view : view + 1], sparse_points()) if s.large]
    return next(s for s in found if np.median(part[s.rows, s.columns]) == WALL)


def with_places(segment: Segment, chosen: np.ndarray) -> Segment:
    return dataclasses.replace(
        segment,
        places=segment.places[chosen],
        inverse_depths=segment.inverse_depths[chosen],
        weights=segment.weights[chosen],
    )


def test_the_wall_is_proposed() -> None:
    for view, camera in enumerate(cameras()):
        found = list(proposed_planes(wall_segment(view), camera, np.random.default_rng(0)))
        best = min(found, key=lambda p: 1 - abs(p.normal[1]))
        assert abs(best.normal[1]) > 0.9995
        assert abs(abs(best.offset) - WALL_Y) < 0.03
        assert best.views == {0}


def test_an_edge_alone_proposes_nothing() -> None:
    """Depths along the foot of the wall fit every plane through it."""
    for view, camera in enumerate(cameras()):
        segment = wall_segment(view)
        column, row = np.rint(segment.places).astype(int).T
        points = traced(camera)[2][row, column]
        foot = (np.abs(points[:, 1] - WALL_Y) < 0.15) & (points[:, 2] < 0.15)
        assert segment.weights[foot].sum() > LEAST_WEIGHT
        edge = with_places(segment, foot)
        assert not list(proposed_planes(edge, camera, np.random.default_rng(0)))


def test_too_few_known_depths_propose_nothing() -> None:
    segment = wall_segment(0)
    few = with_places(segment, np.arange(len(segment.places)) < 10)
    assert not list(proposed_planes(few, cameras()[0], np.random.default_rng(0)))


def test_spread_is_one_for_all_pixels_and_none_for_a_line() -> None:
    segment = wall_segment(0)
    every = dataclasses.replace(
        segment, places=segment.pixels, inverse_depths=np.ones(len(segment.pixels)),
        weights=np.ones(len(segment.pixels)),
    )  # fmt: skip
    line = segment.rows == np.median(segment.rows)
    found = spreads(np.stack([np.ones(len(segment.rows), bool), line]), every)
    assert abs(found[0] - 1.0) < 1e-3
    assert found[1] < 1e-3 < LEAST_SPREAD

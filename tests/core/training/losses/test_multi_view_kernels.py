# SPDX-License-Identifier: GPL-3.0-or-later
"""Multi-view kernels on an exact plane: zero errors, derivatives, skipped pixels."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training.multi_view import KEPT, NO_MASK, SAMPLES, SKIPPED
from tests.core.training.plane_scene import (
    NORMAL,
    PlaneView,
    camera_pair,
    grey_of,
    inner_pixels,
    moved,
    pair_of,
    plane_depth,
    plane_photo,
    plane_view,
)

REFERENCE, OTHER = camera_pair()
PIXELS = inner_pixels(REFERENCE)
GREY, OTHER_GREY = grey_of(plane_photo(REFERENCE)), grey_of(plane_photo(OTHER))
TILTED, STEEP = np.array([0.2, -0.1, 1.0]), np.array([0.8, -0.4, 1.0])


def compare(  # type: ignore[no-untyped-def]  # four arrays
    view: PlaneView,
    pixels: np.ndarray = PIXELS,
    *,
    grey: np.ndarray = GREY,
    other_grey: np.ndarray = OTHER_GREY,
    mask: np.ndarray = NO_MASK,
    other_mask: np.ndarray = NO_MASK,
    squared: bool = False,
    threads: int = 1,
):
    noise = np.zeros(len(pixels))
    pair = pair_of(view, pixels, threads)
    rise, spread = TrainingSettings.patch_rise, SAMPLES * TrainingSettings.patch_contrast**2
    return pair.compare(noise, grey, other_grey, mask, other_mask, squared, 1, rise, spread)


def test_true_plane_shows_both_photos_the_same() -> None:
    states, errors, _, _ = compare(plane_view(REFERENCE))
    assert (states == KEPT).mean() > 0.9
    # What is left is that pixels are joined by straight lines, most where contrast is weak.
    assert errors[states == KEPT].mean() < 1e-3
    assert errors.max() < 1e-2


def test_error_grows_with_the_displacement() -> None:
    means = []
    for shift in (0.0, 0.02, 0.04, 0.08):
        view = moved(plane_view(REFERENCE), depth=plane_depth(REFERENCE, shift))
        states, errors, _, _ = compare(view)
        means.append(errors[states == KEPT].mean())
    assert np.all(np.diff(means) > 2e-4)
    assert means[3] > 8 * means[0]


def test_error_grows_with_the_tilt() -> None:
    flat, tilted = (compare(plane_view(REFERENCE, n))[1].mean() for n in (NORMAL, STEEP))
    assert tilted > 4 * flat


@pytest.mark.parametrize("squared", [False, True])
def test_derivatives_are_central_differences(squared: bool) -> None:
    exact = plane_view(REFERENCE, TILTED, length=0.7)
    view = moved(exact, depth=plane_depth(REFERENCE, 0.02))
    states, _, by_depth, by_normals = compare(view, squared=squared)
    kept = states == KEPT
    assert kept.mean() > 0.9
    step = 1e-6

    def slope(**sides: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        errors = [
            compare(moved(view, **{name: side[i] for name, side in sides.items()}),
                    squared=squared)[1]
            for i in range(2)
        ]  # fmt: skip
        return (errors[0] - errors[1]) / (2 * step)

    # A sample that steps over a pixel centre within the difference has two slopes.
    found = slope(depth=(view.depth + step, view.depth - step))[kept]
    scale = np.abs(by_depth[kept]).max()
    assert scale > 0.1
    assert np.quantile(np.abs(found - by_depth[kept]), 0.99) < 1e-6 * scale
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        sides = (view.geometric_normal + shift, view.geometric_normal - shift)
        found = slope(geometric_normal=sides)[kept]
        wrong = np.abs(found - by_normals[kept, axis])
        assert np.quantile(wrong, 0.99) < 1e-6 * np.abs(by_normals[kept]).max()
    # The length of the normal does not matter.
    along = (by_normals * view.geometric_normal.reshape(-1, 3)[PIXELS]).sum(1)
    assert np.abs(along).max() < 1e-12 * np.abs(by_normals).max()


def test_sign_of_the_correlation() -> None:
    view = plane_view(REFERENCE)
    states, errors, by_depth, _ = compare(view, other_grey=1.0 - OTHER_GREY)
    assert (states == SKIPPED).all()
    assert not errors.any()
    assert not by_depth.any()
    states, errors, _, _ = compare(view, other_grey=1.0 - OTHER_GREY, squared=True)
    assert (states == KEPT).mean() > 0.9
    assert errors.max() < 2e-2


def test_brightness_and_contrast_do_not_matter() -> None:
    view = moved(plane_view(REFERENCE), depth=plane_depth(REFERENCE, 0.02))
    _, errors, _, _ = compare(view)
    states, brighter, _, _ = compare(view, other_grey=np.float32(0.8) * OTHER_GREY + 0.2)
    # Weak contrast counts less: the product of the spreads has a floor.
    assert np.abs(brighter - errors)[states == KEPT].mean() < 1e-4


def test_flat_patches_are_skipped() -> None:
    view = plane_view(REFERENCE)
    for name in ("grey", "other_grey"):
        flat = np.full(GREY.shape if name == "grey" else OTHER_GREY.shape, 0.4, np.float32)
        states, _, _, _ = compare(view, **{name: flat})
        assert (states == SKIPPED).all()


def test_edge_on_and_short_normals_are_skipped() -> None:
    ray = REFERENCE.rays().reshape(-1, 3)[PIXELS] @ REFERENCE.rotation
    edge_on = np.cross(ray, [0.0, 0.0, 1.0])
    view = plane_view(REFERENCE)
    view.geometric_normal.reshape(-1, 3)[PIXELS] = edge_on
    states, _, by_depth, by_normals = compare(view)
    assert (states == SKIPPED).all()
    assert np.isfinite(by_depth).all()
    assert np.isfinite(by_normals).all()
    assert (compare(plane_view(REFERENCE, length=0.29))[0] == SKIPPED).all()
    assert (compare(plane_view(REFERENCE, length=0.31))[0] == KEPT).any()
    assert (compare(plane_view(REFERENCE, length=0.0))[0] == SKIPPED).all()


def test_numbers_that_are_not_finite_are_skipped() -> None:
    for name in ("depth", "geometric_normal", "alpha"):
        for value in (np.nan, np.inf):
            view = plane_view(REFERENCE)
            getattr(view, name).fill(value)
            states, errors, by_depth, by_normals = compare(view)
            assert not (states == KEPT).any()
            for array in (errors, by_depth, by_normals):
                assert not array.any()


def test_patches_end_at_borders_and_masks() -> None:
    view = plane_view(REFERENCE)
    row, column = np.mgrid[0 : REFERENCE.height, 0 : REFERENCE.width]
    pixels = np.arange(row.size, dtype=np.int32)
    states, _, _, _ = compare(view, pixels)
    kept = (states == KEPT).reshape(row.shape)
    # The reference's border, and in the other image: 1.5 px of the patch and half a pixel.
    inside = (row >= 2) & (column >= 2) & (row < row.shape[0] - 2) & (column < row.shape[1] - 2)
    assert not kept[~inside].any()
    place = REFERENCE.center + (view.depth[..., None] * (REFERENCE.rays() @ REFERENCE.rotation))
    there = OTHER.project(place.reshape(-1, 3))[0].reshape(*row.shape, 2)
    size = np.array([OTHER.width, OTHER.height])
    assert (there[kept] > 0.5).all()
    assert (there[kept] < size - 0.5).all()
    assert kept[inside & (there > 3.5).all(2) & (there < size - 3.5).all(2)].mean() > 0.9

    mask = np.ones(row.shape, np.bool_)
    mask[:, 30] = False
    states, _, _, _ = compare(view, pixels, mask=mask)
    masked = (states == KEPT).reshape(row.shape)
    assert not masked[:, 28:33].any()
    assert np.array_equal(masked[:, :28], kept[:, :28])
    assert np.array_equal(masked[:, 33:], kept[:, 33:])
    other_mask = np.ones((OTHER.height, OTHER.width), np.bool_)
    other_mask[:, :30] = False
    states, _, _, _ = compare(view, pixels, other_mask=other_mask)
    masked = (states == KEPT).reshape(row.shape)
    assert masked.any()
    assert not masked[there[..., 0] < 30.5].any()


def test_points_come_back_to_their_pixel() -> None:
    view = plane_view(REFERENCE)
    pair = pair_of(view, PIXELS)
    positions, _ = pair.lift(NO_MASK)
    point = REFERENCE.center + view.depth[..., None] * (REFERENCE.rays() @ REFERENCE.rotation)
    wanted, depth = OTHER.project(point.reshape(-1, 3)[PIXELS])
    assert np.abs(positions - wanted).max() < 1e-5
    noise, by_found, by_positions = pair.reproject(positions, depth.astype(np.float32))
    assert noise.max() < 1e-4
    assert np.isfinite(by_found).all()
    assert np.isfinite(by_positions).all()


def test_derivatives_of_the_way_back() -> None:
    view = moved(plane_view(REFERENCE), depth=plane_depth(REFERENCE, 0.02))
    pair = pair_of(view, PIXELS)
    positions, position_slopes = (array.astype(np.float64) for array in pair.lift(NO_MASK))
    _, found = OTHER.project(
        (REFERENCE.center + view.depth[..., None] * (REFERENCE.rays() @ REFERENCE.rotation))
        .reshape(-1, 3)[PIXELS]
    )  # fmt: skip
    found = found + 0.01
    noise, by_found, by_positions = pair.reproject(positions, found)
    assert (noise < np.inf).all()
    assert noise.min() > 1e-3
    step = 1e-6
    slope = (
        pair.reproject(positions, found + step)[0] - pair.reproject(positions, found - step)[0]
    ) / (2 * step)
    assert np.abs(slope - by_found).max() < 1e-6 * np.abs(by_found).max()
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        ends = [pair.reproject(positions + sign * shift, found)[0] for sign in (1, -1)]
        assert np.abs((ends[0] - ends[1]) / (2 * step) - by_positions[:, axis]).max() < 1e-7
    step = 1e-2  # places are float32
    ends = [
        pair_of(moved(view, depth=view.depth + sign * step), PIXELS).lift(NO_MASK)[0]
        for sign in (1, -1)
    ]
    assert np.abs((ends[0] - ends[1]) / (2 * step) - position_slopes).max() < 2e-3


def test_no_way_back() -> None:
    view = plane_view(REFERENCE)
    pair = pair_of(view, PIXELS)
    positions, _ = pair.lift(NO_MASK)
    for found in (0.0, np.nan, np.inf, 0.1, 1.0, 9.0):
        noise, by_found, _ = pair.reproject(positions, np.full(len(PIXELS), found, np.float32))
        assert np.isinf(noise).all()
        assert not by_found.any()


def test_places_behind_off_the_image_or_masked_are_none() -> None:
    view = plane_view(REFERENCE)
    behind = moved(view, depth=np.full_like(view.depth, -3.0))
    assert np.isnan(pair_of(behind, PIXELS).lift(NO_MASK)[0]).all()
    far = moved(view, depth=np.full_like(view.depth, 0.3))
    assert np.isnan(pair_of(far, PIXELS).lift(NO_MASK)[0]).any()
    other_mask = np.zeros((OTHER.height, OTHER.width), np.bool_)
    assert np.isnan(pair_of(view, PIXELS).lift(other_mask)[0]).all()
    for value in (np.nan, np.inf):
        broken = moved(view, depth=np.full_like(view.depth, value))
        assert np.isnan(pair_of(broken, PIXELS).lift(NO_MASK)[0]).all()


def test_the_number_of_threads_does_not_matter() -> None:
    view = moved(plane_view(REFERENCE), depth=plane_depth(REFERENCE, 0.02))
    for one, three in zip(compare(view), compare(view, threads=3), strict=True):
        assert np.array_equal(one, three)

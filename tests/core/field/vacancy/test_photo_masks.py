# SPDX-License-Identifier: GPL-3.0-or-later
"""Vacancy of masked and of unseen points."""

from __future__ import annotations

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.field.vacancy import SETTLED, PackedMask, VacancyField
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.field.field_scenes import camera_at, cameras_around, random_arrays, shell_arrays


def random_masks(cameras: list[Camera], divisor: int = 1, seed: int = 0) -> list[np.ndarray]:
    """Return masks of blocks, about half of each left out."""
    rng = np.random.default_rng(seed)
    size = cameras[0].height // divisor, cameras[0].width // divisor
    blocks = rng.random((len(cameras), 6, 8)) < 0.5
    return [np.kron(b, np.ones((size[0] // 6, size[1] // 8), bool)) for b in blocks]


def is_masked(camera: Camera, mask: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Look points up in a mask, by the definition; false outside the image."""
    pixels, depth = camera.project(points)
    seen = (depth > 0.2) & (pixels >= 0).all(1)
    seen &= (pixels[:, 0] <= camera.width) & (pixels[:, 1] <= camera.height)
    scale = mask.shape[1] / camera.width, mask.shape[0] / camera.height
    pixels = np.where(seen[:, None], pixels, 0.0) * scale
    column = np.minimum(pixels[:, 0].astype(int), mask.shape[1] - 1)
    row = np.minimum(pixels[:, 1].astype(int), mask.shape[0] - 1)
    return seen & ~mask[row, column]


@pytest.mark.parametrize("divisor", [1, 5])
@pytest.mark.parametrize("mode", ["ignore", "background"])
def test_masked_views_equal_the_definition(mode: str, divisor: int) -> None:
    arrays = random_arrays(300)
    cameras = cameras_around(5)
    masks = random_masks(cameras, divisor)
    rng = np.random.default_rng(1)
    near = arrays.means[rng.integers(0, len(arrays), 2500)] + 0.01 * rng.normal(size=(2500, 3))
    points = np.concatenate([near, rng.normal(size=(1500, 3))])
    plain = VacancyField(arrays, cameras, near_z=0.2)
    each = np.stack([plain.transmittance(points, c) for c in range(5)])  # (5, n)
    for c in range(5):
        each[c, is_masked(cameras[c], masks[c], points)] = np.nan if mode == "ignore" else 1.0
    seen = ~np.isnan(each).all(0)
    expected = np.where(seen, np.where(np.isnan(each), -1.0, each).max(0), np.nan)
    field = VacancyField(
        arrays, cameras, near_z=0.2, masks=masks, mask_mode=mode, unseen="invalid"  # type: ignore[arg-type]
    )  # fmt: skip
    result = field.vacancy(points)
    np.testing.assert_array_equal(result.camera >= 0, seen)
    np.testing.assert_array_equal(np.isnan(result.vacancy), ~seen)
    resolved = seen & (expected <= SETTLED)
    assert resolved.sum() > 20
    np.testing.assert_array_equal(result.vacancy[resolved], expected[resolved].astype(np.float32))
    assert (result.vacancy[seen & ~resolved] > SETTLED).all()
    assert field.unseen_evaluations == (~seen).sum()
    assert (mode == "ignore") == bool((~seen).sum() > 100)
    np.testing.assert_array_equal(field.is_empty(points), ~(result.vacancy <= 0.5))
    one = field.transmittance(points, 2)
    np.testing.assert_array_equal(one, each[2])


@pytest.mark.parametrize("width", [1, 7, 8, 9, 64])
def test_a_packed_mask_takes_a_bit_a_pixel_and_is_the_same(width: int) -> None:
    mask = np.random.default_rng(width).random((5, width)) < 0.5
    packed = PackedMask.of(mask)
    assert packed is not None
    assert packed.shape == mask.shape
    assert packed.bits.nbytes == 5 * -(-width // 8)
    np.testing.assert_array_equal(packed.unpacked(), mask)
    assert PackedMask.of(None) is None


def test_masks_may_come_packed() -> None:
    arrays, cameras = random_arrays(300), cameras_around(5)
    masks = random_masks(cameras, 5)
    points = np.random.default_rng(0).normal(size=(3000, 3))
    plain = VacancyField(arrays, cameras, masks=masks).vacancy(points)
    packed = [PackedMask.of(mask) for mask in masks]
    found = VacancyField(arrays, cameras, masks=packed).vacancy(points)
    np.testing.assert_array_equal(plain.vacancy, found.vacancy)
    np.testing.assert_array_equal(plain.camera, found.camera)


def test_background_of_one_photo_empties_what_others_find_solid() -> None:
    arrays, cameras = shell_arrays(0.95), cameras_around(4)
    middle = np.array([[0.0, 0.0, 0.0]])
    assert VacancyField(arrays, cameras).vacancy(middle).vacancy[0] < 0.1
    nothing = np.zeros((30, 40), bool)
    for masks in ([None, nothing, None, None], [None, None, None, nothing]):
        field = VacancyField(arrays, cameras, masks=masks, mask_mode="background")
        assert field.vacancy(middle).vacancy[0] == 1.0
        assert field.is_empty(middle)[0]
        ignoring = VacancyField(arrays, cameras, masks=masks)
        assert ignoring.vacancy(middle).vacancy[0] < 0.1


def test_masks_that_leave_nothing_out_change_nothing() -> None:
    arrays, cameras = random_arrays(100), cameras_around(3)
    points = np.random.default_rng(0).normal(size=(500, 3))
    full = [np.ones((7, 9), bool), None, np.ones((300, 400), bool)]
    plain = VacancyField(arrays, cameras).vacancy(points)
    masked = VacancyField(arrays, cameras, masks=full).vacancy(points)
    np.testing.assert_array_equal(plain.vacancy, masked.vacancy)
    np.testing.assert_array_equal(plain.camera, masked.camera)


def test_invalid_points_are_nan_empty_and_counted() -> None:
    arrays = shell_arrays(0.9, count=200)
    field = VacancyField(arrays, [camera_at(np.array([0.0, -4.0, 0.0]))], unseen="invalid")
    points = np.array([[0.0, -5.0, 0.0], [0.0, -2.0, 0.0], [50.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    result = field.vacancy(points)
    np.testing.assert_array_equal(np.isnan(result.vacancy), [True, False, True, True])
    np.testing.assert_array_equal(result.camera, [-1, 0, -1, -1])
    np.testing.assert_array_equal(result.filled, [1.0, 1.0, 1.0, 1.0])
    assert field.unseen_evaluations == 3
    assert field.is_empty(points).all()
    assert field.unseen_evaluations == 6
    assert field.evaluations == 8


def test_bad_masks_are_named() -> None:
    arrays, cameras = random_arrays(5), cameras_around(2)
    with pytest.raises(UsageError, match="2 cameras and 1 masks"):
        VacancyField(arrays, cameras, masks=[None])
    with pytest.raises(UsageError, match="shape"):
        VacancyField(arrays, cameras, masks=[None, np.ones((3, 4, 3), bool)])
    with pytest.raises(UsageError, match="shape"):
        VacancyField(arrays, cameras, masks=[None, PackedMask.of(np.ones((0, 4), bool))])
    with pytest.raises(UsageError, match="mask mode"):
        VacancyField(arrays, cameras, mask_mode="white")  # type: ignore[arg-type]

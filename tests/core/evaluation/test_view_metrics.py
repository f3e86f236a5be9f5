# SPDX-License-Identifier: GPL-3.0-or-later
"""PSNR and SSIM against naive float64 definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.evaluation.view_metrics import psnr, similarity, ssim


def images(height: int = 19, width: int = 23, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    photo = random.uniform(0, 1, (height, width, 3))
    return np.clip(photo + 0.2 * random.normal(size=photo.shape), 0, 1), photo


def naive_ssim(image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None) -> float:
    """SSIM by its definition, window by window."""
    axis = np.arange(11) - 5
    window = np.exp(-(axis[:, None] ** 2 + axis[None] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[..., None]
    if mask is not None:
        image, photo = image * mask[..., None], photo * mask[..., None]
    found = []
    for i in range(image.shape[0] - 10):
        for j in range(image.shape[1] - 10):
            if mask is not None and not mask[i + 5, j + 5]:
                continue
            x, y = image[i : i + 11, j : j + 11], photo[i : i + 11, j : j + 11]
            mx, my = (window * x).sum((0, 1)), (window * y).sum((0, 1))
            vx = (window * (x - mx) ** 2).sum((0, 1))
            vy = (window * (y - my) ** 2).sum((0, 1))
            cov = (window * (x - mx) * (y - my)).sum((0, 1))
            c1, c2 = 0.01**2, 0.03**2
            found.append(
                (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
            )
    return float(np.mean(found))


def test_psnr_is_its_definition() -> None:
    image, photo = images()
    assert psnr(image, photo) == pytest.approx(-10 * math.log10(((image - photo) ** 2).mean()))
    assert psnr(photo, photo) == math.inf
    mask = np.zeros(photo.shape[:2], bool)
    mask[3:7, 2:9] = True
    error = ((image - photo)[3:7, 2:9] ** 2).mean()
    assert psnr(image, photo, mask) == pytest.approx(-10 * math.log10(error))
    # 8-bit photos and floats agree; what a display cannot show is clamped.
    bytes_photo = np.round(255 * photo).astype(np.uint8)
    assert psnr(image, bytes_photo) == pytest.approx(psnr(image, bytes_photo / 255.0))
    assert psnr(np.full((4, 4, 3), 1.5), np.ones((4, 4, 3))) == math.inf


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("masked", [False, True])
def test_ssim_is_its_definition(masked: bool, threads: int) -> None:
    image, photo = images()
    mask = np.random.default_rng(1).uniform(size=photo.shape[:2]) < 0.6 if masked else None
    wanted = naive_ssim(image, photo, mask)
    assert ssim(image, photo, mask, threads=threads) == pytest.approx(wanted, abs=1e-12)
    narrow = similarity(image.astype(np.float32), photo.astype(np.float32), mask, threads=threads)
    assert narrow.mean == pytest.approx(wanted, abs=2e-6)


@pytest.mark.parametrize("masked", [False, True])
def test_gradient_of_ssim_against_central_differences(masked: bool) -> None:
    image, photo = images(15, 14)
    mask = np.random.default_rng(2).uniform(size=photo.shape[:2]) < 0.7 if masked else None
    gradient = similarity(image, photo, mask, gradient=True).gradient
    assert gradient is not None
    step = 1e-6
    numeric = np.zeros_like(image)
    for index in np.ndindex(image.shape):
        moved = [image.copy(), image.copy()]
        moved[0][index] += step
        moved[1][index] -= step
        up, down = (similarity(m, photo, mask).mean for m in moved)
        numeric[index] = (up - down) / (2 * step)
    assert np.abs(gradient - numeric).max() < 1e-8 * max(1.0, 1e2 * np.abs(numeric).max())
    assert np.abs(gradient).max() > 1e-4


def test_result_does_not_depend_on_threads() -> None:
    image, photo = images(40, 37)
    narrow = image.astype(np.float32), photo.astype(np.float32)
    one = similarity(*narrow, gradient=True, threads=1)
    four = similarity(*narrow, gradient=True, threads=4)
    assert one.mean == four.mean
    assert np.array_equal(one.gradient, four.gradient)


def test_images_smaller_than_the_window_have_no_windows() -> None:
    image, photo = images(10, 40)
    result = similarity(image, photo, gradient=True)
    assert (result.mean, result.values) == (1.0, 0)
    assert not result.gradient.any()


def test_wrong_shapes_and_empty_masks_are_refused() -> None:
    image, photo = images()
    with pytest.raises(UsageError):
        psnr(image[:5], photo)
    with pytest.raises(UsageError):
        psnr(image, photo, np.zeros(photo.shape[:2], bool))
    with pytest.raises(UsageError):
        ssim(image, photo, np.ones((3, 3), bool))

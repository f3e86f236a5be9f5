# SPDX-License-Identifier: GPL-3.0-or-later
"""Model selection: the size of the photos that are trained on."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from gaussian_wrapping_addon.core.training.image_size_selection import (
    DETAIL_RMS,
    PhotoDetail,
    photo_detail,
    select_image_size,
)

# -- Selection of the image size: sharp, blurred, enlarged and noisy photos -----------------------

HEIGHT, WIDTH = 480, 640


def texture() -> np.ndarray:
    """Random polygons' edges: sharp, with quiet areas between. (h, w, 3) in [0, 1]."""
    random = np.random.default_rng(3)
    image = np.full((HEIGHT, WIDTH, 3), 0.5)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for _ in range(120):
        center = random.random(2) * (HEIGHT, WIDTH)
        size = random.uniform(8, 60)
        angle = random.uniform(0, np.pi)
        u = (y - center[0]) * np.cos(angle) + (x - center[1]) * np.sin(angle)
        v = (x - center[1]) * np.cos(angle) - (y - center[0]) * np.sin(angle)
        image[(abs(u) < size) & (abs(v) < 0.4 * size)] = random.uniform(0.2, 0.8, 3)
    return image


def photo(image: np.ndarray, noise: float = 0.0) -> np.ndarray:
    random = np.random.default_rng(4)
    noisy = image + noise * random.normal(size=image.shape)
    return np.round(255 * np.clip(noisy, 0, 1)).astype(np.uint8)


def blurred(image: np.ndarray, sigma_px: float) -> np.ndarray:
    return ndimage.gaussian_filter(image, (sigma_px, sigma_px, 0))


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_a_sharp_photo_keeps_its_size_with_or_without_noise(noise: float) -> None:
    found = photo_detail(photo(texture(), noise))
    assert found.useful_px == found.side_px == WIDTH
    assert found.detail > 1.5 * DETAIL_RMS


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_a_blurred_photo_is_halved_with_or_without_noise(noise: float) -> None:
    found = photo_detail(photo(blurred(texture(), 2.5), noise))
    assert found.useful_px == WIDTH // 2
    assert found.detail < DETAIL_RMS


def test_an_enlarged_photo_is_halved_until_it_was_sharp() -> None:
    small = photo(texture())
    large = np.asarray(
        Image.fromarray(small).resize((2 * WIDTH, 2 * HEIGHT), Image.Resampling.BICUBIC)
    )
    found = photo_detail(large)
    assert (found.side_px, found.useful_px) == (2 * WIDTH, WIDTH)


@pytest.mark.parametrize("noise", [0.01, 0.03, 0.06])
def test_noise_is_measured_and_is_no_detail(noise: float) -> None:
    flat = np.full((HEIGHT, WIDTH, 3), 0.5)
    found = photo_detail(photo(flat, noise))
    # Noise of three channels averages to sqrt(1/16 + 1/4 + 1/16) of one.
    assert found.noise == pytest.approx(noise * np.sqrt(0.375), rel=0.2)
    assert found.detail == 0.0
    assert found.useful_px < WIDTH


def test_detail_outside_of_the_mask_does_not_count() -> None:
    image = blurred(texture(), 4.0)
    image[:, : WIDTH // 2] = texture()[:, : WIDTH // 2]
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, WIDTH // 2 + 16 :] = True
    assert photo_detail(photo(image)).useful_px == WIDTH
    assert photo_detail(photo(image), mask).useful_px < WIDTH
    assert photo_detail(photo(image), ~mask).useful_px == WIDTH


def test_small_photos_are_left_alone() -> None:
    tiny = photo(np.full((100, 150, 3), 0.5))
    assert photo_detail(tiny).useful_px == 150
    assert photo_detail(tiny[:20, :20]) == PhotoDetail(20, 20, 0.0, 0.0)


def test_half_of_the_photos_decide() -> None:
    fine, coarse = PhotoDetail(640, 640, 0.03, 0.01), PhotoDetail(640, 320, 0.001, 0.02)
    assert select_image_size([fine, coarse, coarse]).useful_px == 320
    assert select_image_size([fine, coarse]).useful_px == 640
    evidence = select_image_size([coarse, coarse, fine])
    decision = evidence.decision()
    assert decision.chosen == "320 px"
    assert "320 px" in decision.evidence
    assert decision.figures["detail"] == 0.001
    assert evidence.photos == 3
    assert "hold all of their detail" not in select_image_size([fine]).decision().evidence
    with pytest.raises(ValueError, match="no photo"):
        select_image_size([])


def test_photos_of_several_sizes_are_not_taken_for_halved_ones() -> None:
    details = [PhotoDetail(side, side, 0.03, 0.01) for side in (794, 790, 790)]
    assert "hold all of their detail" not in select_image_size(details).decision().evidence

# SPDX-License-Identifier: GPL-3.0-or-later
"""Model selection: number of Gaussians, image size."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from gaussian_wrapping_addon.core.training.growth_selection import (
    CAPACITY,
    CERTAINTY,
    DETAIL_RMS,
    MIN_GAIN_DB,
    ErrorHistory,
    PhotoDetail,
    photo_detail,
    select_image_size,
)

# -- Selection of growth: continues while it pays, stops otherwise, robust against noisy photos ---

VIEWS = 30


def history(
    gain_db: float,
    *,
    noise: float = 0.05,
    growth: float = 1.1,
    rounds: int = 8,
    seed: int = 0,
    divisor_from: int = 10**9,
    outliers: int = 0,
) -> ErrorHistory:
    """Visits of all photos, the error falling by ``gain_db`` per doubling of the Gaussians."""
    random = np.random.default_rng(seed)
    own = np.exp(random.normal(0, 0.6, VIEWS))  # photos differ in error
    found, iteration, count = ErrorHistory(), 0, 2000
    for step in range(rounds):
        for place, view in enumerate(random.permutation(VIEWS).tolist()):
            error = 1e-3 * own[view] * 10 ** (-gain_db * np.log2(count / 2000) / 10)
            error *= np.exp(noise * random.normal())
            divisor = 2
            if iteration >= divisor_from:
                error, divisor = 3.0 * error, 1  # finer photos have a larger error
            if place < outliers and step == rounds - 1:
                error *= 100.0
            found.add(iteration, view, count, error, divisor)
            iteration += 1
        count = round(count * growth)
    return found


@pytest.mark.parametrize("gain_db", [1.0, 0.5])
def test_growth_that_pays_goes_on(gain_db: float) -> None:
    evidence = history(gain_db).growth_evidence()
    assert evidence.pays
    assert evidence.known
    assert evidence.views == VIEWS
    assert abs(evidence.gain_db - gain_db) < 4 * evidence.spread_db


@pytest.mark.parametrize("seed", range(4))
def test_saturated_growth_stops(seed: int) -> None:
    evidence = history(0.0, seed=seed, noise=0.01).growth_evidence()
    assert not evidence.pays
    assert evidence.gain_db + CERTAINTY * evidence.spread_db < MIN_GAIN_DB


def test_one_standard_error_is_not_enough_to_stop() -> None:
    found = [history(0.0, seed=seed, noise=0.1).growth_evidence() for seed in range(40)]
    close = [
        n for n in found if n.gain_db + n.spread_db < MIN_GAIN_DB <= n.gain_db + 2 * n.spread_db
    ]
    assert close
    assert all(n.pays for n in close)


def test_errors_that_rise_are_no_evidence_about_growth() -> None:
    evidence = history(-1.0).growth_evidence()
    assert evidence.pays
    assert not evidence.known


def test_noise_that_hides_the_answer_lets_it_grow() -> None:
    clear, hidden = (
        history(0.1, noise=0.005).growth_evidence(),
        history(0.1, noise=1.0).growth_evidence(),
    )
    assert not clear.pays
    assert hidden.known
    assert hidden.pays
    assert hidden.spread_db > 10 * clear.spread_db


def test_single_bad_photos_do_not_stop_it() -> None:
    assert history(0.6, outliers=6).growth_evidence().pays
    mean_would = np.mean([0.6] * (VIEWS - 6) + [-20 / np.log2(1.21)] * 6)
    assert mean_would < MIN_GAIN_DB


def test_the_jump_to_a_finer_level_is_not_taken_for_harm() -> None:
    # One round after the jump, no photo was seen twice at the new size.
    fresh = history(0.6, divisor_from=7 * VIEWS).growth_evidence()
    assert fresh.pays
    assert not fresh.known
    later = history(0.6, divisor_from=4 * VIEWS).growth_evidence()
    assert later.known
    assert later.pays
    assert later.gain_db > 0


def test_without_growth_nothing_is_known() -> None:
    evidence = history(0.0, growth=1.0).growth_evidence()
    assert evidence.pays
    assert not evidence.known
    assert evidence.views == 0
    assert "Too few" in evidence.decision().evidence
    assert ErrorHistory().growth_evidence().pays


def test_it_is_restored_exactly_and_bounded() -> None:
    found = history(0.3)
    again = ErrorHistory.restore(found.to_arrays())
    assert again.growth_evidence() == found.growth_evidence()
    assert len(again) == len(found)
    assert len(ErrorHistory.restore(ErrorHistory().to_arrays())) == 0
    for i in range(CAPACITY + 5):
        found.add(i, 0, 10, 0.1, 1)
    assert len(found) == CAPACITY
    found.clear()
    assert len(found) == 0
    with pytest.raises(ValueError, match="visits"):
        ErrorHistory.restore({"visits": np.zeros((3, 2))})


def test_the_record_tells_figures_and_obeys_the_setting() -> None:
    evidence = history(0.0, noise=0.01).growth_evidence()
    auto = evidence.decision()
    assert auto.chosen == "stopped"
    assert f"{evidence.gaussians} Gaussians" in auto.evidence
    assert auto.figures["gain_db"] == evidence.gain_db
    assert evidence.decision("on").chosen == "to the cap"
    assert evidence.decision("off").chosen == "none added"
    assert history(1.0).growth_evidence().decision().chosen == "to the cap"


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

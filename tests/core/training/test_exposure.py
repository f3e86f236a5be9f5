# SPDX-License-Identifier: GPL-3.0-or-later
"""Gain and offset per photo, and their steps."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.image_metrics import MAX_LOG_GAIN
from gaussian_wrapping_addon.core.resampling import as_unit_floats as as_floats
from gaussian_wrapping_addon.core.training.exposure import (
    BETAS,
    LARGEST_RATE,
    LAST_SHARE,
    REFERENCE_RATE,
    SRGB_PEDESTAL,
    Exposure,
    PhotoAdam,
    exposure_rate,
    photo_rate,
)
from tests.synthetic import textured

# -- Trained exposure: gradients, recovery of known gains, pinned mean, bitwise resume, fits ------


def some_exposure(seed: int = 3) -> Exposure:
    exposure = Exposure(4, [0, 1, 3])
    random = np.random.default_rng(seed)
    exposure.values[:] = random.uniform(-0.3, 0.3, (4, 6)).round(2)
    return exposure


@pytest.mark.parametrize("with_alpha", [False, True])
def test_gradients_are_central_differences(with_alpha: bool) -> None:
    random = np.random.default_rng(1)
    color, weights = random.normal(size=(2, 5, 7, 3))
    alpha = random.uniform(size=(5, 7)) if with_alpha else None
    exposure, view = some_exposure(), 1

    def value() -> float:
        out = exposure.corrected(view, color, alpha, threads=1)
        return float((weights * out**2).sum())

    by_out = 2 * weights * exposure.corrected(view, color, alpha, threads=1)
    by_color, by_alpha = exposure.backward(view, color, by_out, alpha, threads=1)
    gradient = exposure.gradient.copy()
    step = 2.0**-12  # a power of two, so that float32 values move by exactly this
    exposure.values[:] = np.round(exposure.values / step) * step
    by_out = 2 * weights * exposure.corrected(view, color, alpha, threads=1)
    by_color, by_alpha = (
        None if g is None else g.copy()
        for g in exposure.backward(view, color, by_out, alpha, threads=1)
    )
    gradient = exposure.gradient.copy()
    for i in range(6):
        found = []
        for sign in (1, -1):
            exposure.values[view, i] += sign * step
            found.append(value())
            exposure.values[view, i] -= sign * step
        assert gradient[i] == pytest.approx((found[0] - found[1]) / (2 * step), rel=1e-6, abs=1e-6)
    images = [(color, by_color)] + ([(alpha, by_alpha)] if with_alpha else [])
    for array, by_array in images:
        flat = array.reshape(-1)
        for at in range(0, flat.size, 4):
            kept = flat[at]
            flat[at] = kept + 1e-6
            up = value()
            flat[at] = kept - 1e-6
            slope = (up - value()) / 2e-6
            flat[at] = kept
            assert by_array.reshape(-1)[at] == pytest.approx(slope, rel=1e-6, abs=1e-7)
    assert (by_alpha is None) != with_alpha


def test_correction_is_the_affine_map_for_any_number_of_threads() -> None:
    color = textured(0).astype(np.float32)
    alpha = np.random.default_rng(2).uniform(size=color.shape[:2]).astype(np.float32)
    exposure = some_exposure()
    gains, offsets = exposure.factors(3)
    once = exposure.corrected(3, color, threads=1).copy()
    np.testing.assert_allclose(once, gains * color + offsets, atol=1e-6)
    np.testing.assert_allclose(
        exposure.corrected(3, color, alpha, threads=1),
        gains * color + offsets * alpha[..., None],
        atol=1e-6,
    )
    assert np.array_equal(once, exposure.corrected(3, color, threads=3))
    kept = []
    for threads in (1, 3):
        by_color, _ = exposure.backward(3, color, color - once, threads=threads)
        kept.append((by_color.copy(), exposure.gradient.copy()))
    assert np.array_equal(kept[0][0], kept[1][0])
    assert np.array_equal(kept[0][1], kept[1][1])


def altered(truth: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return display values after the light of each channel was multiplied."""
    return (truth + SRGB_PEDESTAL) * light ** (1 / 2.4) - SRGB_PEDESTAL


def train(
    exposure: Exposure, renders: list, photos: list, begin: int, end: int, total: int
) -> None:
    for iteration in range(begin, end):
        view = iteration % len(photos)
        image = exposure.corrected(view, renders[view], threads=1)
        by_image = np.sign(image - as_floats(photos[view])) / np.float32(image.size)  # of L1
        exposure.backward(view, renders[view], by_image, threads=1)
        exposure.step(view, exposure_rate(iteration, total, len(photos)))


def altered_photos(count: int) -> tuple[list, list, np.ndarray]:
    """Return renders, photos of altered light, and the log gains, whose mean is 0."""
    random = np.random.default_rng(5)
    logs = random.uniform(-0.3, 0.3, (count, 3))
    logs -= logs.mean(axis=0)
    renders = [textured(i).astype(np.float32) for i in range(count)]
    photos = [altered(r, np.exp(g)).astype(np.float32) for r, g in zip(renders, logs, strict=True)]
    return renders, photos, logs / 2.4


def test_known_gains_are_found_and_the_mean_is_pinned() -> None:
    count, total = 6, 1200
    renders, photos, logs = altered_photos(count)
    exposure = Exposure(count + 1, range(count))  # one more view is held out
    train(exposure, renders, photos, 0, total, total)
    assert np.abs(exposure.values[:count, :3] - logs).max() < 0.015
    for view in range(count):
        out = exposure.corrected(view, renders[view], threads=1)
        # The offsets' mean is pinned, that of the truth is not quite 0.
        assert np.abs(out - photos[view]).max() < 0.012
    assert np.abs(exposure.values[:count].astype(np.float64).mean(axis=0)).max() < 1e-8
    assert not exposure.values[count].any()
    assert float(np.sqrt(np.mean(exposure.values[exposure.trained, :3] ** 2))) == pytest.approx(
        float(np.sqrt((logs**2).mean())), rel=0.05
    )


def test_start_gains_are_those_of_the_srgb_curve() -> None:
    _, photos, logs = altered_photos(4)
    start = np.vstack([logs, [np.nan, np.nan, np.nan]])
    exposure = Exposure(5, [0, 1, 2, 3], start)
    for view in range(4):
        out = exposure.corrected(view, textured(view), threads=1)
        # Exact but for the pinned mean of the offsets.
        assert np.abs(out - photos[view]).max() < 0.004
    assert not exposure.values[4].any()


def test_a_common_drift_is_taken_out_and_values_stay_in_bounds() -> None:
    exposure = Exposure(3, [0, 2])
    exposure.values[:] = 0.4
    exposure.pin()
    assert not exposure.values[[0, 2]].any()
    exposure.values[0, 0] = 100.0
    exposure.pin()
    assert np.abs(exposure.values[[0, 2], 0]).max() <= MAX_LOG_GAIN


def test_one_photo_stays_neutral() -> None:
    exposure = Exposure(1, [0])
    render = textured(0).astype(np.float32)
    train(exposure, [render], [(0.7 * render).astype(np.float32)], 0, 20, 20)
    assert np.array_equal(exposure.values, np.zeros((1, 6), np.float32))
    assert exposure.adam.steps[0] == 20


def test_black_photos_give_finite_values_within_bounds() -> None:
    renders = [textured(i).astype(np.float32) for i in range(3)]
    photos = [np.zeros((24, 31, 3), np.uint8)] * 2 + [np.zeros((24, 31, 3), np.uint8) + 200]
    exposure = Exposure(3, range(3))
    train(exposure, renders, photos, 0, 300, 300)
    assert np.isfinite(exposure.values).all()
    dark, bright = (exposure.corrected(v, renders[0], threads=1).mean() for v in (0, 2))
    assert dark < renders[0].mean() - 0.1
    assert bright > renders[0].mean() + 0.1


def test_gradients_that_are_not_finite_move_nothing() -> None:
    exposure = some_exposure()
    before = exposure.to_arrays()
    bad = textured(0).astype(np.float32)
    bad[3, 4, 1] = np.nan
    exposure.backward(1, bad, np.ones_like(bad))
    exposure.step(1, 0.01)
    for name, array in exposure.to_arrays().items():
        assert np.array_equal(array, before[name]), name


def test_resuming_is_bit_for_bit() -> None:
    renders, photos, _ = altered_photos(4)
    through, halted = Exposure(5, [0, 1, 2, 3]), Exposure(5, [0, 1, 2, 3])
    train(through, renders, photos, 0, 37, 37)
    train(halted, renders, photos, 0, 18, 37)
    arrays = halted.to_arrays()
    resumed = Exposure.restore(arrays)
    train(halted, renders, photos, 18, 25, 37)  # must not reach into what was taken from it
    train(resumed, renders, photos, 18, 37, 37)
    for name, array in through.to_arrays().items():
        assert np.array_equal(array, resumed.to_arrays()[name]), name


def test_what_does_not_fit_is_refused() -> None:
    arrays = Exposure(3, [0, 1]).to_arrays()
    with pytest.raises(ValueError, match="first"):
        Exposure.restore({**arrays, "first": arrays["first"][:2]})
    with pytest.raises(ValueError, match="trained"):
        Exposure.restore({**arrays, "trained": np.array([7])})
    with pytest.raises(KeyError):
        Exposure.restore({k: v for k, v in arrays.items() if k != "steps"})


def test_rates_grow_for_short_runs_and_fall() -> None:
    assert exposure_rate(0, 10**6, 10) == REFERENCE_RATE
    assert exposure_rate(0, 100, 50) == LARGEST_RATE
    middle = exposure_rate(0, 3000, 30)
    assert REFERENCE_RATE < middle < LARGEST_RATE
    assert exposure_rate(3000, 3000, 30) == pytest.approx(LAST_SHARE * middle)
    assert exposure_rate(9000, 3000, 30) == pytest.approx(LAST_SHARE * middle)


def test_exposures_that_are_given_stay() -> None:
    exposure = Exposure(3, [0, 1, 2], np.random.default_rng(0).normal(size=(3, 3), scale=0.1))
    assert "active" not in exposure.to_arrays()
    exposure.active = False
    again = Exposure.restore(exposure.to_arrays())
    again.gradient[:] = 1.0
    again.step(1, 0.01)
    assert np.array_equal(again.values, exposure.values)
    assert not again.adam.steps.any()


# -- Tests of Adam for values of single photos ----------------------------------------------------


def test_steps_of_a_photo_are_those_of_torch_and_leave_the_others_alone() -> None:
    generator = np.random.default_rng(3)
    gradients = generator.normal(size=(40, 6)) * np.geomspace(1e-6, 1e3, 6)
    adam, rate = PhotoAdam(3, 6, np.float64, 1e-15), 0.03
    values = np.zeros(6)
    theirs = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([theirs], lr=rate, betas=BETAS, eps=1e-15)
    for gradient in gradients:
        values -= adam.step(1, gradient, rate)
        theirs.grad = torch.from_numpy(gradient.copy())
        optimizer.step()
    assert values == pytest.approx(theirs.detach().numpy(), rel=1e-12)
    assert adam.steps.tolist() == [0, 40, 0]
    assert not adam.first[[0, 2]].any()
    assert not adam.second[[0, 2]].any()


def _rate(iteration: int, iterations: int) -> float:
    bounds = (0.01, 0.5)
    return photo_rate(iteration, iterations, 50, travel=2.0, bounds=bounds, last_share=0.1)


def test_rate_allows_the_travel_over_the_turns_of_a_photo_within_bounds() -> None:
    rates = [_rate(i, 1000) for i in (0, 500, 1000, 4000)]
    assert rates == pytest.approx([0.1, 0.1 * 0.1**0.5, 0.01, 0.01])
    assert _rate(0, 10**6) == 0.01
    assert _rate(0, 10) == 0.5


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_loaded_state_takes_the_same_next_step(dtype: type[np.floating]) -> None:
    generator = np.random.default_rng(4)
    whole, resumed = (PhotoAdam(2, 3, dtype, 1e-15) for _ in range(2))
    for gradient in generator.normal(size=(5, 3)):
        whole.step(0, gradient, 0.1)
    resumed.load(whole.to_arrays())
    last = generator.normal(size=3)
    assert np.array_equal(whole.step(0, last, 0.1), resumed.step(0, last, 0.1))


def test_a_state_of_another_shape_or_type_is_refused() -> None:
    adam = PhotoAdam(2, 3, np.float32, 1e-15)
    arrays = adam.to_arrays()
    for name, wrong in (("first", np.zeros((2, 4), np.float32)), ("second", np.zeros((2, 3)))):
        with pytest.raises(ValueError, match=name):
            adam.load({**arrays, name: wrong})
    with pytest.raises(KeyError):
        adam.load({"first": arrays["first"], "second": arrays["second"]})

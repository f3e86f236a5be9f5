# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of Adam for values of single photos."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.training.exposure import BETAS, PhotoAdam, photo_rate


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

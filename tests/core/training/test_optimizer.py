# SPDX-License-Identifier: GPL-3.0-or-later
"""The in-place Adam against torch's, and the surgery on its rows."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.training.optimizer import EPSILON, TRAINED, Adam
from tests.core.render.scenes import random_gaussians


def filled(count: int = 50, seed: int = 0) -> Adam:
    return Adam(random_gaussians(count, seed, dtype=torch.float32))


def columns(adam: Adam, name: str) -> int:
    return int(np.prod(adam.array(name).shape[1:]))


def all_rates(adam: Adam, rate: float = 1e-2) -> dict[str, np.ndarray]:
    return {n: np.full(columns(adam, n), rate * (1 + i), np.float32) for i, n in enumerate(TRAINED)}


def give_gradients(adam: Adam, seed: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    gradients = {}
    for name in TRAINED:
        gradients[name] = torch.randn(adam.values[name].shape, generator=generator) * 1e-3
        adam.values[name].grad = gradients[name].clone()
    return gradients


@pytest.mark.parametrize("threads", [1, 3])
def test_steps_of_all_rows_are_those_of_torch(threads: int) -> None:
    adam = filled()
    rates = all_rates(adam)
    copies = {n: adam.values[n].detach().double().clone().requires_grad_() for n in TRAINED}
    groups = [{"params": [copies[n]], "lr": float(rates[n][0])} for n in TRAINED]
    theirs = torch.optim.Adam(groups, eps=EPSILON)
    for step in range(12):
        for name, gradient in give_gradients(adam, step).items():
            copies[name].grad = gradient.double()
        adam.step(rates, np.ones(50, bool), threads=threads)
        theirs.step()
    for name in TRAINED:
        moved = (adam.values[name] - copies[name]).abs().max()
        assert float(moved.detach()) < 1e-5, name
        assert adam.values[name].grad is None


def test_only_active_rows_and_given_tensors_move_and_each_row_counts_its_steps() -> None:
    adam = filled()
    before = adam.gaussians().detached().select(torch.arange(50))
    active = np.arange(50) % 3 == 0
    rates = all_rates(adam)
    del rates["orientation"]
    for step in range(4):
        give_gradients(adam, step)
        adam.step(rates, active)
    assert np.array_equal(adam.steps, np.where(active, 4, 0))
    for name, old in before.tensors():
        changed = (adam.values[name].detach() != old).reshape(50, -1).any(1).numpy()
        expected = active if name in rates else np.zeros(50, bool)
        assert np.array_equal(changed, expected), name
    # A row that starts late moves by its full rate at once, not by a fraction or a multiple.
    late = adam.array("means")[1].copy()
    give_gradients(adam, 9)
    adam.step(rates, np.arange(50) == 1)
    assert np.abs(adam.array("means")[1] - late) == pytest.approx(rates["means"], rel=1e-3)


def test_rebuild_keeps_and_clears_moments() -> None:
    adam = filled()
    give_gradients(adam, 0)
    adam.step(all_rates(adam), np.ones(50, bool))
    old = {n: (adam.array(n).copy(), adam.first[n].copy(), adam.second[n].copy()) for n in TRAINED}
    parents = np.array([4, 0, 7, 4, 49])
    fresh = np.array([False, False, False, True, True])
    means = np.arange(15, dtype=np.float32).reshape(5, 3)
    adam.rebuild(parents, fresh, {"means": means})
    assert len(adam) == 5
    assert np.array_equal(adam.array("means"), means)
    assert adam.steps.tolist() == [1, 1, 1, 0, 0]
    for name in TRAINED:
        value, first, second = old[name]
        if name != "means":
            assert np.array_equal(adam.array(name), value[parents])
        assert np.array_equal(adam.first[name][:3], first[parents[:3]])
        assert np.array_equal(adam.second[name][:3], second[parents[:3]])
        assert not adam.first[name][3:].any()
        assert not adam.second[name][3:].any()
        assert adam.values[name].requires_grad
        assert adam.values[name].is_leaf
    assert len(adam.gaussians().filter_3d) == 5


def test_numbers_that_are_not_finite_are_found() -> None:
    adam = filled()
    assert adam.is_finite()
    adam.array("quats")[3, 1] = np.inf
    assert not adam.is_finite()

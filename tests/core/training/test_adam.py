# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam against torch's and by its definition, rebuilding of rows, sums of gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import TRAINED
from gaussian_wrapping_addon.core.parallel import ArrayStore
from gaussian_wrapping_addon.core.render.types import ImageGradients, VisibleGradients
from gaussian_wrapping_addon.core.training.adam import (
    BETA1,
    BETA2,
    EPSILON,
    Adam,
    add_image_gradients,
    merge_gradients,
)
from tests.core.render.scenes import random_gaussians

# -- In-place Adam against torch's, and rebuilding of its rows ------------------------------------


def filled(count: int = 50, seed: int = 0) -> Adam:
    return Adam(random_gaussians(count, seed, dtype=torch.float32))


def columns(adam: Adam, name: str) -> int:
    return int(np.prod(adam.array(name).shape[1:]))


def all_rates(adam: Adam, rate: float = 1e-2) -> dict[str, np.ndarray]:
    return {n: np.full(columns(adam, n), rate * (1 + i), np.float32) for i, n in enumerate(TRAINED)}


def random_gradients(adam: Adam, seed: int, ids: np.ndarray | None = None) -> VisibleGradients:
    """Gradients of some rows, or of all, with a random size for each row."""
    random = np.random.default_rng(seed)
    ids = np.arange(len(adam)) if ids is None else ids

    def some(name: str) -> np.ndarray:
        shape = (len(ids), *adam.values[name].shape[1:])
        return (1e-3 * random.normal(size=shape)).astype(np.float32)

    return VisibleGradients(ids.astype(np.int32), **{name: some(name) for name in TRAINED})


def definition(
    value: np.ndarray, gradient: np.ndarray, rates: np.ndarray, moments: tuple, steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Adam's step of (v, c) values in float32; ``steps`` (v,) count this one."""
    first, second = moments
    one = np.float32(1.0)
    b1, b2 = np.float32(BETA1), np.float32(BETA2)
    up = (1 / (1 - BETA1 ** steps.astype(float))).astype(np.float32)[:, None]
    down = (1 / np.sqrt(1 - BETA2 ** steps.astype(float))).astype(np.float32)[:, None]
    first = b1 * first + (one - b1) * gradient
    second = b2 * second + (one - b2) * gradient * gradient
    step = rates * up * first / (np.sqrt(second) * down + np.float32(EPSILON))
    return value - step, first, second


@pytest.mark.parametrize("threads", [1, 3])
def test_steps_of_all_rows_are_those_of_torch(threads: int) -> None:
    adam = filled()
    rates = all_rates(adam)
    copies = {n: adam.values[n].double().clone().requires_grad_() for n in TRAINED}
    groups = [{"params": [copies[n]], "lr": float(rates[n][0])} for n in TRAINED]
    theirs = torch.optim.Adam(groups, eps=EPSILON)
    for step in range(12):
        gradients = random_gradients(adam, step)
        for name in TRAINED:
            copies[name].grad = torch.from_numpy(getattr(gradients, name)).double()
        adam.step_rows(gradients, rates, threads=threads)
        theirs.step()
    for name in TRAINED:
        moved = (adam.values[name] - copies[name]).abs().max()
        assert float(moved.detach()) < 1e-5, name


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_rows_step_bit_for_bit_by_the_definition_and_others_stay(sh_degree: int) -> None:
    adam = Adam(random_gaussians(70, 1, sh_degree=sh_degree, dtype=torch.float32))
    random = np.random.default_rng(2)
    rates = all_rates(adam)
    steps = np.zeros(70, int)
    for step in range(6):
        ids = np.sort(random.choice(70, 41, replace=False))
        gradients = random_gradients(adam, step, ids)
        old = {n: (adam.array(n).copy(), *map(np.copy, adam.moments(n))) for n in TRAINED}
        adam.step_rows(gradients, rates, threads=1 + step % 3)
        steps[ids] += 1
        assert np.array_equal(adam.steps, steps)
        for name in TRAINED:
            value, first, second = (a.reshape(70, -1) for a in old[name])
            gradient = getattr(gradients, name).reshape(len(ids), -1)
            moments = (first[ids], second[ids])
            value[ids], first[ids], second[ids] = definition(
                value[ids], gradient, rates[name], moments, steps[ids]
            )
            new = (adam.array(name), *adam.moments(name))
            for mine, theirs in zip(new, (value, first, second), strict=True):
                assert np.array_equal(mine.reshape(70, -1), theirs), (name, step)


def test_rows_whose_whole_gradient_is_0_and_tensors_without_a_rate_stay() -> None:
    adam = filled()
    rates = all_rates(adam)
    del rates["orientation"]
    adam.step_rows(random_gradients(adam, 0), rates)
    ids = np.arange(0, 50, 2)
    gradients = random_gradients(adam, 1, ids)
    hidden = np.arange(len(ids)) % 5 == 0
    for name in TRAINED:
        getattr(gradients, name)[hidden] = 0.0
    # Capped at 0.99 wherever it shows: colours have a gradient, the opacity has none.
    gradients.opacity_logits[1] = 0.0
    for name in ("means", "log_scales", "quats", "orientation"):
        getattr(gradients, name)[1] = 0.0
    old = {n: (adam.array(n).copy(), *map(np.copy, adam.moments(n))) for n in TRAINED}
    adam.step_rows(gradients, rates)
    stepped = np.zeros(50, bool)
    stepped[ids[~hidden]] = True
    assert np.array_equal(adam.steps, 1 + stepped)
    for name in TRAINED:
        new = (adam.array(name), *adam.moments(name))
        for mine, theirs in zip(new, old[name], strict=True):
            changed = (mine != theirs).reshape(50, -1).any(1)
            assert np.array_equal(changed, stepped & (name in rates)), name


def test_harmonics_above_the_degree_in_use_may_be_left_out() -> None:
    adams = [Adam(random_gaussians(30, 3, sh_degree=3, dtype=torch.float32)) for _ in range(2)]
    rates = all_rates(adams[0])
    for step, degree in enumerate((0, 0, 1, 2)):
        gradients = random_gradients(adams[0], step)
        gradients.sh[:, (degree + 1) ** 2 :] = 0.0
        adams[0].step_rows(gradients, rates)
        adams[1].step_rows(gradients, rates, sh_degree=degree)
    assert np.array_equal(adams[0].array("sh"), adams[1].array("sh"))
    for whole, spared in zip(adams[0].moments("sh"), adams[1].moments("sh"), strict=True):
        assert np.array_equal(whole, spared)


def test_a_row_that_starts_late_moves_by_its_full_rate() -> None:
    adam = filled()
    rates = all_rates(adam)
    for step in range(4):
        adam.step_rows(random_gradients(adam, step, np.arange(0, 50, 3)), rates)
    late = adam.array("means")[1].copy()
    adam.step_rows(random_gradients(adam, 9, np.array([1])), rates)
    assert np.abs(adam.array("means")[1] - late) == pytest.approx(rates["means"], rel=1e-3)


def test_rebuild_keeps_and_clears_moments() -> None:
    adam = filled()
    adam.step_rows(random_gradients(adam, 0), all_rates(adam))
    old = {n: (adam.array(n).copy(), *map(np.copy, adam.moments(n))) for n in TRAINED}
    parents = np.array([4, 0, 7, 4, 49])
    fresh = np.array([False, False, False, True, True])
    means = np.arange(15, dtype=np.float32).reshape(5, 3)
    adam.rebuild(parents, fresh, {"means": means})
    assert len(adam) == 5
    assert np.array_equal(adam.array("means"), means)
    assert adam.steps.tolist() == [1, 1, 1, 0, 0]
    for name in TRAINED:
        value, *moments = old[name]
        if name != "means":
            assert np.array_equal(adam.array(name), value[parents])
        for mine, theirs in zip(adam.moments(name), moments, strict=True):
            assert np.array_equal(mine[:3], theirs[parents[:3]])
            assert not mine[3:].any()
    assert len(adam.gaussians().filter_3d) == 5
    adam.reset_moments("quats")
    assert not any(moment.any() for moment in adam.moments("quats"))
    assert all(moment[:3].all() for moment in adam.moments("sh"))


def test_numbers_that_are_not_finite_are_found() -> None:
    adam = filled()
    assert adam.is_finite()
    adam.array("quats")[3, 1] = np.inf
    assert not adam.is_finite()


@pytest.mark.parametrize("threads", [1, 3])
def test_frozen_rows_stay_and_the_others_step_as_without_them(threads: int) -> None:
    plain, partly = filled(), filled()
    partly.frozen = 20
    before = partly.copy()
    assert before.frozen == 20
    ids = np.sort(np.random.default_rng(4).permutation(50)[:35])
    for turn in range(3):
        for adam in (plain, partly):
            gradients = random_gradients(adam, turn, ids)
            adam.step_rows(gradients, all_rates(adam), threads=threads)
    for name in partly.values:
        assert np.array_equal(partly.array(name)[:20], before.array(name)[:20]), name
        assert np.array_equal(partly.array(name)[20:], plain.array(name)[20:]), name
    assert not partly.steps[:20].any()
    assert not partly.all_moments[:20].any()
    assert np.array_equal(partly.all_moments[20:], plain.all_moments[20:])
    assert np.array_equal(partly.steps[20:], plain.steps[20:])
    assert partly.steps.any()


# -- Sums of gradients against dense sums ---------------------------------------------------------

COUNT = 50
SHAPES = {
    "means": (3,), "log_scales": (3,), "quats": (4,), "opacity_logits": (), "sh": (4, 3),
    "orientation": (4,),
}  # fmt: skip


def gradients(listed: int, seed: int) -> VisibleGradients:
    random = np.random.default_rng(seed)
    ids = np.sort(random.choice(COUNT, listed, replace=False)).astype(np.int32)
    values = {
        name: random.normal(size=(listed, *shape)).astype(np.float32)
        for name, shape in SHAPES.items()
    }
    return VisibleGradients(ids, **values)


def dense(part: VisibleGradients, name: str) -> np.ndarray:
    out = np.zeros((COUNT, *SHAPES[name]), np.float32)
    out[part.ids] = getattr(part, name)
    return out


@pytest.mark.parametrize("listed", [(30, 20), (50, 50), (0, 7), (7, 0), (0, 0), (1, 49)])
@pytest.mark.parametrize("threads", [1, 3])
def test_merged_is_the_dense_sum(listed: tuple[int, int], threads: int) -> None:
    first, second = gradients(listed[0], 0), gradients(listed[1], 1)
    merged = merge_gradients(first, second, COUNT, threads=threads)
    assert np.array_equal(merged.ids, np.union1d(first.ids, second.ids))
    assert merged.ids.dtype == np.int32
    for name in SHAPES:
        assert np.array_equal(dense(merged, name), dense(first, name) + dense(second, name))
        assert getattr(merged, name).flags.c_contiguous


def test_memory_is_reused() -> None:
    store = ArrayStore()
    before = merge_gradients(gradients(30, 0), gradients(20, 1), COUNT, store=store)
    again = merge_gradients(gradients(10, 2), gradients(5, 3), COUNT, store=store)
    assert np.shares_memory(before.means, again.means)
    wanted = dense(gradients(10, 2), "sh") + dense(gradients(5, 3), "sh")
    assert np.array_equal(dense(again, "sh"), wanted)


def test_sum_of_image_gradients() -> None:
    one = ImageGradients(color=np.ones((2, 3, 3)), depth=np.ones((2, 3)))
    two = ImageGradients(alpha=np.full((2, 3), 4.0), depth=np.full((2, 3), 2.0))
    summed = add_image_gradients(one, two)
    assert summed.color is one.color
    assert summed.alpha is two.alpha
    assert np.array_equal(summed.depth, np.full((2, 3), 3.0))
    assert summed.normal is None

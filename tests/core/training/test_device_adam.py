# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam on a device, emulated or a GPU, equals that of the CPU, row by row."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import TRAINED
from gaussian_wrapping_addon.core.render.types import VisibleGradients
from gaussian_wrapping_addon.core.training.adam import Adam
from gaussian_wrapping_addon.core.training.device_adam import DeviceAdam
from tests.core.device_kernels import DEVICES, kernels_of
from tests.core.render.scenes import random_gaussians

COUNT = 41
RATES = {
    "means": np.full(3, 1e-3, np.float32),
    "log_scales": np.full(3, 5e-3, np.float32),
    "quats": np.full(4, 1e-3, np.float32),
    "opacity_logits": np.full(1, 5e-2, np.float32),
    "sh": np.full(48, 2e-3, np.float32),
}


def pair(device: str, request: pytest.FixtureRequest) -> tuple[Adam, DeviceAdam]:
    gaussians = random_gaussians(COUNT, seed=3, dtype=torch.float32)
    kind = torch.device("cuda" if device == "cuda" else "cpu")
    adam = Adam(gaussians)
    return adam, DeviceAdam(Adam(gaussians), kernels_of(device, request), kind)


def random_gradients(adam: Adam, seed: int) -> tuple[VisibleGradients, dict[str, torch.Tensor]]:
    """Return gradients on a part of the rows, as rows and dense; one listed row is all 0."""
    random = np.random.default_rng(seed)
    ids = np.sort(random.permutation(COUNT)[:29]).astype(np.int32)
    rows, dense = {}, {}
    for name in TRAINED:
        whole = np.zeros(tuple(adam.values[name].shape), np.float32)
        whole[ids] = random.normal(size=(len(ids), *whole.shape[1:]))
        whole[ids[4]] = 0.0
        if name == "sh":
            whole[:, 4:] = 0.0
        rows[name], dense[name] = whole[ids].copy(), torch.from_numpy(whole)
    return VisibleGradients(ids, **rows), dense


def assert_same(found: Adam, wanted: Adam, tolerance: float) -> None:
    assert np.array_equal(found.steps, wanted.steps)
    for name in wanted.values:
        a, b = found.array(name), wanted.array(name)
        assert np.abs(a - b).max() <= tolerance * max(1.0, np.abs(b).max()), name
    for name in TRAINED:
        for a, b in zip(found.moments(name), wanted.moments(name), strict=True):
            assert np.abs(a - b).max() <= tolerance * max(1.0, np.abs(b).max()), name


@pytest.mark.parametrize("device", DEVICES)
def test_steps_equal_the_cpus(request: pytest.FixtureRequest, device: str) -> None:
    adam, found = pair(device, request)
    before = adam.array("orientation").copy()
    for step in range(5):
        rows, dense = random_gradients(adam, step)
        rates = {n: rate[: dense[n][0].numel()] for n, rate in RATES.items()}
        adam.step_rows(rows, rates, sh_degree=1)
        found.step_all({n: g.to(found.device) for n, g in dense.items()}, rates, sh_degree=1)
    assert adam.steps.max() == 5
    assert adam.steps.min() < 5
    assert_same(found.on_host(), adam, 1e-6)
    assert np.array_equal(found.array("orientation"), before)  # no rate: it stays


@pytest.mark.parametrize("device", DEVICES)
def test_rebuilding_equals_the_cpus(request: pytest.FixtureRequest, device: str) -> None:
    adam, found = pair(device, request)
    rows, dense = random_gradients(adam, 1)
    rates = {n: rate[: dense[n][0].numel()] for n, rate in RATES.items()}
    adam.step_rows(rows, rates)
    found.step_all({n: g.to(found.device) for n, g in dense.items()}, rates)
    parents = np.concatenate([np.arange(0, COUNT, 2), [3, 5]])
    fresh = np.arange(len(parents)) >= len(parents) - 2
    changes = {"means": np.ones((len(parents), 3), np.float32)}
    for optimizer in (adam, found):
        optimizer.rebuild(parents, fresh, changes)
        optimizer.reset_moments("quats")
        optimizer.array("opacity_logits")[:3] = 0.25
    assert len(found) == len(adam) == len(parents)
    assert_same(found, adam, 1e-6)
    assert_same(found.on_host(), adam, 1e-6)
    assert_same(found.copy(), adam, 1e-6)
    assert torch.equal(found.on_device().opacity_logits[:3].cpu(), torch.full((3,), 0.25))


@pytest.mark.parametrize("device", DEVICES)
def test_a_copy_is_apart(request: pytest.FixtureRequest, device: str) -> None:
    _, found = pair(device, request)
    twin = found.copy()
    found.array("means")[:] = np.nan
    assert not found.is_finite()
    assert twin.is_finite()
    assert np.isfinite(twin.array("means")).all()


@pytest.mark.parametrize("frozen", [7, COUNT])
@pytest.mark.parametrize("device", DEVICES)
def test_frozen_rows_keep_every_bit(
    request: pytest.FixtureRequest, device: str, frozen: int
) -> None:
    _, plain = pair(device, request)
    host = plain.on_host()
    host.frozen = frozen
    partly = DeviceAdam(host, plain.kernels, plain.device)
    before = partly.copy().on_host()
    rates = {**RATES, "sh": RATES["sh"][: 3 * host.shape("sh")[1]]}
    assert before.frozen == frozen
    for turn in range(3):
        dense = random_gradients(host, turn)[1]
        for adam in (plain, partly):
            adam.step_all({n: t.to(adam.device) for n, t in dense.items()}, rates, sh_degree=1)
    for name in partly.tensors:
        found = partly.array(name)
        assert np.array_equal(found[:frozen], before.array(name)[:frozen]), name
        assert np.array_equal(found[frozen:], plain.array(name)[frozen:]), name
    assert not partly.steps[:frozen].any()
    assert np.array_equal(partly.steps[frozen:], plain.steps[frozen:])
    assert np.array_equal(partly.all_moments[frozen:], plain.all_moments[frozen:])
    assert plain.steps[:frozen].any()

# SPDX-License-Identifier: GPL-3.0-or-later
"""Density statistics on a device, emulated or a GPU, equal those of the processor."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.cuda.device_view import DeviceView
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.types import ImageGradients, RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.training.density import DensityStatistics, DeviceDensityStatistics
from tests.core.device_kernels import DEVICES, kernels_of
from tests.core.render.scenes import look_at, random_gaussians

COUNT = 60
SUMS = ("gradient", "gradient_abs", "views")


def some(seed: int) -> DensityStatistics:
    random = np.random.default_rng(seed)
    sums = random.uniform(0.0, 1e-3, (2, COUNT)).astype(np.float32)
    return DensityStatistics(sums[0], sums[1], random.integers(0, 9, COUNT).astype(np.int32))


@pytest.mark.parametrize("device", DEVICES)
def test_views_add_what_they_add_on_the_processor(
    request: pytest.FixtureRequest, device: str
) -> None:
    kernels = kernels_of(device, request)
    there = torch.device("cuda" if device == "cuda" else "cpu")
    gaussians = random_gaussians(COUNT, seed=3, dtype=torch.float32)
    sent = OrientedGaussians(**{name: t.to(there) for name, t in gaussians.tensors()})
    options = RenderOptions(depth=False, screen_gradients=True, threads=1)
    wanted, start = some(1), some(1)
    found = DeviceDensityStatistics(start, there)
    renderer, random = ViewRenderer(), np.random.default_rng(2)
    # The second sees a part of them.
    for eye, part in (((3.0, 1.0, 0.5), 1.0), ((0.6, 0.3, 0.2), 0.25)):
        camera = look_at(eye, width=24, height=20, focal=30.0)
        color = random.normal(size=(20, 24, 3)).astype(np.float32)
        image = renderer.render(RawArrays.from_gaussians(gaussians), camera, options)
        image.backward(ImageGradients(color=color))
        assert image.statistics is not None
        wanted.add(image.statistics, 96, 80, part)
        view = DeviceView(kernels, sent, camera, options, 1 << 26)
        view.backward([torch.from_numpy(color).to(there), None, None, None, None])
        found.add_view(view, 96, 80, part)
    assert 0 < np.count_nonzero(wanted.views - start.views == 1) < COUNT
    assert np.array_equal(found.views, wanted.views)
    for name in SUMS[:2]:
        a, b = getattr(found, name), getattr(wanted, name)
        assert a.dtype == b.dtype == np.float32
        assert np.linalg.norm(a - b) <= 1e-4 * np.linalg.norm(b), name


def test_copies_on_the_host_are_copies() -> None:
    start = some(4)
    found = DeviceDensityStatistics(start, torch.device("cpu"))
    hosted = found.on_host()
    assert type(hosted) is DensityStatistics
    for name in SUMS:
        assert np.array_equal(getattr(hosted, name), getattr(start, name))
        assert getattr(found, name).dtype == getattr(start, name).dtype
        for array in (getattr(start, name), getattr(hosted, name), getattr(found, name)):
            array[:] = 7
    again = some(4)
    assert all(np.array_equal(getattr(found, name), getattr(again, name)) for name in SUMS)


def test_cleared_ones_stay_on_their_device() -> None:
    found = DeviceDensityStatistics(some(5), torch.device("cpu")).cleared(7)
    assert isinstance(found, DeviceDensityStatistics)
    assert found.device == torch.device("cpu")
    for name in SUMS:
        assert np.array_equal(getattr(found, name), np.zeros(7))

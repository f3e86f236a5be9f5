# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth queries of the CUDA text, emulated on the host or on a GPU, against those of the CPU."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render import depth_query
from gaussian_wrapping_addon.core.render.cuda import device_query
from gaussian_wrapping_addon.core.render.cuda.kernels import (
    Kernels,
    cuda_available,
    cuda_source,
    device_kernels,
)
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.comparisons import leaves
from tests.core.render.cuda.emulation import EmulatedKernels, build_emulator
from tests.core.render.depth_scenes import joined
from tests.core.render.query_autograd import query_depth, slopes_of
from tests.core.render.query_scenes import SCENES, SHAPES, assert_depths, scene, true_depth
from tests.core.render.query_scenes import random_positions as positions_of
from tests.core.render.scenes import isotropic, look_at, random_gaussians
from tests.core.render.test_depth_query import assert_same_as_the_definition
from tests.core.render.test_properties import ABSURD, one_wild

FRONT = look_at((0.0, -4.0, 0.0)).cam_from_world
COLUMNS = [*range(13), 22]
"""Of params: what depths depend on."""


def repeated(
    kernels: Kernels, gaussians: OrientedGaussians, camera: Camera, count: int
) -> list[Tensor]:
    """Return everything that must be reproduced."""
    leaf = leaves(gaussians, torch.float32)
    at = torch.from_numpy(positions_of(camera, count)).requires_grad_()
    depth = query_depth(leaf, camera, at, RenderOptions(near_z=1e-6), kernels)
    depth.backward(torch.linspace(-1.0, 1.0, count))
    assert at.grad is not None
    return [depth.detach(), at.grad, *(getattr(leaf, name).grad for name in SHAPES)]


@pytest.mark.parametrize("name", [*SCENES, "thin layers", "opaque stack"])
def test_the_hardwares_approximations_stay_within_tolerance(
    emulator_library: Path, name: str
) -> None:
    rough = EmulatedKernels(emulator_library, ulp=1.0)
    query = functools.partial(query_depth, kernels=rough)
    if name != "thin":
        assert_same_as_the_definition(query, name)
        return
    gaussians, camera = scene(name)
    positions = positions_of(camera, 900)
    found = query(gaussians, camera, torch.from_numpy(positions)).numpy()
    assert_depths(found, true_depth(gaussians, camera, positions))


def test_the_order_of_the_threads_does_not_matter(emulator_library: Path) -> None:
    one, two = (
        repeated(EmulatedKernels(emulator_library, backwards=backwards), *scene("generic"), 700)
        for backwards in (False, True)
    )
    for a, b in zip(one, two, strict=True):
        assert torch.equal(a, b)


@pytest.mark.proof
def test_every_barrier_of_the_gradient_is_needed(tmp_path: Path) -> None:
    text = cuda_source()
    begin = text.index("query_gradients(")
    parts = text[begin : text.index("\n}\n", begin)].split("__syncthreads();")
    assert len(parts) == 3
    for number in range(2):
        broken = "__syncthreads();".join(parts).replace(
            parts[number] + "__syncthreads();", parts[number]
        )
        folder = tmp_path / str(number)
        folder.mkdir()
        library = build_emulator(folder, text.replace("__syncthreads();".join(parts), broken))
        one, two = (
            torch.cat([value.flatten() for value in repeated(kernels, *scene("one tile"), 600)[2:]])
            for kernels in (EmulatedKernels(library), EmulatedKernels(library, backwards=True))
        )
        assert not torch.equal(one, two) or not torch.isfinite(one).all(), f"barrier {number}"


def test_distant_and_hidden_gaussians_are_those_of_the_cpu(emulator_library: Path) -> None:
    # Beyond the finer screen's range but reaching into the image; invalid in other ways.
    aside = [(40.0, -3.99, 0.0), (3000.0, 0.0, 0.0), (0.0, 30.0, 0.0), (1e5, 5.0, 1e5)]
    sigmas, count = [30.0, 2000.0, 20.0, 3e4], 4
    gaussians = isotropic(aside, sigmas, [0.9] * count, torch.float32)
    bad = gaussians.select(torch.tensor([2, 2, 2, 2]))
    bad.means[0, 0], bad.sh[1, 0, 0], bad.orientation[2, 3] = math.nan, math.nan, math.nan
    bad.log_scales[3] = 60.0
    both_kinds = gaussians.joined(bad)
    for camera in (
        Camera("front", 33, 17, 40.0, 40.0, 16.0, 8.0, FRONT),
        Camera("large", 3000, 2000, 2500.0, 2500.0, 1500.0, 1000.0, FRONT),
    ):
        options = RenderOptions(threads=1, near_z=1e-3)
        view = device_query.query_view(
            EmulatedKernels(emulator_library), both_kinds, camera, options
        )
        raw = RawArrays.from_gaussians(both_kinds)
        wanted = depth_query.query_view(raw, camera, options).screen
        assert np.array_equal(view.screen.visible, wanted.visible)
        assert wanted.visible[:4].sum() >= 2
        assert not wanted.visible[4:].any()
        seen = wanted.visible
        for name in ("boxes", "skews", "depths"):
            found = getattr(view.screen, name).numpy()[seen]
            np.testing.assert_allclose(found, getattr(wanted, name)[seen], rtol=1e-6)
        found = view.screen.params.numpy()[seen][:, COLUMNS]
        np.testing.assert_allclose(found, wanted.params[seen][:, COLUMNS], rtol=1e-6)


@pytest.mark.parametrize("name", ABSURD)
def test_absurd_values_stay_finite(emulator_library: Path, name: str) -> None:
    gaussians, camera = ABSURD[name]
    found = repeated(EmulatedKernels(emulator_library), joined(gaussians, one_wild()), camera, 60)
    for value in found:
        assert torch.isfinite(value).all()
    assert float(found[0].min()) >= 0.0


def test_endless_lists_are_refused(emulator_library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians, camera = scene("generic")
    positions = torch.from_numpy(positions_of(camera, 50))
    monkeypatch.setattr(device_query, "MAX_INTERSECTIONS", 10)
    with pytest.raises(ResourceError, match="do not fit"):
        query_depth(gaussians, camera, positions, None, EmulatedKernels(emulator_library))


@pytest.mark.gpu
def test_a_large_view_on_the_gpu_equals_the_cpu_in_every_run() -> None:
    usable, reason = cuda_available()
    if not usable:
        pytest.skip(reason)
    gpu = device_kernels(torch.cuda.current_device())
    gaussians = random_gaussians(20_000, seed=2, dtype=torch.float32, scale=(0.01, 0.1))
    camera = look_at((2.2, 1.0, 0.8), width=800, height=600, focal=900.0)
    positions = torch.from_numpy(positions_of(camera, 4000))
    found, wanted = (
        query_depth(leaves(gaussians, torch.float32), camera, positions, None, on)
        for on in (gpu, None)
    )
    slopes, found, wanted = slopes_of(found), found.detach().numpy(), wanted.detach().numpy()
    both = (found > 0) & (wanted > 0)
    assert both.sum() > 1000
    assert ((found > 0) != (wanted > 0)).mean() <= 1e-3
    away = np.abs(found - wanted)[both]
    assert np.quantile(np.minimum(away / wanted[both], away * slopes[both]), 0.999) < 1e-5
    runs = [repeated(gpu, gaussians, camera, 4000) for _ in range(3)]
    for run in runs[1:]:
        for a, b in zip(run, runs[0], strict=True):
            assert torch.equal(a, b)

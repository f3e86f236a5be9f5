# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth queries of the CUDA text, emulated on the host or on a GPU, against those of the CPU."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from gaussian_wrapping_addon.core.errors import ResourceError, UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render import depth_query
from gaussian_wrapping_addon.core.render.cuda import device_query
from gaussian_wrapping_addon.core.render.cuda.device_query import project_query_gradients
from gaussian_wrapping_addon.core.render.cuda.device_renderer import render_with
from gaussian_wrapping_addon.core.render.cuda.kernels import (
    Kernels,
    cuda_available,
    cuda_source,
    device_kernels,
)
from gaussian_wrapping_addon.core.render.projection import RawArrays, RawGradients, project_backward
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.cuda.comparison import relative_l2
from tests.core.render.cuda.emulation import EmulatedKernels, build_emulator
from tests.core.render.depth_scenes import joined
from tests.core.render.query_scenes import SCENES, SHAPES, Oracle, assert_depths, scene
from tests.core.render.query_scenes import random_positions as positions_of
from tests.core.render.scenes import isotropic, look_at, random_gaussians
from tests.core.render.test_properties import ABSURD, one_wild

FRONT = look_at((0.0, -4.0, 0.0)).cam_from_world
COLUMNS = [*range(13), 22]
"""Of params: what depths depend on."""


@dataclass(frozen=True)
class Answers:
    """Depths, slopes and gradients of one query, in the order of the positions."""

    depth: Tensor  # (m,)
    slope: Tensor  # (m,)
    params: Tensor  # (n, 14) screen
    by_params: Tensor  # (n, 24)
    by_positions: Tensor  # (m, 2)
    raw: dict[str, Tensor]

    def values(self) -> list[Tensor]:
        """Return everything that must be reproduced."""
        return [self.depth, self.slope, self.by_params, self.by_positions, *self.raw.values()]


def on_cpu(
    gaussians: OrientedGaussians,
    camera: Camera,
    positions: np.ndarray,
    options: RenderOptions,
    weights: Tensor,
) -> Answers:
    view = depth_query.query_view(RawArrays.from_gaussians(gaussians), camera, options)
    result = depth_query.solve_depths(view, positions)
    slope = np.ones(len(positions), np.float32)
    slope[result.positions.order] = result.slopes
    by_params = np.zeros_like(view.screen.params)
    by_positions = depth_query.add_query_gradients(
        view, result, weights.numpy() * slope.astype(np.float64), by_params
    )
    raw = RawGradients.zeros(view.gaussians)
    project_backward(view.gaussians, view.camera, view.options, view.screen, by_params, raw)
    found = {name: torch.from_numpy(getattr(raw, name)) for name in SHAPES}
    params = view.screen.params[:, COLUMNS] * view.screen.visible[:, None]
    arrays = (result.values, slope, params, by_params, by_positions)
    return Answers(*(torch.from_numpy(array) for array in arrays), found)


def on_device(
    kernels: Kernels,
    gaussians: OrientedGaussians,
    camera: Camera,
    positions: np.ndarray,
    options: RenderOptions,
    weights: Tensor,
    device: str = "cpu",
) -> Answers:
    there = OrientedGaussians(**{name: t.detach().to(device) for name, t in gaussians.tensors()})
    view = device_query.query_view(kernels, there, camera, options)
    result = device_query.solve_depths(view, torch.from_numpy(positions).to(device))
    slope = torch.ones_like(result.values)
    slope[result.points.order] = result.slopes
    by_params = torch.zeros_like(view.screen.params)
    by_positions = device_query.add_query_gradients(
        view, result, weights.to(device) * slope.double(), by_params
    )
    raw = project_query_gradients(view, result, by_params)
    params = view.screen.params[:, COLUMNS] * view.screen.visible[:, None]
    found = (result.values, slope, params, by_params, by_positions)
    return Answers(*(tensor.cpu() for tensor in found), {name: raw[name].cpu() for name in SHAPES})


def both(
    kernels: Kernels,
    gaussians: OrientedGaussians,
    camera: Camera,
    positions: np.ndarray,
    options: RenderOptions | None = None,
    *,
    device: str = "cpu",
) -> tuple[Answers, Answers]:
    """Query on the device and on the CPU, with gradients of random weights.

    A depth's gradient is something well conditioned over the slope of log T: each position is
    weighed by its slope on either side.
    """
    options = options or RenderOptions(threads=1)
    generator = torch.Generator().manual_seed(6)
    weights = torch.randn(len(positions), generator=generator, dtype=torch.float64)
    wanted = on_cpu(gaussians, camera, positions, options, weights)
    return on_device(kernels, gaussians, camera, positions, options, weights, device), wanted


def assert_same(
    found: Answers, wanted: Answers, *, decided: float = 0.0, gradient: float = 1e-4
) -> None:
    """Compare everything.

    Depths agree to 1e-5, or in log T where that is flat; slopes where T is not flat. In the share
    ``decided`` of the positions rounding may decide a threshold the other way.
    """
    for value in found.values():
        assert torch.isfinite(value).all()
    torch.testing.assert_close(found.params, wanted.params, rtol=1e-6, atol=0.0)
    a, b = found.depth.double(), wanted.depth.double()
    assert float(((a > 0) != (b > 0)).double().mean()) <= decided
    exists = (a > 0) & (b > 0)
    error = torch.where(exists, (a - b).abs() / b, 0.0)
    residual = torch.where(exists, (a - b).abs() * found.slope, 0.0)
    assert float(torch.minimum(error, residual).quantile(1.0 - decided)) < 1e-5
    slopes = torch.where(exists, (found.slope / wanted.slope - 1.0).abs(), 0.0)
    assert float(torch.where(error < 1e-5, slopes, 0.0).quantile(0.99)) < 1e-3
    if exists.any() and decided == 0.0:
        assert relative_l2(found.by_params[:, :13], wanted.by_params[:, :13]) < gradient
        assert relative_l2(found.by_positions, wanted.by_positions) < gradient
        for name in SHAPES:
            assert relative_l2(found.raw[name], wanted.raw[name]) < gradient, name
    assert not found.by_params[:, 13:].any()
    assert not found.by_positions[a == 0].any()


@pytest.mark.parametrize("ulp", [0.0, 1.0])
@pytest.mark.parametrize("name", SCENES)
def test_emulated_queries_equal_the_cpu(emulator_library: Path, name: str, ulp: float) -> None:
    gaussians, camera = scene(name)
    positions = positions_of(camera, 900)
    found, wanted = both(EmulatedKernels(emulator_library, ulp=ulp), gaussians, camera, positions)
    assert int((found.depth > 0).sum()) > 180
    assert_same(found, wanted)
    assert_depths(found.depth.numpy(), Oracle(gaussians, camera).depth(positions))


def test_the_order_of_the_threads_does_not_matter(emulator_library: Path) -> None:
    gaussians, camera = scene("generic")
    positions = positions_of(camera, 700)
    weights = torch.linspace(-1.0, 1.0, 700, dtype=torch.float64)
    one, two = (
        on_device(
            EmulatedKernels(emulator_library, backwards=backwards), gaussians, camera, positions,
            RenderOptions(), weights,
        )
        for backwards in (False, True)
    )  # fmt: skip
    for a, b in zip(one.values(), two.values(), strict=True):
        assert torch.equal(a, b)


def thin_layers() -> tuple[OrientedGaussians, Camera]:
    """Return turned sheets of a hundredth of their distance and less, one behind the other."""
    gaussians = random_gaussians(90, seed=4, dtype=torch.float32, opacity=(0.2, 0.6))
    thickness = torch.linspace(-7.0, -4.0, 90)
    logs = torch.stack([torch.full((90,), -0.5), torch.full((90,), -1.0), thickness], 1)
    return gaussians.replaced(log_scales=logs), look_at((2.2, 1.0, 0.8), width=33, height=17)


def opaque_stack() -> tuple[OrientedGaussians, Camera]:
    """Return more Gaussians on every ray than a warp takes at once, and an opaque wall in them."""
    count = 150
    means = [(0.0, 0.02 * i, 0.0) for i in range(count)]
    gaussians = isotropic(means, [0.5] * count, [0.03] * 70 + [0.95] * 80, torch.float32)
    logs = gaussians.log_scales + torch.tensor([0.3, -1.0, 0.1])
    quats = torch.tensor([[0.9, 0.1, -0.2, 0.3]]).repeat(count, 1)
    return gaussians.replaced(log_scales=logs, quats=quats), Camera(
        "front", 33, 17, 40.0, 40.0, 16.0, 8.0, FRONT
    )


HARD = {"thin layers": thin_layers, "opaque stack": opaque_stack}


@pytest.mark.parametrize("ulp", [0.0, 1.0])
@pytest.mark.parametrize("name", HARD)
def test_hard_scenes(emulator_library: Path, name: str, ulp: float) -> None:
    gaussians, camera = HARD[name]()
    positions = positions_of(camera, 500)
    found, wanted = both(EmulatedKernels(emulator_library, ulp=ulp), gaussians, camera, positions)
    assert int((found.depth > 0).sum()) > 150
    assert_same(found, wanted)


def one_tile() -> tuple[OrientedGaussians, Camera, np.ndarray]:
    """Return more Gaussians and more points of one tile than a block has threads."""
    gaussians = random_gaussians(400, seed=6, dtype=torch.float32, opacity=(0.02, 0.2))
    camera = look_at((2.2, 1.0, 0.8), width=16, height=16, focal=30.0)
    return gaussians, camera, positions_of(camera, 600)


def test_many_gaussians_and_many_points_of_one_tile(emulator_library: Path) -> None:
    found, wanted = both(EmulatedKernels(emulator_library), *one_tile())
    assert int((found.depth > 0).sum()) > 200
    assert_same(found, wanted)


@pytest.mark.proof
def test_every_barrier_of_the_gradient_is_needed(tmp_path: Path) -> None:
    text = cuda_source()
    begin = text.index("query_gradients(")
    parts = text[begin : text.index("\n}\n", begin)].split("__syncthreads();")
    assert len(parts) == 3
    weights = torch.linspace(-1.0, 1.0, 600, dtype=torch.float64)
    for number in range(2):
        broken = "__syncthreads();".join(parts).replace(
            parts[number] + "__syncthreads();", parts[number]
        )
        folder = tmp_path / str(number)
        folder.mkdir()
        library = build_emulator(folder, text.replace("__syncthreads();".join(parts), broken))
        one, two = (
            on_device(
                EmulatedKernels(library, backwards=b), *one_tile(), RenderOptions(), weights
            ).by_params
            for b in (False, True)
        )
        assert not torch.equal(one, two) or not torch.isfinite(one).all(), f"barrier {number}"


def test_pixel_centres_equal_the_image(emulator_library: Path) -> None:
    gaussians, camera = scene("generic", seed=5)
    kernels = EmulatedKernels(emulator_library)
    with torch.no_grad():
        image = render_with(kernels, gaussians, camera, None, 1 << 30).depth.reshape(-1)
    y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float32) + 0.5
    positions = torch.from_numpy(np.stack([x.reshape(-1), y.reshape(-1)], 1))
    view = device_query.query_view(kernels, gaussians, camera, RenderOptions())
    found = device_query.solve_depths(view, positions).values
    assert torch.equal(found > 0, image > 0)
    error = torch.where(image > 0, (found - image).abs() / image, 0.0)
    assert float(error.quantile(0.995)) < 2e-6
    assert float(error.max()) < 5e-5


def test_a_gaussian_between_pixel_centres_is_found(emulator_library: Path) -> None:
    gaussians = isotropic([(0.0, 0.0, 0.0)], [0.01], [0.9], torch.float32)
    camera = Camera("front", 16, 16, 40.0, 40.0, 8.0, 8.0, FRONT)
    positions = np.array([[8.0, 8.0], [8.05, 7.97], [8.5, 8.5]], np.float32)
    found, wanted = both(EmulatedKernels(emulator_library), gaussians, camera, positions)
    assert found.depth[0] > 3.9
    assert found.depth[2] == 0.0
    torch.testing.assert_close(found.depth, wanted.depth, rtol=1e-6, atol=0.0)


def test_points_outside_have_no_answer_and_no_gradient(emulator_library: Path) -> None:
    gaussians = isotropic([(0.0, 0.0, 0.0)], [15.0], [0.9], torch.float32)  # covers everything
    pose = look_at((0.0, -40.0, 0.0)).cam_from_world
    camera = Camera("front", 20, 10, 40.0, 40.0, 10.0, 5.0, pose)
    nan, inf = math.nan, math.inf
    inside = [[0.0, 0.0], [20.0, 10.0], [0.0, 10.0], [7.3, 2.2]]
    outside = [[-1e-3, 5.0], [5.0, 10.001], [20.01, 5.0], [nan, 5.0], [5.0, nan], [inf, 5.0]]
    outside += [[-inf, 5.0], [1e30, -1e30], [nan, inf]]
    for some in (inside + outside, outside):
        positions = np.array(some, np.float32)
        found, wanted = both(EmulatedKernels(emulator_library), gaussians, camera, positions)
        torch.testing.assert_close(found.depth, wanted.depth, rtol=1e-6, atol=0.0)
        assert int((found.depth > 0).sum()) == (4 if some is not outside else 0)
        assert torch.equal(found.by_positions != 0, wanted.by_positions != 0)
        assert bool(found.by_params.any()) == (some is not outside)


def test_nothing_to_see_and_nothing_asked(emulator_library: Path) -> None:
    gaussians = isotropic([(0.0, 9.0, 0.0)], [0.1], [0.9], torch.float32)
    camera = look_at((0.0, 3.0, 0.0), width=18, height=10)  # looks away
    for some in (gaussians, gaussians.select(torch.zeros(1, dtype=torch.bool))):
        for count in (0, 3):
            positions = np.full((count, 2), 4.0, np.float32)
            found, _ = both(EmulatedKernels(emulator_library), some, camera, positions)
            assert found.depth.shape == (count,)
            assert not any(value.any() for value in (found.depth, *found.raw.values()))
            assert not found.by_positions.any()


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
    gaussians = joined(gaussians, one_wild())
    generator = torch.Generator().manual_seed(1)
    positions = positions_of(camera, 60)
    weights = torch.randn(60, generator=generator, dtype=torch.float64)
    found = on_device(
        EmulatedKernels(emulator_library), gaussians, camera, positions,
        RenderOptions(near_z=1e-6), weights,
    )  # fmt: skip
    for value in found.values():
        assert torch.isfinite(value).all()
    assert float(found.depth.min()) >= 0.0


def test_wrong_shapes_and_endless_lists_are_refused(
    emulator_library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaussians, camera = scene("generic")
    view = device_query.query_view(
        EmulatedKernels(emulator_library), gaussians, camera, RenderOptions()
    )
    with pytest.raises(UsageError, match="shape"):
        device_query.solve_depths(view, torch.zeros((4, 3)))
    monkeypatch.setattr(device_query, "MAX_INTERSECTIONS", 10)
    with pytest.raises(ResourceError, match="do not fit"):
        device_query.solve_depths(view, torch.from_numpy(positions_of(camera, 50)))


# -- on a GPU -------------------------------------------------------------------------------------


@pytest.fixture
def gpu() -> Kernels:
    usable, reason = cuda_available()
    if not usable:
        pytest.skip(reason)
    return device_kernels(torch.cuda.current_device())


@pytest.mark.gpu
@pytest.mark.parametrize("name", [*SCENES, *HARD])
def test_queries_on_the_gpu_equal_the_cpu(gpu: Kernels, name: str) -> None:
    gaussians, camera = HARD[name]() if name in HARD else scene(name)
    positions = positions_of(camera, 900)
    found, wanted = both(gpu, gaussians, camera, positions, device="cuda")
    assert_same(found, wanted)


@pytest.mark.gpu
def test_a_large_view_on_the_gpu_equals_the_cpu(gpu: Kernels) -> None:
    gaussians = random_gaussians(20_000, seed=2, dtype=torch.float32, scale=(0.01, 0.1))
    camera = look_at((2.2, 1.0, 0.8), width=800, height=600, focal=900.0)
    positions = positions_of(camera, 4000)
    found, wanted = both(gpu, gaussians, camera, positions, device="cuda")
    assert int((found.depth > 0).sum()) > 1000
    assert_same(found, wanted, decided=1e-3)


@pytest.mark.gpu
def test_every_run_on_the_gpu_gives_the_same_bits(gpu: Kernels) -> None:
    gaussians = random_gaussians(5000, seed=2, dtype=torch.float32, scale=(0.02, 0.15))
    camera = look_at((2.2, 1.0, 0.8), width=200, height=150, focal=220.0)
    positions = positions_of(camera, 4000)
    weights = torch.linspace(-1.0, 1.0, 4000, dtype=torch.float64)
    runs = [
        on_device(gpu, gaussians, camera, positions, RenderOptions(), weights, "cuda").values()
        for _ in range(3)
    ]
    for run in runs[1:]:
        for a, b in zip(run, runs[0], strict=True):
            assert torch.equal(a, b)


@pytest.mark.gpu
def test_nothing_on_the_gpu(gpu: Kernels) -> None:
    gaussians, camera = scene("generic")
    for some in (gaussians, gaussians.select(torch.zeros(len(gaussians), dtype=torch.bool))):
        for count in (0, 3):
            positions = np.full((count, 2), -4.0, np.float32)
            found, _ = both(gpu, some, camera, positions, device="cuda")
            assert not any(value.any() for value in (found.depth, *found.raw.values()))

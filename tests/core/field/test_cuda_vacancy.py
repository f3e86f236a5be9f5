# SPDX-License-Identifier: GPL-3.0-or-later
"""The CUDA vacancy, emulated on the host or on a GPU, equals the numba kernel and brute force."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.vacancy_scale import brute_force_vacancy
from gaussian_wrapping_addon.core.errors import Cancelled, DeviceError, ResourceError
from gaussian_wrapping_addon.core.field import cuda_vacancy, vacancy_kernels
from gaussian_wrapping_addon.core.field.cuda_vacancy import CudaVacancyField
from gaussian_wrapping_addon.core.field.vacancy import SETTLED, VacancyField
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.cuda.kernels import cuda_available, cuda_source
from gaussian_wrapping_addon.core.scene.camera import Similarity
from tests.core.field.field_scenes import (
    around_shell,
    camera_at,
    cameras_around,
    make_arrays,
    random_arrays,
    shell_arrays,
    unit_sphere,
)
from tests.core.render.cuda.emulation import EmulatedKernels

RIM = 1.0 / 255.0


"""What one Gaussian changes where rounding decides whether the rim of its footprint counts."""


ROUNDING = 3e-4


"""Twice what the hardware's approximations, disturbed by their bounds, change on these scenes."""


FieldMaker = Callable[..., CudaVacancyField]


@pytest.fixture(
    params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)],
)
def cuda_field(request: pytest.FixtureRequest) -> FieldMaker:
    """Return what makes a field of the CUDA kernels: on the host, and where there is one, a GPU."""
    if request.param == "gpu":
        usable, reason = cuda_available()
        if not usable:
            pytest.skip(reason)
        return CudaVacancyField
    return emulated(request.getfixturevalue("emulator_library"))


def emulated(library: Path, **how: bool | float) -> FieldMaker:
    """Return what makes fields whose kernels are emulated."""

    def make(arrays, cameras, **options) -> CudaVacancyField:  # type: ignore[no-untyped-def]
        options = {"device_cache_bytes": 1 << 30, "threads": 1, **options}
        kernels = EmulatedKernels(library, **how)  # type: ignore[arg-type]
        return CudaVacancyField(arrays, cameras, device="cpu", kernels=kernels, **options)

    return make


def query_points(means: np.ndarray, count: int, seed: int = 1) -> np.ndarray:
    """Return points anywhere, points close to Gaussians, and their centres."""
    rng = np.random.default_rng(seed)
    near = means[rng.integers(0, len(means), count)]
    return np.concatenate(
        [rng.normal(size=(count, 3)), near + 0.02 * rng.normal(size=(count, 3)), near]
    )


def assert_same_as_cpu(found: CudaVacancyField, cpu: VacancyField, points: np.ndarray) -> None:
    """Check values, cameras, unseen points and counts."""
    got, expected = found.vacancy(points), cpu.vacancy(points)
    np.testing.assert_array_equal(got.camera >= 0, expected.camera >= 0)
    np.testing.assert_array_equal(np.isnan(got.vacancy), np.isnan(expected.vacancy))
    assert found.unseen_evaluations == cpu.unseen_evaluations
    resolved = (expected.camera >= 0) & (expected.vacancy <= SETTLED) & (got.vacancy <= SETTLED)
    gap = np.abs(got.vacancy - expected.vacancy)
    assert (gap[~resolved & (got.camera >= 0)] < 1.0 - SETTLED + RIM).all()
    assert_small(gap[resolved])
    # Another camera wins only where two see the same up to rounding.
    other = np.flatnonzero(resolved & (got.camera != expected.camera))
    seen = [cpu.transmittance(points[row : row + 1], int(got.camera[row]))[0] for row in other]
    assert_small(expected.vacancy[other] - np.array(seen, np.float32))


def assert_small(gap: np.ndarray) -> None:
    """Check that all but a few values are rounding, and those few one Gaussian's rim."""
    assert (gap > ROUNDING).sum() <= 0.002 * len(gap)
    assert gap.max(initial=0.0) < 1.5 * RIM


def test_random_gaussians_equal_the_cpu_and_brute_force(cuda_field: FieldMaker) -> None:
    arrays, cameras = random_arrays(400), cameras_around(6)
    points = query_points(arrays.means, 500)
    field = cuda_field(arrays, cameras)
    assert_same_as_cpu(field, VacancyField(arrays, cameras, threads=1), points)
    result = field.vacancy(points)
    exact, camera = brute_force_vacancy(arrays, cameras, points)
    np.testing.assert_array_equal(result.camera >= 0, camera >= 0)
    resolved = (camera >= 0) & (result.vacancy <= SETTLED)
    error = (result.vacancy - exact)[resolved]
    assert resolved.sum() > 500
    # Dropping tails can only let more light through.
    assert error.min() > -5e-4
    assert error.max() < 0.005
    assert np.median(np.abs(error)) < 5e-4


def test_dense_shell_equals_the_cpu_and_brute_force(cuda_field: FieldMaker) -> None:
    arrays, cameras = shell_arrays(0.9), cameras_around(5)
    points = around_shell(400, 0.015)
    field = cuda_field(arrays, cameras)
    assert_same_as_cpu(field, VacancyField(arrays, cameras, threads=1), points)
    result = field.vacancy(points)
    exact, _ = brute_force_vacancy(arrays, cameras, points)
    resolved = result.vacancy <= SETTLED
    error = (result.vacancy - exact)[resolved]
    surface = np.abs(result.vacancy[resolved] - 0.5) < 0.2
    assert surface.sum() > 20
    assert error.min() > -1e-4
    assert error[surface].max() < 0.012
    assert error.max() < 0.02


def test_without_tails_they_agree_to_float32(cuda_field: FieldMaker) -> None:
    arrays = make_arrays(0.05 * unit_sphere(20), [0.3, 0.2, 0.25], np.linspace(0.15, 0.3, 20))
    cameras = cameras_around(4)
    points = 0.1 * np.random.default_rng(0).normal(size=(300, 3))
    exact, _ = brute_force_vacancy(arrays, cameras, points)
    assert np.abs(cuda_field(arrays, cameras).vacancy(points).vacancy - exact).max() < 2e-5


@pytest.mark.parametrize("anisotropy", [1e2, 1e4, 1e6])
def test_thin_discs_seen_at_a_slant(cuda_field: FieldMaker, anisotropy: float) -> None:
    thin, alpha = 0.1 / anisotropy, 0.9
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    turn[:, 2] *= -np.sign(turn[1, 2])  # towards the camera at -y
    arrays = make_arrays(np.zeros(3), [0.1, 0.1, thin], alpha, rotations=turn[None])
    camera = camera_at(np.array([0.0, -4.0, 0.0]))
    # Pixels and depth are float32 at a distance of 4: about 1e-6 units.
    blur = 1e-6
    offset = thin * np.sqrt(2.0 * np.log(2.0 * alpha))
    heights = offset * np.array([0.5, 0.9, 1.1, 1.5]) + 10.0 * blur * np.array([-1, -1, 1, 1])
    points = heights[:, None] * turn[:, 2]
    exact, _ = brute_force_vacancy(arrays, [camera], points)
    got = cuda_field(arrays, [camera]).vacancy(points).vacancy
    np.testing.assert_array_equal(got > 0.5, [False, False, True, True])
    assert np.abs(got - exact).max() < 1e-3 + 0.55 * blur / thin


@pytest.mark.parametrize("alpha", [0.02, 0.999999])
def test_opaque_and_nearly_transparent_layers(cuda_field: FieldMaker, alpha: float) -> None:
    heights = np.linspace(-0.5, 0.5, 60)
    layers = np.stack([np.zeros(60), heights, np.zeros(60)], 1)
    camera = camera_at(np.array([0.0, -4.0, 0.0]))
    points = np.stack([np.zeros(40), np.linspace(-0.8, 0.8, 40), np.zeros(40)], 1)
    arrays = make_arrays(layers, [0.5, 0.004, 0.5], alpha)
    exact, _ = brute_force_vacancy(arrays, [camera], points)
    got = cuda_field(arrays, [camera]).vacancy(points).vacancy
    np.testing.assert_allclose(got, exact, atol=2e-3)


def test_gaussian_that_holds_the_camera_and_the_scene(cuda_field: FieldMaker) -> None:
    arrays = make_arrays([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]], [[60.0] * 3, [0.1] * 3], [0.3, 0.9])
    camera = camera_at(np.array([0.0, -4.0, 0.0]))
    points = np.array([[0.0, -0.2, 0.0], [0.5, 0.3, 0.4], [0.0, 0.2, 0.0]])
    exact, _ = brute_force_vacancy(arrays, [camera], points)
    got = cuda_field(arrays, [camera]).vacancy(points).vacancy
    np.testing.assert_allclose(got, exact, atol=1e-3)


def test_is_empty_is_the_sign_of_vacancy(cuda_field: FieldMaker) -> None:
    arrays, cameras = random_arrays(400), cameras_around(7)
    points = query_points(arrays.means, 400)
    vacancy = cuda_field(arrays, cameras).vacancy(points).vacancy
    for level in (0.5, 0.2):
        field = cuda_field(arrays, cameras)
        signs = field.is_empty(points, level=level)
        np.testing.assert_array_equal(signs, vacancy > np.float32(level))
        assert 0 < signs.sum() < len(signs)
        assert field.evaluations == len(points)


def test_transmittance_and_the_largest_of_it(cuda_field: FieldMaker) -> None:
    arrays, cameras = random_arrays(300, seed=4), cameras_around(5)
    field, cpu = cuda_field(arrays, cameras), VacancyField(arrays, cameras, threads=1)
    points = query_points(arrays.means, 150)
    each = np.stack([field.transmittance(points, c) for c in range(5)])  # (5, n)
    expected = np.stack([cpu.transmittance(points, c) for c in range(5)])
    np.testing.assert_array_equal(np.isnan(each), np.isnan(expected))
    assert np.nanmax(np.abs(each - expected)) < 1.5 * RIM
    result = field.vacancy(points)
    highest = np.nanmax(each, axis=0)
    resolved = highest <= SETTLED
    np.testing.assert_array_equal(result.vacancy[resolved], highest[resolved])
    np.testing.assert_array_equal(result.camera[resolved], np.nanargmax(each, axis=0)[resolved])


def test_ties_go_to_the_lower_camera(cuda_field: FieldMaker) -> None:
    arrays = make_arrays(np.zeros(3), 0.2, 0.9)
    cameras = [camera_at(np.array([0.0, -4.0, 0.0]))] * 5
    points = 0.05 * np.random.default_rng(0).normal(size=(100, 3))
    field = cuda_field(arrays, cameras)
    field.wins[3] = 7  # asked first
    result = field.vacancy(points)
    assert result.vacancy.max() < SETTLED
    assert (result.camera == 0).all()


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_scale_and_shift_change_nothing(cuda_field: FieldMaker, scale: float) -> None:
    arrays, cameras = random_arrays(200, scale=(1e-2, 0.1)), cameras_around(4)
    points = query_points(arrays.means, 150)
    shift = np.array([5e2, -4e3, 30.0]) * scale
    frame = Similarity(scale, np.eye(3), shift)
    moved = dataclasses.replace(
        arrays, means=scale * arrays.means + shift, scales=scale * arrays.scales
    )
    moved_cameras = [camera.moved(frame) for camera in cameras]
    base = cuda_field(arrays, cameras, near_z=0.2).vacancy(points).vacancy
    other = cuda_field(moved, moved_cameras, near_z=0.2 * scale)
    gap = np.abs(other.vacancy(scale * points + shift).vacancy - base)[base <= SETTLED]
    assert np.quantile(gap, 0.99) < 2e-4
    assert gap.max() < 5e-3


def test_region_bounds_change_no_value_inside(cuda_field: FieldMaker) -> None:
    arrays = random_arrays(400, scale=(0.02, 0.3))
    cameras = [*cameras_around(5), camera_at(np.array([0.3, 0.2, 0.3]))]
    bounds = np.array([[-0.3, -0.2, 0.0], [0.4, 0.5, 0.6]])
    points = np.random.default_rng(2).uniform(bounds[0] - 0.05, bounds[1] + 0.05, (600, 3))
    inside = ((points >= bounds[0]) & (points <= bounds[1])).all(1)
    full = cuda_field(arrays, cameras).vacancy(points)
    result = cuda_field(arrays, cameras, region_bounds=bounds).vacancy(points)
    resolved = inside & (full.vacancy <= SETTLED)
    assert resolved.sum() > 100
    np.testing.assert_array_equal(result.vacancy[resolved], full.vacancy[resolved])
    np.testing.assert_array_equal(result.camera[inside] >= 0, full.camera[inside] >= 0)
    assert (result.camera[~inside] == -1).all()


@pytest.mark.parametrize("unseen", ["empty", "occupied", "invalid"])
def test_unseen_points_follow_the_policy(cuda_field: FieldMaker, unseen: str) -> None:
    arrays = make_arrays(np.zeros(3), 0.1, 0.9)
    camera = camera_at(np.array([0.0, -4.0, 0.0]))
    behind, near, aside = [0.0, -5.0, 0.0], [0.0, -3.9, 0.0], [50.0, 0.0, 0.0]
    points = np.array([behind, near, aside, [np.nan, 0.0, 0.0], [0.0, -2.0, 0.0]])
    field, cpu = (
        cuda_field(arrays, [camera], unseen=unseen),
        VacancyField(arrays, [camera], unseen=unseen, threads=1),  # type: ignore[arg-type]
    )
    assert_same_as_cpu(field, cpu, points)
    np.testing.assert_array_equal(field.vacancy(points).camera, [-1, -1, -1, -1, 0])
    np.testing.assert_array_equal(field.is_empty(points), cpu.is_empty(points))


@pytest.mark.parametrize("mode", ["ignore", "background"])
def test_masks_equal_the_cpu(cuda_field: FieldMaker, mode: str) -> None:
    arrays, cameras = random_arrays(300), cameras_around(4)
    rng = np.random.default_rng(3)
    masks = [rng.random((30 + 7 * k, 40 + k)) < 0.4 for k in range(3)] + [None]
    points = query_points(arrays.means, 300)
    cameras[3] = camera_at(np.array([0.0, 3.0, 0.0]), focal=900.0)  # sees the middle only
    options = {"masks": masks, "mask_mode": mode, "unseen": "occupied"}
    field = cuda_field(arrays, cameras, **options)
    cpu = VacancyField(arrays, cameras, threads=1, **options)  # type: ignore[arg-type]
    assert_same_as_cpu(field, cpu, points)
    got, expected = field.is_empty(points), cpu.is_empty(points)
    assert field.unseen_evaluations == cpu.unseen_evaluations
    assert (cpu.unseen_evaluations > 100) == (mode == "ignore")
    clear = np.abs(cpu.vacancy(points).vacancy - 0.5) > 2 * RIM
    np.testing.assert_array_equal(got[clear], expected[clear])


def test_no_gaussians_and_no_points(cuda_field: FieldMaker) -> None:
    field = cuda_field(make_arrays(np.zeros((0, 3)), 0.1, 0.5), cameras_around(2))
    assert (field.vacancy(np.zeros((3, 3))).vacancy == 1.0).all()
    assert len(field.vacancy(np.zeros((0, 3))).vacancy) == 0
    assert len(field.is_empty(np.zeros((0, 3)))) == 0


def test_prepared_small_batches_and_no_memory_change_nothing(cuda_field: FieldMaker) -> None:
    arrays, cameras = random_arrays(300), cameras_around(4)
    points = query_points(arrays.means, 100)
    ready = cuda_field(arrays, cameras)
    ready.prepare()
    whole = ready.vacancy(points)
    poor = cuda_field(arrays, cameras, device_cache_bytes=0, cache_bytes=0)
    parts = np.concatenate([poor.vacancy(part).vacancy for part in np.array_split(points, 7)])
    resolved = whole.vacancy <= SETTLED
    np.testing.assert_array_equal(parts[resolved], whole.vacancy[resolved])


def test_cancelling(cuda_field: FieldMaker) -> None:
    field = cuda_field(make_arrays(np.zeros(3), 0.1, 0.9), cameras_around(2))
    with pytest.raises(Cancelled):
        field.vacancy(np.zeros((5, 3)), Progress(is_cancelled=lambda: True))


def test_the_same_bits_in_any_order_of_threads(emulator_library: Path) -> None:
    arrays, cameras = shell_arrays(0.9, count=500), cameras_around(3)
    points = around_shell(200, 0.02)
    one, two = (
        emulated(emulator_library, backwards=backwards)(arrays, cameras).vacancy(points)
        for backwards in (False, True)
    )
    np.testing.assert_array_equal(one.vacancy, two.vacancy)
    np.testing.assert_array_equal(one.camera, two.camera)


def test_a_point_is_done_with_at_the_first_camera_that_settles_it(emulator_library: Path) -> None:
    launched = []

    class Counting(EmulatedKernels):
        def _run(self, name, blocks, parameters):  # type: ignore[no-untyped-def]
            launched.append(name)
            super()._run(name, blocks, parameters)

    field = CudaVacancyField(
        make_arrays(np.zeros(3), 0.1, 0.9), cameras_around(4), device="cpu", threads=1,
        kernels=Counting(emulator_library), device_cache_bytes=1 << 30,
    )  # fmt: skip
    free = np.array([[0.0, 0.0, 0.6], [0.1, 0.5, 0.0], [0.6, 0.1, 0.1]])
    assert field.is_empty(free).all()
    assert launched.count("transmittance_tiles") == 1
    launched.clear()
    assert field.is_empty(np.concatenate([free, np.zeros((1, 3))])).tolist() == [True] * 3 + [False]
    assert launched.count("transmittance_tiles") == 4


def test_the_hardwares_approximations_stay_within_tolerance(emulator_library: Path) -> None:
    # exp and quotients disturbed by their documented bounds, signs mixed.
    arrays, cameras = random_arrays(300), cameras_around(4)
    points = query_points(arrays.means, 200)
    rough = emulated(emulator_library, ulp=1.0)(arrays, cameras)
    assert_same_as_cpu(rough, VacancyField(arrays, cameras, threads=1), points)


def test_constants_are_those_of_the_processors_kernel() -> None:
    defined = dict(
        line.split()[1:3] for line in cuda_source().splitlines() if line.startswith("#define ")
        and len(line.split()) > 2
    )  # fmt: skip
    assert float(defined["FACTOR_MIN"].rstrip("f")) == pytest.approx(vacancy_kernels._FACTOR_MIN)
    assert float(defined["TRANSMITTANCE_LOST"].rstrip("f")) == pytest.approx(vacancy_kernels._T_MIN)
    assert 2 * int(defined["CELL_SHIFT"]) == cuda_vacancy.CELL_BITS


def test_no_gpu_is_a_typed_error_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_vacancy, "cuda_available", lambda _: (False, "No GPU here."))
    with pytest.raises(DeviceError, match="No GPU here"):
        CudaVacancyField(make_arrays(np.zeros(3), 0.1, 0.9), cameras_around(2))


def test_a_full_gpu_is_a_typed_error(emulator_library: Path) -> None:
    class Full(EmulatedKernels):
        def _run(self, name, blocks, parameters):  # type: ignore[no-untyped-def]
            raise torch.OutOfMemoryError("2 GiB asked")

    field = CudaVacancyField(
        make_arrays(np.zeros(3), 0.1, 0.9), cameras_around(2), device="cpu",
        kernels=Full(emulator_library), device_cache_bytes=0,
    )  # fmt: skip
    for ask in (field.vacancy, field.is_empty, lambda points: field.transmittance(points, 0)):
        with pytest.raises(ResourceError, match="vacancy field of 1 Gaussians: 2 GiB asked"):
            ask(np.zeros((5, 3)))

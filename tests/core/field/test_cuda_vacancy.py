# SPDX-License-Identifier: GPL-3.0-or-later
"""The CUDA vacancy, emulated on the host or on a GPU, equals the numba kernel and brute force."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import DeviceError, ResourceError
from gaussian_wrapping_addon.core.field import cuda_vacancy, vacancy_kernels
from gaussian_wrapping_addon.core.field.cuda_vacancy import CudaVacancyField
from gaussian_wrapping_addon.core.field.vacancy import SETTLED, VacancyField
from gaussian_wrapping_addon.core.render.cuda.kernels import cuda_source
from tests.core.field.conftest import on_kernels
from tests.core.field.field_scenes import (
    around_shell,
    camera_at,
    cameras_around,
    make_arrays,
    query_points,
    random_arrays,
    shell_arrays,
)
from tests.core.render.cuda.emulation import EmulatedKernels

RIM = 1.0 / 255.0
"""What one Gaussian changes where rounding decides whether the rim of its footprint counts."""

ROUNDING = 3e-4
"""Twice what the hardware's approximations, disturbed by their bounds, change on these scenes."""

BALL = make_arrays(np.zeros(3), 0.1, 0.9)
FieldMaker = Callable[..., CudaVacancyField]


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


def test_random_gaussians_equal_the_cpu(cuda_field: FieldMaker) -> None:
    arrays, cameras = random_arrays(400), cameras_around(6)
    points, cpu = query_points(arrays, 500), VacancyField(arrays, cameras, threads=1)
    field = cuda_field(arrays, cameras)
    assert_same_as_cpu(field, cpu, points)
    for camera in (0, 5):
        found, wanted = (one.transmittance(points[:450], camera) for one in (field, cpu))
        np.testing.assert_array_equal(np.isnan(found), np.isnan(wanted))
        assert np.nanmax(np.abs(found - wanted)) < 1.5 * RIM


def test_a_dense_shell_equals_the_cpu(cuda_field: FieldMaker) -> None:
    arrays, cameras = shell_arrays(0.9), cameras_around(5)
    cpu = VacancyField(arrays, cameras, threads=1)
    assert_same_as_cpu(cuda_field(arrays, cameras), cpu, around_shell(400, 0.015))


def test_ties_go_to_the_lower_camera(cuda_field: FieldMaker) -> None:
    arrays = make_arrays(np.zeros(3), 0.2, 0.9)
    cameras = [camera_at(np.array([0.0, -4.0, 0.0]))] * 5
    points = 0.05 * np.random.default_rng(0).normal(size=(100, 3))
    field = cuda_field(arrays, cameras)
    field.wins[3] = 7  # asked first
    result = field.vacancy(points)
    assert result.vacancy.max() < SETTLED
    assert (result.camera == 0).all()


def test_prepared_small_batches_and_no_memory_change_nothing(cuda_field: FieldMaker) -> None:
    arrays, cameras = random_arrays(300), cameras_around(4)
    points = query_points(arrays, 100)
    ready = cuda_field(arrays, cameras)
    ready.prepare()
    whole = ready.vacancy(points)
    poor = cuda_field(arrays, cameras, device_cache_bytes=0, cache_bytes=0)
    parts = np.concatenate([poor.vacancy(part).vacancy for part in np.array_split(points, 7)])
    resolved = whole.vacancy <= SETTLED
    np.testing.assert_array_equal(parts[resolved], whole.vacancy[resolved])


def test_the_same_bits_in_any_order_of_threads(emulator_library: Path) -> None:
    arrays, cameras = shell_arrays(0.9, count=500), cameras_around(3)
    points = around_shell(200, 0.02)
    one, two = (
        on_kernels(EmulatedKernels(emulator_library, backwards=backwards))(arrays, cameras).vacancy(
            points
        )
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

    field = on_kernels(Counting(emulator_library))(BALL, cameras_around(4))
    free = np.array([[0.0, 0.0, 0.6], [0.1, 0.5, 0.0], [0.6, 0.1, 0.1]])
    assert field.is_empty(free).all()
    assert launched.count("transmittance_tiles") == 1
    launched.clear()
    assert field.is_empty(np.concatenate([free, np.zeros((1, 3))])).tolist() == [True] * 3 + [False]
    assert launched.count("transmittance_tiles") == 4


def test_the_hardwares_approximations_stay_within_tolerance(emulator_library: Path) -> None:
    # exp and quotients disturbed by their documented bounds, signs mixed.
    arrays, cameras = random_arrays(300), cameras_around(4)
    points = query_points(arrays, 200)
    rough = on_kernels(EmulatedKernels(emulator_library, ulp=1.0))(arrays, cameras)
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
        CudaVacancyField(BALL, cameras_around(2))


def test_a_full_gpu_is_a_typed_error(emulator_library: Path) -> None:
    class Full(EmulatedKernels):
        def _run(self, name, blocks, parameters):  # type: ignore[no-untyped-def]
            raise torch.OutOfMemoryError("2 GiB asked")

    field = on_kernels(Full(emulator_library))(BALL, cameras_around(2), device_cache_bytes=0)
    for ask in (field.vacancy, field.is_empty, lambda points: field.transmittance(points, 0)):
        with pytest.raises(ResourceError, match="vacancy field of 1 Gaussians: 2 GiB asked"):
            ask(np.zeros((5, 3)))

# SPDX-License-Identifier: GPL-3.0-or-later
"""The vacancy field against brute force and closed forms; masked and unseen points."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any

import mpmath
import numba
import numpy as np
import pytest
import torch

from benchmarks.vacancy_scale import (
    brute_force_vacancy,
    log_gaussian,
    log_one_minus,
    log_transmittance,
)
from gaussian_wrapping_addon.core.errors import Cancelled, UsageError
from gaussian_wrapping_addon.core.field.vacancy import SETTLED, PackedMask, VacancyField
from gaussian_wrapping_addon.core.field.vacancy_kernels import transmittance_of_cells
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from tests.core.field.field_scenes import (
    around_shell,
    camera_at,
    cameras_around,
    make_arrays,
    query_points,
    random_arrays,
    shell_arrays,
    unit_sphere,
)

FieldMaker = Callable[..., VacancyField]
FRONT = camera_at(np.array([0.0, -4.0, 0.0]))
BALL = make_arrays(np.zeros(3), 0.1, 0.9)


def difference(field: VacancyField, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return field minus brute force, and the field, where the field resolves vacancy."""
    result = field.vacancy(points)
    exact, camera = brute_force_vacancy(field.arrays, field.cameras, points)
    np.testing.assert_array_equal(result.camera >= 0, camera >= 0)
    resolved = (camera >= 0) & (result.vacancy <= SETTLED)
    # A settled point may stop at any camera, but never below what makes it settled.
    settled = (camera >= 0) & ~resolved
    assert (exact[settled] > SETTLED - 0.012).all()
    return result.vacancy[resolved] - exact[resolved], result.vacancy[resolved]


def test_brute_force_is_the_integral_of_the_attenuation() -> None:
    """T is exp of minus the integral of |w . grad log(1 - G)| up to the peak.

    See docs/method.md, section 5.1.
    """
    arrays = random_arrays(30, seed=3, scale=(0.1, 0.4))
    origin, point = np.array([0.3, -4.0, 0.2]), np.array([0.1, 0.4, -0.2])
    whiten = arrays.rotations.transpose(0, 2, 1) / arrays.scales[:, :, None]
    t = np.linspace(0.0, 1.0, 40001)
    x = origin + t[:, None] * (point - origin)
    local = np.einsum("mij,tmj->tmi", whiten, x[:, None] - arrays.means)
    log_term = np.log1p(-np.exp(arrays.log_opacities - 0.5 * (local**2).sum(-1)))  # (t, m)
    falling = np.minimum(np.diff(log_term, axis=0), 0.0)
    # Attenuation on the way in only; T(0) is what the Gaussians leave at the camera itself.
    expected = (falling.sum(0) + log_term[0]).sum()
    got = log_transmittance(arrays, origin, point[None])[0]
    assert got == pytest.approx(expected, abs=1e-7)


def test_field_equals_brute_force_up_to_the_dropped_tails(make_field: FieldMaker) -> None:
    arrays = random_arrays(400)
    error, vacancy = difference(make_field(arrays, cameras_around(6)), query_points(arrays, 500))
    assert len(error) > 500
    assert vacancy.min() < 0.05
    # Dropping tails can only let more light through.
    assert error.min() > -5e-4  # float32, on Gaussians of a thousandth of a unit
    assert error.max() < 0.005
    assert np.median(np.abs(error)) < 5e-4


def test_dense_shell_equals_brute_force_up_to_the_dropped_tails(make_field: FieldMaker) -> None:
    field = make_field(shell_arrays(0.9), cameras_around(5))
    error, vacancy = difference(field, around_shell(400, 0.015))
    surface = np.abs(vacancy - 0.5) < 0.2
    assert surface.sum() > 20
    assert error.min() > -1e-4
    assert error[surface].max() < 0.012
    assert error.max() < 0.02


def test_gaussians_without_tails_agree_to_float32(make_field: FieldMaker) -> None:
    # Well inside all footprints nothing is dropped, and what is left is rounding.
    arrays = make_arrays(0.05 * unit_sphere(20), [0.3, 0.2, 0.25], np.linspace(0.15, 0.3, 20))
    points = 0.1 * np.random.default_rng(0).normal(size=(300, 3))
    error, _ = difference(make_field(arrays, cameras_around(4)), points)
    assert len(error) == 300
    assert np.abs(error).max() < 2e-5


def test_gaussians_fainter_than_the_cut_are_dropped_with_the_stated_bound() -> None:
    arrays = make_arrays(np.zeros((10, 3)), 0.2, 1.0 / 256.0)
    point, cameras = np.zeros((1, 3)), cameras_around(2)
    value = VacancyField(arrays, cameras).vacancy(point).vacancy[0]
    exact, _ = brute_force_vacancy(arrays, cameras, point)
    assert value == 1.0
    assert 0.0 < value - exact[0] <= 1.0 - (1.0 - 1.0 / 255.0) ** 10


@pytest.mark.parametrize("alpha", [0.55, 0.9999])
@pytest.mark.parametrize("sigma", [1e-3, 0.1])
def test_isosurface_of_one_gaussian_is_a_sphere(
    make_field: FieldMaker, alpha: float, sigma: float
) -> None:
    arrays = make_arrays([0.1, -0.2, 0.15], sigma, alpha)
    field = make_field(arrays, cameras_around(12))
    offsets = sigma * np.sqrt(2.0 * np.log(2.0 * alpha)) * unit_sphere(300)
    vacancy = field.vacancy(arrays.means + offsets).vacancy
    # A relative error of 1e-3 sigma in position is 1e-3 in vacancy: float32 pixels and depths.
    np.testing.assert_allclose(vacancy, 0.5, atol=1e-4 if sigma > 0.01 else 2e-3)
    assert field.is_empty(arrays.means + 1.02 * offsets).all()
    assert not field.is_empty(arrays.means + 0.98 * offsets).any()


@pytest.mark.parametrize("anisotropy", [1e2, 1e4, 1e6])
def test_thin_discs_seen_at_a_slant(make_field: FieldMaker, anisotropy: float) -> None:
    """A disc's flank is at q = 2 ln(2 alpha) in front of it, however thin it is."""
    thin, alpha = 0.1 / anisotropy, 0.9
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    turn[:, 2] *= -np.sign(turn[1, 2])  # towards the camera at -y
    arrays = make_arrays(np.zeros(3), [0.1, 0.1, thin], alpha, rotations=turn[None])
    # Pixels and depth are float32 at a distance of 4: about 1e-6 units.
    blur = 1e-6
    offset = thin * np.sqrt(2.0 * np.log(2.0 * alpha))
    heights = offset * np.array([0.5, 0.9, 1.1, 1.5]) + 10.0 * blur * np.array([-1, -1, 1, 1])
    points = heights[:, None] * turn[:, 2]
    exact, _ = brute_force_vacancy(arrays, [FRONT], points)
    got = make_field(arrays, [FRONT]).vacancy(points).vacancy
    np.testing.assert_array_equal(got > 0.5, [False, False, True, True])
    np.testing.assert_array_equal(exact > 0.5, got > 0.5)
    # The steepest slope of 1 - G is alpha exp(-1/2) / sigma.
    assert np.abs(got - exact).max() < 1e-3 + 0.55 * blur / thin


@pytest.mark.parametrize("alpha", [0.02, 0.999999])
def test_opaque_and_nearly_transparent_layers(make_field: FieldMaker, alpha: float) -> None:
    layers = np.linspace(-0.5, 0.5, 60)[:, None] * [0.0, 1.0, 0.0]
    points = np.linspace(-0.8, 0.8, 40)[:, None] * [0.0, 1.0, 0.0]
    arrays = make_arrays(layers, [0.5, 0.004, 0.5], alpha)
    exact, _ = brute_force_vacancy(arrays, [FRONT], points)
    got = make_field(arrays, [FRONT]).vacancy(points).vacancy
    np.testing.assert_allclose(got, exact, atol=2e-3)


def test_gaussian_that_holds_the_camera_and_the_scene(make_field: FieldMaker) -> None:
    """Wider than everything: its footprint is the whole image, from a centre in front."""
    arrays = make_arrays([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]], [[60.0] * 3, [0.1] * 3], [0.3, 0.9])
    points = np.array([[0.0, -0.2, 0.0], [0.5, 0.3, 0.4], [0.0, 0.2, 0.0]])
    exact, _ = brute_force_vacancy(arrays, [FRONT], points)
    got = make_field(arrays, [FRONT]).vacancy(points).vacancy
    np.testing.assert_allclose(got, exact, atol=1e-3)


def test_is_empty_is_the_sign_of_vacancy(make_field: FieldMaker) -> None:
    arrays, cameras = random_arrays(400), cameras_around(7)
    points = query_points(arrays, 400)
    vacancy = make_field(arrays, cameras).vacancy(points).vacancy
    for level in (0.5, 0.2):
        field = make_field(arrays, cameras)
        signs = field.is_empty(points, level=level)
        np.testing.assert_array_equal(signs, vacancy > np.float32(level))
        assert 0 < signs.sum() < len(signs)
        assert field.evaluations == len(points)


@pytest.mark.parametrize("level", [0.3, 0.7])
def test_the_surface_is_at_half_whatever_the_level(make_field: FieldMaker, level: float) -> None:
    arrays, cameras = random_arrays(400), cameras_around(7)
    points = query_points(arrays, 400)
    vacancy = make_field(arrays, cameras).vacancy(points).vacancy
    field = make_field(arrays, cameras, level=level)
    raised = field.vacancy(points).vacancy
    np.testing.assert_array_equal(raised > 0.5, vacancy > level)
    np.testing.assert_array_equal(field.is_empty(points), vacancy > level)
    np.testing.assert_allclose(raised, vacancy ** (np.log(0.5) / np.log(level)), atol=1e-6)
    for unseen, value in (("empty", 1.0), ("occupied", 0.0), ("invalid", np.nan)):
        field = make_field(arrays, cameras, level=level, unseen=unseen)
        behind = np.array([[0.0, 0.0, 1e4]])
        with np.errstate(all="raise"):
            np.testing.assert_array_equal(field.vacancy(behind).vacancy, [value])
        assert field.is_empty(behind) == (value != 0.0)
    assert 0 < (vacancy > level).sum() < len(points)


def test_vacancy_is_the_largest_transmittance(make_field: FieldMaker) -> None:
    arrays = random_arrays(300, seed=4)
    field = make_field(arrays, cameras_around(5))
    points = query_points(arrays, 150)
    each = np.stack([field.transmittance(points, c) for c in range(5)])  # (5, n)
    result = field.vacancy(points)
    highest = np.nanmax(each, axis=0)
    resolved = highest <= SETTLED
    np.testing.assert_array_equal(result.vacancy[resolved], highest[resolved])
    np.testing.assert_array_equal(result.camera[resolved], np.nanargmax(each, axis=0)[resolved])
    chosen = each[result.camera, np.arange(len(points))]
    np.testing.assert_array_equal(chosen, result.vacancy)


def test_threads_batches_and_resolution_change_nothing() -> None:
    arrays, cameras = random_arrays(400), cameras_around(5)
    points = query_points(arrays, 800)
    one = VacancyField(arrays, cameras, threads=1).vacancy(points)
    three = VacancyField(arrays, cameras, threads=3).vacancy(points)
    np.testing.assert_array_equal(one.vacancy, three.vacancy)
    np.testing.assert_array_equal(one.camera, three.camera)
    alone = VacancyField(arrays, cameras, cache_bytes=0)
    parts = np.concatenate([alone.vacancy(part).vacancy for part in np.array_split(points, 37)])
    resolved = one.vacancy <= SETTLED
    np.testing.assert_array_equal(parts[resolved], one.vacancy[resolved])
    small = [camera.resized(100, 75) for camera in cameras]
    other = VacancyField(arrays, small).vacancy(points).vacancy
    np.testing.assert_allclose(other[resolved], one.vacancy[resolved], atol=1e-5)


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_scale_and_shift_change_nothing(make_field: FieldMaker, scale: float) -> None:
    arrays, cameras = random_arrays(200, scale=(1e-2, 0.1)), cameras_around(4)
    points = query_points(arrays, 150)
    shift = np.array([5e2, -4e3, 30.0]) * scale
    frame = Similarity(scale, np.eye(3), shift)
    moved = dataclasses.replace(
        arrays, means=scale * arrays.means + shift, scales=scale * arrays.scales
    )
    base = make_field(arrays, cameras, near_z=0.2).vacancy(points).vacancy
    other = make_field(moved, [camera.moved(frame) for camera in cameras], near_z=0.2 * scale)
    # A footprint's rim may round to the other side: a step of 1/255.
    gap = np.abs(other.vacancy(scale * points + shift).vacancy - base)[base <= SETTLED]
    assert np.quantile(gap, 0.99) < 2e-4
    assert gap.max() < 5e-3


def test_region_bounds_change_no_value_inside(make_field: FieldMaker) -> None:
    arrays = random_arrays(400, scale=(0.02, 0.3))
    cameras = [*cameras_around(5), camera_at(np.array([0.3, 0.2, 0.3]))]
    bounds = np.array([[-0.3, -0.2, 0.0], [0.4, 0.5, 0.6]])
    points = np.random.default_rng(2).uniform(bounds[0] - 0.05, bounds[1] + 0.05, (800, 3))
    inside = ((points >= bounds[0]) & (points <= bounds[1])).all(1)
    full = make_field(arrays, cameras).vacancy(points)
    part = make_field(arrays, cameras, region_bounds=bounds)
    result = part.vacancy(points)
    resolved = inside & (full.vacancy <= SETTLED)
    assert resolved.sum() > 100
    np.testing.assert_array_equal(result.vacancy[resolved], full.vacancy[resolved])
    np.testing.assert_array_equal(result.camera[inside] >= 0, full.camera[inside] >= 0)
    assert (result.camera[~inside] == -1).all()
    np.testing.assert_array_equal(part.is_empty(points[inside]), full.vacancy[inside] > 0.5)


@pytest.mark.parametrize(
    ("unseen", "value", "filled"),
    [("empty", 1.0, 1.0), ("occupied", 0.0, 0.0), ("invalid", np.nan, 1.0)],
)
def test_unseen_points_follow_the_policy(
    make_field: FieldMaker, unseen: str, value: float, filled: float
) -> None:
    behind, near, aside = [0.0, -5.0, 0.0], [0.0, -3.9, 0.0], [50.0, 0.0, 0.0]
    points = np.array([behind, near, aside, [np.nan, 0.0, 0.0], [0.0, -2.0, 0.0]])
    field = make_field(BALL, [FRONT], unseen=unseen)
    result = field.vacancy(points)
    np.testing.assert_array_equal(result.camera, [-1, -1, -1, -1, 0])
    np.testing.assert_array_equal(result.vacancy, [value] * 4 + [1.0])
    np.testing.assert_array_equal(result.filled, [filled] * 4 + [1.0])
    np.testing.assert_array_equal(field.is_empty(points), [filled > 0.5] * 4 + [True])
    assert field.unseen_evaluations == 8
    assert field.evaluations == 10
    assert np.isnan(field.transmittance(points, 0)[:4]).all()


def test_no_gaussians_and_no_points(make_field: FieldMaker) -> None:
    field = make_field(make_arrays(np.zeros((0, 3)), 0.1, 0.5), cameras_around(2))
    assert (field.vacancy(np.zeros((3, 3))).vacancy == 1.0).all()
    assert len(field.vacancy(np.zeros((0, 3))).vacancy) == 0
    assert len(field.is_empty(np.zeros((0, 3)))) == 0


def test_cameras_that_win_are_asked_first() -> None:
    field = VacancyField(shell_arrays(0.9, count=300), cameras_around(6), threads=1)
    assert sorted(field.evaluation_order().tolist()) == list(range(6))
    target = field.cameras[4].center / 4.0
    field.vacancy(target + 0.05 * np.random.default_rng(0).normal(size=(200, 3)))
    assert field.wins.sum() == 200
    assert field.evaluation_order()[0] == np.argmax(field.wins)


def test_cancelling(make_field: FieldMaker) -> None:
    field = make_field(BALL, [FRONT])
    with pytest.raises(Cancelled):
        field.vacancy(np.zeros((5, 3)), Progress(is_cancelled=lambda: True))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"unseen": "solid"}, "unseen"),
        ({"region_bounds": np.array([[1.0, 1, 1], [0.0, 0, 0]])}, "bounds"),
        ({"masks": [None]}, "2 cameras and 1 masks"),
        ({"masks": [None, np.ones((3, 4, 3), bool)]}, "shape"),
        ({"masks": [None, PackedMask.of(np.ones((0, 4), bool))]}, "shape"),
        ({"mask_mode": "white"}, "mask mode"),
    ],
)
def test_bad_input_is_named(options: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        VacancyField(BALL, cameras_around(2), **options)
    with pytest.raises(UsageError, match="at least one camera"):
        VacancyField(BALL, [])


def test_transmittance_kernel_is_vectorised() -> None:
    """Losing packed instructions costs several times the speed without any other sign."""
    VacancyField(BALL, [FRONT]).vacancy(np.zeros((1, 3)))
    fresh = numba.njit(
        nogil=True, error_model="numpy", fastmath=transmittance_of_cells.targetoptions["fastmath"]
    )(transmittance_of_cells.py_func)
    fresh.compile(transmittance_of_cells.signatures[0])
    assembly = fresh.inspect_asm(fresh.signatures[0])
    # Packed float32 multiplications: mulps or fmadd...ps on x86, fmul/fmla v.4s on ARM.
    packed = re.findall(r"(?:v?mulps|vfn?m\w+ps|f(?:mul|mla|mls)\s+v\d+\.4s)", assembly)
    assert len(packed) >= 10


def is_masked(camera: Camera, mask: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Look points up in a mask, by the definition; false outside the image."""
    pixels, depth = camera.project(points)
    seen = (depth > 0.2) & (pixels >= 0).all(1)
    seen &= (pixels[:, 0] <= camera.width) & (pixels[:, 1] <= camera.height)
    scale = mask.shape[1] / camera.width, mask.shape[0] / camera.height
    pixels = np.where(seen[:, None], pixels, 0.0) * scale
    column = np.minimum(pixels[:, 0].astype(int), mask.shape[1] - 1)
    row = np.minimum(pixels[:, 1].astype(int), mask.shape[0] - 1)
    return seen & ~mask[row, column]


@pytest.mark.parametrize("divisor", [1, 5])
@pytest.mark.parametrize("mode", ["ignore", "background"])
def test_masked_views_equal_the_definition(make_field: FieldMaker, mode: str, divisor: int) -> None:
    """About half of each view is left out in blocks; masks may come packed."""
    arrays, cameras = random_arrays(300), cameras_around(5)
    rng = np.random.default_rng(0)
    height, width = 50 // divisor, 50 // divisor
    masks = [np.kron(b, np.ones((height, width), bool)) for b in rng.random((5, 6, 8)) < 0.5]
    points = np.concatenate([query_points(arrays, 400, 0.01), rng.normal(size=(700, 3))])
    plain = make_field(arrays, cameras, near_z=0.2)
    each = np.stack([plain.transmittance(points, c) for c in range(5)])  # (5, n)
    for c in range(5):
        each[c, is_masked(cameras[c], masks[c], points)] = np.nan if mode == "ignore" else 1.0
    seen = ~np.isnan(each).all(0)
    expected = np.where(seen, np.where(np.isnan(each), -1.0, each).max(0), np.nan)
    options = {"near_z": 0.2, "mask_mode": mode, "unseen": "invalid"}
    field = make_field(arrays, cameras, masks=masks, **options)
    result = field.vacancy(points)
    np.testing.assert_array_equal(result.camera >= 0, seen)
    np.testing.assert_array_equal(np.isnan(result.vacancy), ~seen)
    resolved = seen & (expected <= SETTLED)
    assert resolved.sum() > 20
    np.testing.assert_array_equal(result.vacancy[resolved], expected[resolved].astype(np.float32))
    assert (result.vacancy[seen & ~resolved] > SETTLED).all()
    assert field.unseen_evaluations == (~seen).sum()
    assert (mode == "ignore") == bool((~seen).sum() > 50)
    np.testing.assert_array_equal(field.is_empty(points), ~(result.vacancy <= 0.5))
    np.testing.assert_array_equal(field.transmittance(points, 2), each[2])
    packed = [PackedMask.of(mask) for mask in masks]
    again = make_field(arrays, cameras, masks=packed, **options).vacancy(points)
    np.testing.assert_array_equal(again.vacancy, result.vacancy)


@pytest.mark.parametrize("width", [1, 8, 9])
def test_a_packed_mask_takes_a_bit_a_pixel_and_is_the_same(width: int) -> None:
    mask = np.random.default_rng(width).random((5, width)) < 0.5
    packed = PackedMask.of(mask)
    assert packed is not None
    assert packed.shape == mask.shape
    assert packed.bits.nbytes == 5 * -(-width // 8)
    np.testing.assert_array_equal(packed.unpacked(), mask)
    assert PackedMask.of(None) is None


def test_background_of_one_photo_empties_what_others_find_solid() -> None:
    arrays, cameras, middle = shell_arrays(0.95), cameras_around(4), np.zeros((1, 3))
    full = [np.ones((7, 9), bool), None, np.ones((300, 400), bool), None]
    for masks in (None, full):
        assert VacancyField(arrays, cameras, masks=masks).vacancy(middle).vacancy[0] < 0.1
    nothing = np.zeros((30, 40), bool)
    for masks in ([None, nothing, None, None], [None, None, None, nothing]):
        field = VacancyField(arrays, cameras, masks=masks, mask_mode="background")
        assert field.vacancy(middle).vacancy[0] == 1.0
        assert field.is_empty(middle)[0]
        ignoring = VacancyField(arrays, cameras, masks=masks)
        assert ignoring.vacancy(middle).vacancy[0] < 0.1


def relative(value: float, exact: mpmath.mpf) -> float:
    return float(abs((mpmath.mpf(float(value)) - exact) / exact))


def log_opacity(logit: float) -> np.float64:
    """Return the model's log opacity of a Gaussian without filter."""
    one = OrientedGaussians(
        *(torch.zeros((1, *shape), dtype=torch.float64) for shape in ((3,), (3,), (4,))),
        torch.tensor([logit], dtype=torch.float64),
        *(torch.zeros((1, *shape), dtype=torch.float64) for shape in ((1, 3), (4,), ())),
    )
    return np.float64(one.log_opacities().item())


@pytest.mark.parametrize("logit", [-30.0, -0.7, 0.0, 8.0, 20.0, 40.0])
@pytest.mark.parametrize("q", [0.0, 1e-18, 1e-3, 1.3862943611198906, 30.0, 200.0])
def test_forms_keep_all_digits(logit: float, q: float) -> None:
    with mpmath.workdps(160):
        log_alpha = -mpmath.log(1 + mpmath.exp(-mpmath.mpf(logit)))
        log_g = log_alpha - mpmath.mpf(q) / 2
        mine_alpha = log_opacity(logit)
        mine_g = log_gaussian(mine_alpha, np.float64(q))
        assert relative(mine_alpha, log_alpha) < 4e-15
        assert relative(mine_g, log_g) < 4e-15
        # exp magnifies the rounding of log G by its size, which reaches 130 here.
        allowed = 4e-15 * (2.0 + abs(float(log_g)))
        assert relative(log_one_minus(mine_g), mpmath.log(1 - mpmath.exp(log_g))) < allowed


def test_limits_are_infinite_or_zero_not_nan() -> None:
    assert log_one_minus(np.float64(0.0)) == -np.inf
    assert log_one_minus(np.float64(-2000.0)) == 0.0
    assert log_opacity(-1e4) == -1e4
    assert log_opacity(1e4) == 0.0

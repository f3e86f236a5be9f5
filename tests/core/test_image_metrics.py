# SPDX-License-Identifier: GPL-3.0-or-later
"""PSNR, SSIM and grey levels against definitions; LPIPS by its package."""

from __future__ import annotations

import importlib.machinery
import math
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.image_metrics import (
    BLOCK_PX,
    PSNR_CAP_DB,
    Lpips,
    compare,
    corrected_for_measuring,
    fit_exposure,
    lpips_if_ready,
    lpips_ready,
    psnr,
    score_images,
    ssim,
)
from gaussian_wrapping_addon.core.resampling import LUMA, grey_of
from gaussian_wrapping_addon.core.training.exposure import SRGB_PEDESTAL
from tests.synthetic import textured


def images(height: int = 19, width: int = 23, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    photo = random.uniform(0, 1, (height, width, 3))
    return np.clip(photo + 0.2 * random.normal(size=photo.shape), 0, 1), photo


def naive_ssim(image: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None) -> float:
    """SSIM by its definition, window by window."""
    axis = np.arange(11) - 5
    window = np.exp(-(axis[:, None] ** 2 + axis[None] ** 2) / (2 * 1.5**2))
    window = (window / window.sum())[..., None]
    if mask is not None:
        image, photo = image * mask[..., None], photo * mask[..., None]
    found = []
    for i in range(image.shape[0] - 10):
        for j in range(image.shape[1] - 10):
            if mask is not None and not mask[i + 5, j + 5]:
                continue
            x, y = image[i : i + 11, j : j + 11], photo[i : i + 11, j : j + 11]
            mx, my = (window * x).sum((0, 1)), (window * y).sum((0, 1))
            vx = (window * (x - mx) ** 2).sum((0, 1))
            vy = (window * (y - my) ** 2).sum((0, 1))
            cov = (window * (x - mx) * (y - my)).sum((0, 1))
            c1, c2 = 0.01**2, 0.03**2
            found.append(
                (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
            )
    return float(np.mean(found))


def test_psnr_is_its_definition() -> None:
    image, photo = images()
    assert psnr(image, photo) == pytest.approx(-10 * math.log10(((image - photo) ** 2).mean()))
    assert psnr(photo, photo) == math.inf
    mask = np.zeros(photo.shape[:2], bool)
    mask[3:7, 2:9] = True
    error = ((image - photo)[3:7, 2:9] ** 2).mean()
    assert psnr(image, photo, mask) == pytest.approx(-10 * math.log10(error))
    # 8-bit photos and floats agree; what a display cannot show is clamped.
    bytes_photo = np.round(255 * photo).astype(np.uint8)
    assert psnr(image, bytes_photo) == pytest.approx(psnr(image, bytes_photo / 255.0))
    assert psnr(np.full((4, 4, 3), 1.5), np.ones((4, 4, 3))) == math.inf


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("masked", [False, True])
def test_ssim_is_its_definition(masked: bool, threads: int) -> None:
    image, photo = images()
    mask = np.random.default_rng(1).uniform(size=photo.shape[:2]) < 0.6 if masked else None
    wanted = naive_ssim(image, photo, mask)
    assert ssim(image, photo, mask, threads=threads) == pytest.approx(wanted, abs=1e-12)
    narrow = compare(image.astype(np.float32), photo.astype(np.float32), mask, threads=threads)
    assert narrow.similarity == pytest.approx(wanted, abs=2e-6)


@pytest.mark.parametrize("masked", [False, True])
def test_errors_are_their_definition(masked: bool) -> None:
    image, photo = images()
    mask = np.random.default_rng(1).uniform(size=photo.shape[:2]) < 0.6 if masked else None
    shown = np.round(255 * photo).astype(np.uint8)
    difference = (image - shown / 255.0)[np.ones(photo.shape[:2], bool) if mask is None else mask]
    found = compare(image, shown, mask)
    assert found.absolute == pytest.approx(np.abs(difference).mean(), rel=1e-12)
    assert found.squared == pytest.approx((difference**2).mean(), rel=1e-12)
    assert found.gradient is None
    as_floats = compare(image, shown / 255.0, mask)
    assert found.similarity == pytest.approx(as_floats.similarity, rel=1e-12)


@pytest.mark.parametrize("masked", [False, True])
def test_gradient_of_a_comparison_against_central_differences(masked: bool) -> None:
    image, photo = images(15, 14)
    mask = np.random.default_rng(2).uniform(size=photo.shape[:2]) < 0.7 if masked else None
    gradient = compare(image, photo, mask, weights=(0.3, 2.0)).gradient
    assert gradient is not None
    step = 1e-6
    numeric = np.zeros_like(image)
    for index in np.ndindex(image.shape):
        values = []
        for sign in (1, -1):
            moved = image.copy()
            moved[index] += sign * step
            found = compare(moved, photo, mask)
            values.append(0.3 * found.absolute + 2.0 * found.similarity)
        numeric[index] = (values[0] - values[1]) / (2 * step)
    # The absolute error has a corner at 0, where a difference of steps says nothing.
    smooth = np.abs(image - photo) > 2 * step
    assert smooth.mean() > 0.8
    assert np.abs(gradient - numeric)[smooth].max() < 1e-6 * np.abs(numeric).max()
    assert np.abs(gradient).max() > 1e-4
    if mask is not None:
        assert not gradient[~mask].any()


def test_blocks_of_columns_are_seamless() -> None:
    # Wider than two blocks: an image of periodic columns has a periodic gradient.
    random = np.random.default_rng(3)
    period, width = 64, 2 * BLOCK_PX + 32
    tiles = random.uniform(0, 1, (2, 17, period, 3))
    image, photo = (np.tile(tile, (1, width // period + 1, 1))[:, :width] for tile in tiles)
    found = compare(image, photo, weights=(0.0, 1.0))
    assert found.similarity == pytest.approx(naive_ssim(image, photo), abs=1e-12)
    inner = found.gradient[:, 10 : width - 10]
    repeated = np.abs(inner[:, period:] - inner[:, :-period])
    assert repeated.max() < 1e-12 * np.abs(inner).max()


def test_single_precision_is_close() -> None:
    # Smooth photos with flat and dark parts: where variances are small, cancellation is worst.
    random = np.random.default_rng(4)
    i, j = np.mgrid[0:90, 0:120] / 30.0
    photo = np.stack([np.sin(i) * np.cos(j), np.minimum(i / 3, 1), np.full_like(i, 0.02)], 2)
    photo = np.clip(photo, 0, 1)
    image = np.clip(photo + 0.03 * random.normal(size=photo.shape), 0, 1).astype(np.float32)
    photo = photo.astype(np.float32)
    exact = compare(image.astype(float), photo.astype(float), weights=(0.8, -0.2))
    narrow = compare(image, photo, weights=(0.8, -0.2))
    assert abs(narrow.similarity - exact.similarity) < 2e-6
    assert abs(narrow.absolute / exact.absolute - 1) < 1e-6
    error = np.linalg.norm(narrow.gradient - exact.gradient) / np.linalg.norm(exact.gradient)
    assert error < 2e-5


@pytest.mark.parametrize("size", [(40, 37), (11, 11), (23, 530)])
def test_result_does_not_depend_on_threads(size: tuple[int, int]) -> None:
    image, photo = (x.astype(np.float32) for x in images(*size))
    mask = np.random.default_rng(5).uniform(size=size) < 0.8
    one, *others = (
        compare(image, photo, mask, weights=(0.8, -0.2), threads=threads) for threads in (1, 2, 5)
    )
    for other in others:
        assert one.similarity == other.similarity
        assert one.absolute == other.absolute
        assert np.array_equal(one.gradient, other.gradient)


def test_images_smaller_than_the_window_have_no_windows() -> None:
    image, photo = images(10, 40)
    found = compare(image, photo, weights=(1.0, 1.0))
    assert (found.similarity, found.windows) == (1.0, 0)
    assert np.array_equal(found.gradient, np.sign(image - photo) / image.size)


def test_wrong_shapes_and_empty_masks_are_refused() -> None:
    image, photo = images()
    with pytest.raises(UsageError):
        psnr(image[:5], photo)
    with pytest.raises(UsageError):
        psnr(image, photo, np.zeros(photo.shape[:2], bool))
    with pytest.raises(UsageError):
        ssim(image, photo, np.ones((3, 3), bool))


class MeanDifference:
    """Stands for LPIPS: shows which pixels a distance is given."""

    @staticmethod
    def fits(shape: tuple[int, ...]) -> bool:
        return min(shape[:2]) > 12

    @staticmethod
    def distance(image: np.ndarray, photo: np.ndarray) -> float:
        return float(np.abs(image - photo).mean())


def test_all_figures_of_an_image_at_once() -> None:
    image, photo = images()
    mask = np.random.default_rng(1).uniform(size=photo.shape[:2]) < 0.6
    for part in (None, mask):
        scores = score_images(image, photo, part, lpips=MeanDifference())
        assert (scores.psnr, scores.ssim) == (psnr(image, photo, part), ssim(image, photo, part))
        counted = np.ones_like(mask) if part is None else part
        expected = np.abs(image - photo)[counted].sum() / photo.size
        assert scores.lpips == pytest.approx(expected, rel=1e-5)
        assert set(scores.to_json()) == {"psnr", "ssim", "lpips"}
    assert set(score_images(image, photo).to_json()) == {"psnr", "ssim"}
    assert score_images(image[:12], photo[:12], lpips=MeanDifference()).lpips is None
    equal = score_images(photo, photo)
    assert (equal.psnr, equal.ssim) == (PSNR_CAP_DB, pytest.approx(1.0))
    with pytest.raises(UsageError):
        score_images(image, photo, np.zeros(photo.shape[:2], bool))


def test_grey_levels_of_the_primaries_and_of_white() -> None:
    colors = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    grey = grey_of(colors)
    assert grey.dtype == np.float32
    assert grey == pytest.approx(np.array([[76.245, 149.685], [29.07, 255.0]]), rel=1e-6)
    assert sum(LUMA) == pytest.approx(1.0)


class Network:
    """Mean distance of what the package's network gets; as the package, it wants [-1, 1]."""

    def __init__(self, **keywords: Any) -> None:
        assert keywords == {"net": "alex", "version": "0.1", "verbose": False}

    def eval(self) -> Network:
        return self

    def __call__(self, a: torch.Tensor, b: torch.Tensor, normalize: bool) -> torch.Tensor:
        assert normalize  # of [0, 1]
        assert a.shape == b.shape == (1, 3, 40, 52)
        return (a - b).abs().mean().reshape(1, 1, 1, 1)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Package, torchvision and a file of AlexNet's weights, as they are looked for."""
    modules = [ModuleType(name) for name in ("lpips", "torchvision")]
    for module in modules:
        module.__spec__ = importlib.machinery.ModuleSpec(module.__name__, None)
        monkeypatch.setitem(sys.modules, module.__name__, module)
    modules[0].LPIPS = Network  # type: ignore[attr-defined]
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    (tmp_path / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth").touch()
    return modules[0]


@pytest.mark.usefixtures("installed")
def test_pictures_reach_the_network_in_its_colours() -> None:
    assert lpips_ready() == (True, "")
    metric, reason = lpips_if_ready()
    assert metric is not None
    assert reason == ""
    photo = np.random.default_rng(1).integers(0, 256, (40, 52, 3), dtype=np.uint8)
    assert metric.distance(photo, photo) == 0.0
    floats = photo.astype(np.float32) / 255
    expected = np.abs(floats - np.clip(floats + 0.25, 0, 1)).mean()  # clamped as by a display
    assert metric.distance(floats + 0.25, photo) == pytest.approx(expected, rel=1e-5)
    assert Lpips.fits((31, 31, 3))
    assert not Lpips.fits((30, 90, 3))


@pytest.mark.parametrize("lacking", ["lpips", "torchvision", "alexnet-owt"])
def test_what_is_missing_is_a_reason_not_an_error(
    lacking: str, installed: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, lacking, raising=False)
    monkeypatch.setattr(sys, "meta_path", [])
    if lacking == "alexnet-owt":
        monkeypatch.setenv("TORCH_HOME", str(tmp_path / "elsewhere"))
    ready, reason = lpips_ready()
    assert not ready
    assert lacking in reason
    assert lpips_if_ready() == (None, reason)


def test_a_package_that_fails_is_a_reason_too(
    installed: ModuleType, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(**keywords: Any) -> None:
        raise RuntimeError("operator torchvision::nms does not exist\nmore")

    installed.LPIPS = broken  # type: ignore[attr-defined]
    metric, reason = lpips_if_ready()
    assert metric is None
    assert reason == "LPIPS is not measured: operator torchvision::nms does not exist"
    assert reason in caplog.messages


# -- A render brought to the exposure of a photo --------------------------------------------------


def test_fit_finds_gain_and_offset_beside_outliers_and_masks() -> None:
    render = textured(2, 40, 60)
    gain, offset = np.array([0.8, 1.1, 1.3]), np.array([0.05, -0.02, 0.0])
    photo = gain * render + offset
    mask = np.ones(render.shape[:2], bool)
    mask[:10] = False
    photo[:10] = 0.3  # masked out
    photo[12:15, 5:30] = 0.9  # something else stands there: 6 % of the pixels
    found_gain, found_offset = fit_exposure(render, photo, mask)
    np.testing.assert_allclose(found_gain, gain, atol=0.04)
    np.testing.assert_allclose(found_offset, offset, atol=0.025)
    plain_gain, plain_offset = fit_exposure(render[15:], photo[15:])
    np.testing.assert_allclose(plain_gain, gain, atol=0.03)  # drawn to 1 a little
    np.testing.assert_allclose(plain_gain * 0.4 + plain_offset, gain * 0.4 + offset, atol=2e-3)


def test_fit_of_what_says_nothing_is_neutral() -> None:
    render = textured(1)
    for photo in (np.zeros((24, 31, 3), np.uint8), np.full((24, 31, 3), 255, np.uint8)):
        gain, offset = fit_exposure(render, photo)
        assert gain.tolist() == [1, 1, 1]
        assert offset.tolist() == [0, 0, 0]
    gain, offset = fit_exposure(np.full((24, 31, 3), 0.5), np.full((24, 31, 3), 0.6))
    np.testing.assert_allclose(gain, 1)
    np.testing.assert_allclose(offset, 0.1)


def test_measuring_fits_one_half_and_corrects_the_other() -> None:
    render = textured(4, 40, 60)
    light = np.array([0.8, 1.0, 1.25])
    photo = (render + SRGB_PEDESTAL) * light ** (1 / 2.4) - SRGB_PEDESTAL
    corrected = corrected_for_measuring(render, photo)
    assert psnr(corrected, photo) > psnr(render, photo) + 10
    # What a half shows does not change how that half is corrected.
    other = photo.copy()
    other[:, :30] = textured(9, 40, 30)
    again = corrected_for_measuring(render, other)
    assert np.array_equal(again[:, :30], corrected[:, :30])
    assert not np.array_equal(again[:, 30:], corrected[:, 30:])
    # Pixels that lie in one half of the image are parted in their own middle.
    mask = np.zeros((40, 60), bool)
    mask[5:35, 35:55] = True
    corrected = corrected_for_measuring(render, photo, mask)
    assert psnr(corrected, photo, mask) > psnr(render, photo, mask) + 10

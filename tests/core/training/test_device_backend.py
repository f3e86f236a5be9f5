# SPDX-License-Identifier: GPL-3.0-or-later
"""The backend of a GPU: choice, photos, iterations."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import DeviceError
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training import device_backend, start
from gaussian_wrapping_addon.core.training.backend import Window, counts_of
from gaussian_wrapping_addon.core.training.cpu_backend import CpuBackend
from gaussian_wrapping_addon.core.training.device_backend import (
    DeviceBackend,
    DevicePhotos,
    chosen_backend,
)
from gaussian_wrapping_addon.core.training.trainer import train
from tests.core.device_kernels import DEVICES
from tests.core.training.device_training import backend_of, perturbed_sphere
from tests.core.training.small_scene import PhotosInMemory, sphere_scene
from tests.proofs import first_then_proofs

# -- A training on a device, emulated or a GPU, comes to where that of the processor comes --------

ITERATIONS = 50

SETTINGS = TrainingSettings(
    iterations=ITERATIONS, max_gaussians=200, max_image_px=32, sh_degree=1, densify_every=10,
    wrap_rounds=2, multi_view="on", multi_view_pixels=150, depth_from=0.1, orient_from=0.3,
    wrap_from=0.5, wrap_until=0.7, checkpoint_every_s=1e9, dense_start="off", exposure="on",
    refine_poses="on", lambda_geometric=0.0,
)  # fmt: skip

# Without the geometric multi-view term: where views agree to a few millionths of a pixel, the
# direction of its gradient is rounding (test_gradients_in_training.py).

LOSS = 1e-3
"""Share by which the losses of two runs may differ after :data:`ITERATIONS` iterations. Found on
the emulator, in ten runs: up to 5.3e-6."""


@pytest.mark.parametrize(("seed", "word"), first_then_proofs([(1, "on"), (2, "auto")], names=2))
@pytest.mark.parametrize("device", DEVICES)
def test_fifty_iterations_come_to_the_same_end(
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    device: str,
    seed: int,
    word: str,
    tmp_path: Path,
) -> None:
    scene, photos = sphere_scene(views=30, size_px=24)
    # Round Gaussians of one colour, as at the start of a training, have gradients of 1e-10 on
    # turns and the like, whose sign is rounding, and Adam's first step is as large for any.
    monkeypatch.setattr(start, "initial_gaussians", lambda *_, **__: perturbed_sphere(120, seed))
    settings = dataclasses.replace(SETTINGS, harmonics=word, wrapping=word, growth=word)
    results = []
    for name, backend in (("cpu", None), ("device", backend_of(device, request))):
        (tmp_path / name).mkdir()
        result = train(
            scene, photos, settings, tmp_path / name, Progress(), seed=seed, threads=1,
            backend=backend,
        )  # fmt: skip
        results.append(result)
    wanted, found = results
    assert (wanted.device, found.device) == ("cpu", "cuda:0" if device == "cuda" else "emulated")
    assert not found.warnings
    assert len(found.gaussians) == len(wanted.gaussians)
    assert len(found.gaussians) > 160
    a, b = (result.history[-1] for result in results)
    assert b["loss"] == pytest.approx(a["loss"], rel=LOSS)
    assert b["psnr"] == pytest.approx(a["psnr"], abs=0.01)
    assert found.held_out_psnr == pytest.approx(wanted.held_out_psnr, abs=0.02)
    assert [(d.name, d.chosen) for d in found.model_selection] == [
        (d.name, d.chosen) for d in wanted.model_selection
    ]
    assert found.poses is not None
    assert wanted.poses is not None
    assert np.abs(found.poses - wanted.poses).max() < 1e-3
    assert (found.gaussians.means - wanted.gaussians.means).abs().max() < 1e-2


# -- Photos kept on a device: the bytes they take, whose they are, and windows of them ------------

HOST = torch.device("cpu")
SIDE = 32
PHOTO_BYTES = 3 * SIDE * SIDE
MASK_BYTES = SIDE * SIDE


class Source(PhotosInMemory):
    """Photos that count how often each one is read."""

    def __init__(self, *, masks: bool = False) -> None:
        scene, photos = sphere_scene(views=9, size_px=SIDE)
        mask = np.zeros((SIDE, SIDE), bool)
        mask[3:20, 5:] = True
        super().__init__(scene, photos.photos, [mask] * 9 if masks else None)
        self.read: list[tuple[int, int]] = []

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        self.read.append((index, divisor))
        return super().photo(index, divisor)


@pytest.mark.parametrize("masks", [False, True])
@pytest.mark.parametrize("window", [None, Window(6, 8, 17, 14)])
@pytest.mark.parametrize("divisor", [1, 2])
def test_shows_what_the_processor_shows(window: Window | None, masks: bool, divisor: int) -> None:
    if window is not None and divisor == 2:
        window = Window(2, 3, 12, 13)
    source = Source(masks=masks)
    wanted = CpuBackend(1).shown(source, 4, divisor, window)
    kept = DevicePhotos(HOST, 1 << 20)
    for _ in range(2):
        found = kept.shown(source, 4, divisor, window)
        assert found.photo.is_contiguous()
        assert np.array_equal(found.photo.numpy(), wanted.photo)
        assert (found.mask is None) == (wanted.mask is None) == (not masks)
        if masks:
            assert found.mask.is_contiguous()
            assert np.array_equal(found.mask.numpy(), wanted.mask)
        assert (found.pixels, found.windows) == (wanted.pixels, wanted.windows)


def test_windows_are_of_the_one_photo_that_is_kept() -> None:
    source, kept = Source(), DevicePhotos(HOST, 1 << 20)
    for window in (Window(0, 0, 20, 20), Window(12, 12, 20, 20), None):
        kept.shown(source, 1, 1, window)
    kept.shown(source, 1, 2, None)
    assert source.read == [(1, 1), (1, 2)]
    assert kept.bytes_held == PHOTO_BYTES + PHOTO_BYTES // 4


def test_the_photos_not_used_for_longest_go_first() -> None:
    source, kept = Source(masks=True), DevicePhotos(HOST, 3 * (PHOTO_BYTES + MASK_BYTES))
    for view in (0, 1, 2, 0, 3, 0, 2, 1):
        kept.shown(source, view, 1, None)
        assert kept.bytes_held <= kept.limit_bytes
    # 3 takes the place of 1, as 0 was used after it.
    assert [view for view, _ in source.read] == [0, 1, 2, 3, 1]
    assert kept.bytes_held == 3 * (PHOTO_BYTES + MASK_BYTES)


def test_the_photo_in_use_is_kept_whatever_its_size() -> None:
    source, kept = Source(), DevicePhotos(HOST, 10)
    for view in (0, 0, 1, 1, 0):
        assert np.array_equal(kept.shown(source, view, 1, None).photo.numpy(), source.photos[view])
        assert kept.bytes_held == PHOTO_BYTES
    assert [view for view, _ in source.read] == [0, 1, 0]


def test_photos_of_another_source_are_others() -> None:
    first, second = Source(), Source()
    second.photos = [255 - photo for photo in second.photos]
    kept = DevicePhotos(HOST, 1 << 20)
    kept.shown(first, 0, 1, None)
    kept.shown(first, 1, 1, None)
    found = kept.shown(second, 0, 1, None)
    assert np.array_equal(found.photo.numpy(), second.photos[0])
    assert kept.bytes_held == PHOTO_BYTES


def test_dropped_photos_are_read_again() -> None:
    source, kept = Source(), DevicePhotos(HOST, 1 << 20)
    kept.shown(source, 0, 1, None)
    kept.clear()
    assert kept.bytes_held == 0
    kept.shown(source, 0, 1, None)
    assert len(source.read) == 2


def test_what_is_kept_is_a_copy() -> None:
    source, kept = Source(), DevicePhotos(HOST, 1 << 20)
    pixels = source.photo(0)
    source.photo = lambda index, divisor=1: pixels  # type: ignore[method-assign]
    found = kept.shown(source, 0, 1, None).photo
    before = pixels.copy()
    pixels[:] = 0
    assert np.array_equal(found.numpy(), before)


def test_windows_that_a_mask_leaves() -> None:
    mask = np.zeros((20, 30), bool)
    mask[4:8, 10:] = True
    assert counts_of(None, 20, 30) == (600, 10 * 20)
    assert counts_of(mask, 20, 30) == (80, 3 * 15)
    assert counts_of(mask[:10], 10, 30) == (80, 0), "no window of 11 pixels fits"
    assert counts_of(None, 10, 30) == (300, 0)


# -- The backend of a chosen device ---------------------------------------------------------------


def test_the_processor_needs_no_kernels_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    name = device_backend.__name__
    monkeypatch.setitem(sys.modules, name, None)  # importing it raises
    found = chosen_backend("cpu", 3)
    assert isinstance(found, CpuBackend)
    assert (found.name, found.threads) == ("cpu", 3)


@pytest.mark.parametrize(("device", "index"), [("cuda", 0), ("cuda:0", 0), ("cuda:2", 2)])
def test_a_gpu_by_its_number(device: str, index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(DeviceBackend, "of_gpu", asked.append)
    chosen_backend(device, 1)
    assert asked == [index]


def test_a_gpu_that_cannot_be_used_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(index: int) -> None:
        raise DeviceError("No NVRTC library was found.")

    monkeypatch.setattr(device_backend, "device_kernels", missing)
    with pytest.raises(DeviceError, match="NVRTC"):
        chosen_backend("cuda:0", 1)


@pytest.mark.gpu
def test_the_gpu_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    if not torch.cuda.is_available():
        pytest.skip("There is no GPU.")
    found = chosen_backend("cuda:0", 1)
    assert isinstance(found, DeviceBackend)
    assert (found.name, found.device) == ("cuda:0", torch.device("cuda", 0))

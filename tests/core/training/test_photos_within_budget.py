# SPDX-License-Identifier: GPL-3.0-or-later
"""Training on photos that do not fit into memory: the same Gaussians, and memory stays bounded."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.photos import store as decoded_file
from gaussian_wrapping_addon.core.photos.store import PhotoStore
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.scene import Scene, View
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training.trainer import train
from gaussian_wrapping_addon.core.worker.helper_process import own_peak_bytes
from tests.core.training.small_scene import ring_cameras, sphere_scene

SETTINGS = TrainingSettings(
    iterations=40, max_gaussians=400, max_image_px=48, sh_degree=1, densify_every=5,
    wrap_rounds=2, checkpoint_every_s=1e9, multi_view="on", coarse_to_fine="on",
    mask_mode="background", full_size="on", pixels_per_iteration=1500,
)  # fmt: skip


def scene_in_files(folder: Path) -> Scene:
    """Return the small scene with its photos, and masks of some, in files."""
    scene, photos = sphere_scene(views=12, size_px=64)
    views = []
    for index, view in enumerate(scene.views):
        path, mask_path = folder / view.camera.name, None
        Image.fromarray(photos.photo(index)).save(path)
        if index % 2:
            mask_path = folder / f"{index}_mask.png"
            mask = photos.photo(index).max(2) > 0
            Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(mask_path)
        views.append(View(view.camera, path, mask_path))
    return dataclasses.replace(scene, views=tuple(views))


def assert_same(a: OrientedGaussians, b: OrientedGaussians) -> None:
    for name, tensor in a.tensors():
        assert torch.equal(tensor, getattr(b, name)), name


@pytest.mark.parametrize("start", ["on", "off"])
def test_gaussians_are_the_same_whatever_the_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: str
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    scene, settings = scene_in_files(photos), dataclasses.replace(SETTINGS, dense_start=start)
    opened = []
    found = {}
    begin = decoded_file.DecodedFile.add

    def add(self: decoded_file.DecodedFile, *arguments: object) -> None:
        begin(self, *arguments)  # type: ignore[arg-type]
        opened.append(self)

    monkeypatch.setattr(decoded_file.DecodedFile, "add", add)
    for name, budget in (("all", 10**9), ("some", 20_000), ("none", 0)):
        folder = tmp_path / name
        folder.mkdir()
        opened.clear()
        store = PhotoStore(scene, 48, memory_bytes=budget)
        result = train(scene, store, settings, folder, Progress(), seed=3, threads=1)
        found[name] = (result.gaussians, result.held_out)
        assert bool(opened) == (name != "all")
        assert {file.get(("photo", 0, 1)) is None for file in opened} <= {True}  # closed
    for name in ("some", "none"):
        assert_same(found["all"][0], found[name][0])
        assert found["all"][1] == found[name][1]


WIDTH_PX, HEIGHT_PX = 1600, 1200
DECODED_BYTES = 3 * WIDTH_PX * HEIGHT_PX


def child(folder: str, count: int) -> None:
    """Train on so many photos and print the peak of this process, bytes."""
    cameras = [
        dataclasses.replace(camera, height=HEIGHT_PX, cy=HEIGHT_PX / 2)
        for camera in ring_cameras(count, WIDTH_PX)
    ]
    views = tuple(View(camera, Path(folder, camera.name)) for camera in cameras)
    scene = dataclasses.replace(sphere_scene(views=3, size_px=8)[0], views=views)
    settings = dataclasses.replace(
        SETTINGS, iterations=count, max_image_px=WIDTH_PX, dense_start="off",
        mask_mode="ignore", preview_every_s=0.0, growth="off", wrapping="off", harmonics="off",
        holdout_every=0, prune_share=0.0,
    )  # fmt: skip
    results = Path(folder, f"results-{count}")
    results.mkdir()
    store = PhotoStore(scene, WIDTH_PX, memory_bytes=2 * DECODED_BYTES)
    train(scene, store, settings, results, Progress(), threads=1)
    print(own_peak_bytes())


@pytest.mark.proof
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="peaks of Linux")
def test_memory_does_not_grow_with_the_photos(tmp_path: Path) -> None:
    first = tmp_path / "000.png"
    Image.new("RGB", (WIDTH_PX, HEIGHT_PX), (90, 120, 60)).save(first)
    for number in range(1, 40):
        os.link(first, tmp_path / f"{number:03d}.png")
    peaks = []
    for count in (8, 40):
        code = f"from {__name__} import child; child({str(tmp_path)!r}, {count})"
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=Path(__file__).resolve().parents[3],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        peaks.append(int(done.stdout.split()[-1]))
    # 32 photos more are 176 MiB; peaks of the same run differ by 30 MiB.
    assert peaks[1] - peaks[0] < 10 * DECODED_BYTES

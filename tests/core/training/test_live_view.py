# SPDX-License-Identifier: GPL-3.0-or-later
"""Live view: previews when due, their content, reproducible measurements."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.gaussians.preview_points import (
    POINTS_FILE,
    VISIBLE_OPACITY,
    parse_points,
)
from gaussian_wrapping_addon.core.image_metrics import psnr
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.reference import render_reference
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.settings import TrainingSettings
from gaussian_wrapping_addon.core.training import live_view
from gaussian_wrapping_addon.core.training.live_view import (
    GAP_PX,
    PIXELS_FILE,
    PREVIEW_FILE,
    LiveView,
    measure_held_out,
)
from gaussian_wrapping_addon.core.training.state import CancellablePhotos, cancellable
from tests.core.training.small_scene import PhotosInMemory, sphere_gaussians, sphere_scene

SETTINGS = TrainingSettings(preview_every_s=10.0)


def test_looks_only_when_due_and_writes_photo_and_render(tmp_path: Path) -> None:
    _, photos = sphere_scene()
    gaussians = sphere_gaussians(60)
    now_s = 100.0
    live = LiveView(photos, [0, 4, 8], tmp_path, SETTINGS, 1, clock=lambda: now_s)
    now_s = 109.9
    assert live.update(gaussians, 3) is None
    assert list(tmp_path.iterdir()) == []
    now_s = 110.0
    figures = live.update(gaussians, 7)
    expected = measure_held_out(gaussians, photos, [0, 4, 8], threads=2)
    assert figures == {"held_out_psnr": expected, "held_out_iteration": 7.0}
    assert live.update(gaussians, 8) is None
    now_s = 120.0
    assert live.update(gaussians, 9) is not None
    assert {path.name for path in tmp_path.iterdir()} == {PREVIEW_FILE, PIXELS_FILE, POINTS_FILE}
    positions, _ = parse_points((tmp_path / POINTS_FILE).read_bytes())
    opaque = 1 / (1 + np.exp(-gaussians.opacity_logits.numpy())) > VISIBLE_OPACITY
    assert (positions == gaussians.means.numpy()[opaque].astype(np.float32)).all()
    picture = np.asarray(Image.open(tmp_path / PREVIEW_FILE))
    assert (np.load(tmp_path / PIXELS_FILE, allow_pickle=False) == picture).all()
    width = photos.camera(4).width
    assert picture.shape == (photos.camera(4).height, 2 * width + GAP_PX, 3)
    assert (picture[:, :width] == photos.photo(4)).all()
    image = render_reference(gaussians, photos.camera(4), RenderOptions(depth=False)).color
    wanted = 255.0 * np.clip(image.numpy(), 0.0, 1.0)
    assert np.abs(picture[:, -width:] - wanted).max() <= 1.0


def test_a_large_photo_becomes_a_picture_of_at_most_640_px(tmp_path: Path) -> None:
    scene, _ = sphere_scene()
    views = tuple(replace(v, camera=v.camera.resized(2000, 1500)) for v in scene.views)
    large = PhotosInMemory(
        replace(scene, views=views), [np.zeros((1500, 2000, 3), np.uint8)] * len(views)
    )
    live = LiveView(large, [], tmp_path, SETTINGS, 1, clock=iter([0.0, 10.0, 11.0]).__next__)
    assert live.update(sphere_gaussians(20), 1) == {}
    width, height = Image.open(tmp_path / PREVIEW_FILE).size
    assert 500 < width <= 640
    assert abs((width - GAP_PX) / 2 / height - 2000 / 1500) < 0.02


def test_zero_seconds_never_look(tmp_path: Path) -> None:
    _, photos = sphere_scene()
    never = replace(SETTINGS, preview_every_s=0.0)
    live = LiveView(photos, [0], tmp_path, never, 1, clock=iter([0.0, 1e9]).__next__)
    assert live.update(sphere_gaussians(20), 1) is None


def test_measuring_is_the_mean_over_the_held_out_photos_within_their_masks() -> None:
    scene, photos = sphere_scene()
    masks: list = [None] * len(scene.views)
    masks[0] = np.zeros((32, 32), bool)
    masks[0][8:20, 4:28] = True
    masks[4] = np.zeros((32, 32), bool)  # leaves nothing: counts nowhere
    masked = PhotosInMemory(scene, photos.photos, masks)
    gaussians = sphere_gaussians(60)
    wanted = []
    for view in (0, 8):
        image = render_reference(gaussians, photos.camera(view), RenderOptions(depth=False)).color
        wanted.append(psnr(image.numpy(), photos.photo(view), masks[view]))
    found = measure_held_out(gaussians, masked, [0, 4, 8], threads=1)
    assert found == pytest.approx(np.mean(wanted), abs=1e-3)
    assert math.isnan(measure_held_out(gaussians, masked, [4], threads=1))
    assert math.isnan(measure_held_out(gaussians, masked, [], threads=1))


def test_a_correction_is_applied_before_measuring(monkeypatch: pytest.MonkeyPatch) -> None:
    _, photos = sphere_scene()

    def perfect(_image: np.ndarray, photo: np.ndarray, _mask: object) -> np.ndarray:
        return photo / 255.0

    monkeypatch.setattr(live_view, "corrected_for_measuring", perfect)
    found = measure_held_out(sphere_gaussians(20), photos, [0, 4], threads=1, exposed=True)
    assert found == 100.0


def test_a_preview_has_one_exposure_and_no_seam(tmp_path: Path) -> None:
    """Halves that differ are each measured in the other's exposure, but not shown so."""
    scene, photos = sphere_scene()
    changed = [photo.copy() for photo in photos.photos]
    width = changed[0].shape[1]
    changed[0][:, : width // 2] //= 3
    gaussians = sphere_gaussians(200)
    live = LiveView(
        PhotosInMemory(scene, changed), [0], tmp_path, SETTINGS, 1,
        clock=iter([0.0, 10.0, 11.0]).__next__,
    )  # fmt: skip
    live.update(gaussians, 1, exposed=True)
    shown = np.load(tmp_path / PIXELS_FILE, allow_pickle=False)[:, -width:] / 255.0
    options = RenderOptions(depth=False)
    image = render_reference(gaussians, photos.camera(0), options).color.numpy()
    inside = (shown > 0.01) & (shown < 0.99)
    for channel in range(3):
        part = inside[..., channel]
        line = np.polynomial.Polynomial.fit(image[part, channel], shown[part, channel], 1)
        assert np.abs(line(image[part, channel]) - shown[part, channel]).max() < 0.01


def test_looking_changes_no_gaussian(tmp_path: Path) -> None:
    _, photos = sphere_scene()
    gaussians = sphere_gaussians(60)
    before = {name: tensor.clone() for name, tensor in gaussians.tensors()}
    live = LiveView(photos, [0], tmp_path, SETTINGS, 1, clock=iter([0.0, 10.0, 11.0]).__next__)
    live.update(gaussians, 1)
    assert all(bool((before[name] == tensor).all()) for name, tensor in gaussians.tensors())


def test_a_full_disk_ends_the_previews_and_not_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_path: Path, _data: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(live_view, "write_bytes", full)
    _, photos = sphere_scene()
    live = LiveView(photos, [0], tmp_path, SETTINGS, 1, clock=iter([0.0, 10.0, 11.0]).__next__)
    assert live.update(sphere_gaussians(20), 1) is not None
    assert live.update(sphere_gaussians(20), 2) is None


def test_cancelling_is_noticed_before_the_next_view_is_rendered() -> None:
    _, photos = sphere_scene()
    rendered: list[int] = []

    class Watched:
        camera = staticmethod(photos.camera)
        mask = staticmethod(photos.mask)

        def photo(self, index: int, divisor: int = 1) -> np.ndarray:
            rendered.append(index)  # asked for after the view was rendered
            return photos.photo(index, divisor)

    progress = Progress(is_cancelled=lambda: len(rendered) >= 2)
    watched = CancellablePhotos(Watched(), progress)
    with pytest.raises(Cancelled):
        measure_held_out(sphere_gaussians(20), watched, [0, 1, 2, 3], threads=1)
    assert rendered == [0, 1]
    assert list(cancellable([1, 2], Progress())) == [1, 2]

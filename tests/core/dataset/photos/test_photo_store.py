# SPDX-License-Identifier: GPL-3.0-or-later
"""Pyramid levels fit their cameras pixel for pixel; memory stays bounded."""

from __future__ import annotations

import threading
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.photos import store as photo_store
from gaussian_wrapping_addon.core.photos.store import PhotoStore
from gaussian_wrapping_addon.core.scene.camera import Camera, Similarity
from gaussian_wrapping_addon.core.scene.scene import Scene, View


def make_scene(folder: Path, count: int = 1, width: int = 101, height: int = 67) -> Scene:
    """Photos of linear ramps: a pixel's value tells where its centre lies."""
    x = (np.arange(width) + 0.5) * (250 / width)
    y = (np.arange(height) + 0.5) * (250 / height)
    pixels = np.zeros((height, width, 3))
    pixels[..., 0] = x
    pixels[..., 1] = y[:, None]
    mask = np.zeros((height, width), np.uint8)
    mask[:, : width // 2] = 255
    views = []
    for i in range(count):
        pixels[..., 2] = i
        Image.fromarray(np.rint(pixels).astype(np.uint8)).save(folder / f"{i}.png")
        Image.fromarray(mask).save(folder / f"{i}_mask.png")
        pose = np.eye(3, 4)
        camera = Camera(f"{i}.png", width, height, 90.0, 91.0, 50.2, 33.1, pose)
        views.append(View(camera, folder / f"{i}.png", folder / f"{i}_mask.png"))
    return Scene(tuple(views), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), Similarity())


@pytest.mark.parametrize("max_image_px", [5000, 101, 64, 40])
@pytest.mark.parametrize("divisor", [1, 2, 3, 4])
def test_levels_show_what_their_camera_sees(
    tmp_path: Path, max_image_px: int, divisor: int
) -> None:
    scene = make_scene(tmp_path)
    store = PhotoStore(scene, max_image_px)
    camera, photo = store.camera(0, divisor), store.photo(0, divisor)
    mask = store.mask(0, divisor)
    assert photo.shape == (camera.height, camera.width, 3)
    assert photo.dtype == np.uint8
    assert max(store.camera(0).width, store.camera(0).height) == min(max_image_px, 101)
    # Pixel centre -> ray -> pixel of the original photo -> the ramp's value there.
    full = scene.views[0].camera
    rays = camera.rays()
    u = rays[..., 0] * full.fx + full.cx
    v = rays[..., 1] * full.fy + full.cy
    inner = (slice(1, -1), slice(1, -1))  # the resampling filter bends a ramp at the border
    np.testing.assert_allclose(photo[..., 0][inner], (u * 250 / 101)[inner], atol=1.6)
    np.testing.assert_allclose(photo[..., 1][inner], (v * 250 / 67)[inner], atol=1.6)
    assert mask is not None
    assert mask.shape == photo.shape[:2]
    assert mask.dtype == bool
    clear = np.abs(u - 50) > 101 / camera.width
    np.testing.assert_array_equal(mask[clear], (u < 50)[clear])


def test_downscaling_averages_and_does_not_alias(tmp_path: Path) -> None:
    board = np.zeros((64, 64, 3), np.uint8)
    board[::2, ::2] = board[1::2, 1::2] = 200
    Image.fromarray(board).save(tmp_path / "b.png")
    camera = Camera("b", 64, 64, 60.0, 60.0, 32.0, 32.0, np.eye(3, 4))
    view = View(camera, tmp_path / "b.png")
    store = PhotoStore(Scene((view,), np.zeros((0, 3)), np.zeros((0, 3)), Similarity()), 64)
    assert np.unique(store.photo(0, 2)).tolist() == [100]
    half = PhotoStore(Scene((view,), np.zeros((0, 3)), np.zeros((0, 3)), Similarity()), 16)
    assert np.abs(half.photo(0).astype(int) - 100).max() <= 3
    assert store.mask(0) is None


def test_memory_stays_bounded_and_results_the_same(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, count=6)
    one_photo = 101 * 67 * 3
    store = PhotoStore(scene, 101, memory_bytes=int(2.5 * one_photo))
    wide = PhotoStore(scene, 101)
    given: list[weakref.ref[np.ndarray]] = []
    for i in [0, 1, 2, 3, 4, 5, 0, 3]:
        for divisor in (1, 2):
            np.testing.assert_array_equal(store.photo(i, divisor), wide.photo(i, divisor))
            assert store.photo(i)[0, 0, 2] == i
            given += [weakref.ref(store.photo(i)), weakref.ref(store.photo(i, divisor))]
            held = {id(photo): photo.nbytes for ref in given if (photo := ref()) is not None}
            photo = None
            # Beyond the limit the photo used last is kept.
            assert one_photo <= sum(held.values()) <= 3.5 * one_photo
    assert store.photo(3) is store.photo(3)
    with pytest.raises(ValueError, match="read-only"):
        store.photo(0)[0, 0, 0] = 1


def test_without_room_photos_are_decoded_once_where_they_may_stay_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene(tmp_path, count=6)
    files = tmp_path / "files"
    files.mkdir()
    read: list[str] = []
    for name in ("read_photo", "read_mask"):
        whole = getattr(photo_store, name)

        def counted(path: Path, whole: Any = whole, **options: Any) -> Any:
            read.append(path.name)
            return whole(path, **options)

        monkeypatch.setattr(photo_store, name, counted)
    wide, store = PhotoStore(scene, 80), PhotoStore(scene, 80, memory_bytes=15_000)
    order = np.random.default_rng(0).integers(0, 6, 60).tolist()

    def ask(of: PhotoStore) -> list[np.ndarray]:
        asked = [(index, 4 if turn < 30 else 1) for turn, index in enumerate(order)]
        return [array for key in asked for array in (of.photo(*key), of.mask(*key))]

    expected = ask(wide)
    assert len(read) == 12
    read.clear()
    with photo_store.decoded_in(store, files):
        for found, true in zip(ask(store), expected, strict=True):
            assert found.dtype == true.dtype
            np.testing.assert_array_equal(found, true)
            assert not found.flags.writeable
        assert len(read) == 12
        assert list(files.iterdir()) == []
    read.clear()
    for found, true in zip(ask(store), expected, strict=True):
        np.testing.assert_array_equal(found, true)
    assert len(read) > 30


def test_many_threads_get_the_same_photos(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, count=4)
    store = PhotoStore(scene, 80, memory_bytes=60_000)
    wrong: list[int] = []

    def work(seed: int) -> None:
        for i in np.random.default_rng(seed).integers(0, 4, 40).tolist():
            if store.photo(i, 2)[0, 0, 2] != i or store.mask(i) is None:
                wrong.append(i)

    threads = [threading.Thread(target=work, args=(s,)) for s in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_changed_photos_are_noticed(tmp_path: Path) -> None:
    store = PhotoStore(make_scene(tmp_path), 50)
    Image.new("RGB", (30, 30)).save(tmp_path / "0.png")
    with pytest.raises(DatasetError, match=r"0\.png is now 30 x 30 pixels, it was 101 x 67"):
        store.photo(0)
    (tmp_path / "0.png").unlink()
    with pytest.raises(DatasetError, match=r"0\.png"):
        store.photo(0)
    with pytest.raises(ValueError, match="divisor 64"):
        store.camera(0, 64)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos in memory and on disk: pyramid levels, what stays, the budget, a disk that fails."""

from __future__ import annotations

import errno
import shutil
import subprocess
import sys
import tempfile
import threading
import weakref
from collections import namedtuple
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import DatasetError
from gaussian_wrapping_addon.core.photos import store as photo_store
from gaussian_wrapping_addon.core.photos.store import (
    DecodedFile,
    KeptPhotos,
    PhotoStore,
    photo_budget_bytes,
    photo_memory,
)
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


@pytest.mark.parametrize("max_image_px", [5000, 64])
@pytest.mark.parametrize("divisor", [1, 2, 3])
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
    assert mask.shape == photo.shape[:2]
    assert mask.dtype == bool
    clear = np.abs(u - 50) > 101 / camera.width
    np.testing.assert_array_equal(mask[clear], (u < 50)[clear])


def test_downscaling_averages_and_does_not_alias(tmp_path: Path) -> None:
    board = np.zeros((64, 64, 3), np.uint8)
    board[::2, ::2] = board[1::2, 1::2] = 200
    Image.fromarray(board).save(tmp_path / "b.png")
    camera = Camera("b", 64, 64, 60.0, 60.0, 32.0, 32.0, np.eye(3, 4))
    nothing = np.zeros((0, 3))
    scene = Scene((View(camera, tmp_path / "b.png"),), nothing, nothing, Similarity())
    store = PhotoStore(scene, 64)
    assert np.unique(store.photo(0, 2)).tolist() == [100]
    assert np.abs(PhotoStore(scene, 16).photo(0).astype(int) - 100).max() <= 3
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


def array(size: int, value: int = 0) -> np.ndarray:
    return np.full(size, value, np.uint8)


def read(kept: KeptPhotos, index: int, divisor: int = 1, size: int = 10) -> bool:
    """Ask for a photo as a store does; tell whether it was there."""
    key = ("photo", index, divisor)
    found = kept.get(key)
    if found is None:
        kept.put(key, array(size, index))
        return False
    assert found[0] == index
    return True


def test_rounds_in_random_order_find_as_many_as_fit() -> None:
    kept, random = KeptPhotos(200), np.random.default_rng(0)
    for turn in range(6):
        found = sum(read(kept, index) for index in random.permutation(40).tolist())
        # Twenty stay; the one used last of the round before may be asked for first.
        assert turn == 0 or 20 <= found <= 21
        assert kept.bytes_kept <= 200


def test_another_size_of_a_photo_makes_room_once_it_is_asked_for() -> None:
    kept = KeptPhotos(100)
    for index in range(10):
        read(kept, index, 2)
    # Four times as large: each needs the room of four of the former size.
    for _ in range(2):
        for index in range(10):
            read(kept, index, 1, size=40)
            assert kept.bytes_kept <= 100
    assert kept.bytes_kept == 80
    assert sum(kept.peek(("photo", index, 1)) is not None for index in range(9)) == 2
    # Asked for again at the former size, which is not outdated any more.
    assert not read(kept, 0, 2)
    assert read(kept, 0, 2)


def test_small_arrays_take_the_place_of_much_larger_ones_but_not_of_like_ones() -> None:
    kept = KeptPhotos(100)
    for index in range(2):
        read(kept, index, size=50)
    read(kept, 2, size=30)
    assert kept.bytes_kept == 100  # 50 is not more than twice as much
    assert kept.peek(("photo", 0, 1)) is not None
    read(kept, 3, size=20)
    assert kept.peek(("photo", 0, 1)) is None  # used longest ago
    assert kept.peek(("photo", 1, 1)) is not None
    assert read(kept, 3, size=20)


def test_the_last_of_each_kind_is_kept_beyond_the_limit() -> None:
    kept = KeptPhotos(5)
    photo, mask = array(10, 1), array(7, 2)
    assert kept.put(("photo", 0, 1), photo)[1] == [(("photo", 0, 1), photo)]
    assert kept.put(("mask", 0, 1), mask)[1] == [(("mask", 0, 1), mask)]
    assert kept.get(("photo", 0, 1)) is photo
    assert kept.get(("mask", 0, 1)) is mask
    kept.put(("photo", 1, 1), photo)
    assert kept.get(("photo", 0, 1)) is None
    assert kept.bytes_kept == 0
    # Two that made the same photo hold one.
    kept = KeptPhotos(100)
    assert kept.put(("photo", 0, 1), photo)[0] is photo
    assert kept.put(("photo", 0, 1), array(10, 1))[0] is photo
    assert kept.bytes_kept == 10


def test_what_nobody_asked_for_takes_nothing_elses_place_and_goes_first() -> None:
    kept = KeptPhotos(100)
    kept.get(("photo", 0, 4))
    assert kept.put_aside(("photo", 0, 1), array(60))
    kept.put(("photo", 0, 4), array(10))
    assert not kept.put_aside(("photo", 1, 1), array(60))
    large = kept.peek(("photo", 0, 1))
    kept.get(("photo", 2, 1))
    assert kept.put(("photo", 2, 1), array(50))[1] == [(("photo", 0, 1), large)]
    assert kept.peek(("photo", 0, 4)) is not None


GIB = 2**30


def test_the_budget_is_a_share_of_what_is_free() -> None:
    assert photo_budget_bytes(0) == limits.UNKNOWN_PHOTO_MEMORY_BYTES
    assert photo_budget_bytes(1) == limits.MIN_PHOTO_MEMORY_BYTES
    assert photo_budget_bytes(8 * GIB) == 2 * GIB
    assert photo_budget_bytes(1000 * GIB) == limits.MAX_PHOTO_MEMORY_BYTES
    few = photo_memory(40, 640 * 480, masked=False, free_bytes=8 * GIB)
    assert few.fits
    assert few.used_bytes == few.all_bytes == 40 * 640 * 480 * 3 * 21 // 16
    many = photo_memory(400, 4000 * 3000, masked=True, free_bytes=8 * GIB)
    assert not many.fits
    assert many.all_bytes == 400 * 4000 * 3000 * 4 * 21 // 16
    assert many.used_bytes == many.budget_bytes == 2 * GIB
    assert many.sentence().startswith(
        "read on demand: 400 of 60.1 MB decoded are 23.47 GB, 2.00 GB"
    )
    # In the panel's row there is room for so many letters.
    most = photo_memory(10**4, 68_000.0, masked=True, free_bytes=1000 * GIB)
    assert most.fits
    assert len(most.sentence()) <= 18


Usage = namedtuple("Usage", "total used free")


def test_arrays_come_back_and_nothing_is_seen_of_the_file(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    photos = {("photo", i, 1): random.integers(0, 256, (5 + i, 7, 3), np.uint8) for i in range(4)}
    masks = {("mask", i, 2): random.random((3, 4 + i)) < 0.5 for i in range(4)}
    file = DecodedFile(tmp_path)
    for key, array in (photos | masks).items():
        file.add(key, array)
        file.add(key, array)
    assert file.bytes_written == sum(array.nbytes for array in (photos | masks).values())
    assert list(tmp_path.iterdir()) == []
    for key, array in (photos | masks).items():
        found = file.get(key)
        assert found.dtype == array.dtype
        np.testing.assert_array_equal(found, array)
    assert file.get(("photo", 9, 1)) is None
    file.close()
    assert file.get(("photo", 0, 1)) is None
    file.add(("photo", 0, 1), photos["photo", 0, 1])
    assert file.get(("photo", 0, 1)) is None


def test_half_of_the_free_disk_is_the_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(1000, 0, 100))
    file = DecodedFile(tmp_path)
    for index in range(4):
        file.add(("photo", index, 1), np.full(20, index, np.uint8))
    found = [file.get(("photo", index, 1)) is not None for index in range(4)]
    assert found == [True, True, False, False]


def test_a_full_disk_gives_the_space_back_and_a_missing_folder_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Full:
        closed = False

        def seek(self, place: int) -> None: ...

        def write(self, data: memoryview) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self) -> None:
            self.closed = True

    def add_three(file: DecodedFile) -> None:
        caplog.clear()
        for index in range(3):
            file.add(("photo", index, 1), np.zeros(10, np.uint8))
        assert len(caplog.records) == 1
        assert file.get(("photo", 0, 1)) is None

    add_three(DecodedFile(tmp_path / "missing"))
    assert not (tmp_path / "missing").exists()
    full = Full()
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: full)
    add_three(DecodedFile(tmp_path))
    assert full.closed
    assert "No space left" in caplog.text


def test_a_file_cut_short_is_not_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    opened = []
    begin = tempfile.TemporaryFile

    def begun(**options: object) -> object:
        opened.append(begin(**options))  # type: ignore[call-overload]
        return opened[-1]

    monkeypatch.setattr(tempfile, "TemporaryFile", begun)
    file = DecodedFile(tmp_path)
    file.add(("photo", 0, 1), np.ones(100, np.uint8))
    opened[0].truncate(50)
    assert file.get(("photo", 0, 1)) is None
    assert "cannot be read" in caplog.text


@pytest.mark.skipif(sys.platform == "win32", reason="the file is removed by Windows itself")
def test_a_killed_process_leaves_nothing(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "import numpy as np\n"
        "from gaussian_wrapping_addon.core.photos.store import DecodedFile\n"
        "file = DecodedFile(Path(sys.argv[1]))\n"
        "file.add(('photo', 0, 1), np.ones(1000, np.uint8))\n"
        "assert file.get(('photo', 0, 1)) is not None\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], cwd=root, check=False)
    assert done.returncode == -9
    assert list(tmp_path.iterdir()) == []

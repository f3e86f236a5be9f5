# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos on disk come back as they were; a disk that fails ends that, and nothing else."""

from __future__ import annotations

import errno
import logging
import shutil
import subprocess
import sys
import tempfile
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.photos.store import DecodedFile

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
        assert found is not None
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
    assert [file.get(("photo", index, 1)) is not None for index in range(4)] == [
        True, True, False, False,
    ]  # fmt: skip


def test_a_full_disk_gives_the_space_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Full:
        closed = False

        def seek(self, place: int) -> None: ...

        def write(self, data: memoryview) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self) -> None:
            self.closed = True

    full = Full()
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: full)
    file = DecodedFile(tmp_path)
    with caplog.at_level(logging.WARNING):
        for index in range(3):
            file.add(("photo", index, 1), np.zeros(10, np.uint8))
    assert full.closed
    assert len(caplog.records) == 1
    assert "No space left" in caplog.text
    assert file.get(("photo", 0, 1)) is None


def test_a_folder_that_is_not_there_is_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = DecodedFile(tmp_path / "missing")
    with caplog.at_level(logging.WARNING):
        for index in range(2):
            file.add(("photo", index, 1), np.zeros(10, np.uint8))
    assert len(caplog.records) == 1
    assert not (tmp_path / "missing").exists()


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
    root = Path(__file__).resolve().parents[4]
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], cwd=root, check=False)
    assert done.returncode == -9
    assert list(tmp_path.iterdir()) == []

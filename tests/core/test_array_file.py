# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of arrays that are cut, changed or made up end in one typed error, with little memory."""

from __future__ import annotations

import contextlib
import io
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.array_file import is_whole, read_arrays, write_arrays
from gaussian_wrapping_addon.core.errors import ParseError


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "arrays.npz"
    np.savez(path, a=np.arange(1000.0), b=np.ones((3, 2), np.int32))
    return path


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def empty(path: Path) -> None:
    os.truncate(path, 0)


def remove(path: Path) -> None:
    path.unlink()


def turn_a_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[400] ^= 1
    path.write_bytes(data)


def leave_an_array_out(path: Path) -> None:
    np.savez(path, b=np.ones(2))


def compress(path: Path) -> None:
    np.savez_compressed(path, a=np.zeros(1_000_000), b=np.ones(2))


def claim_a_terabyte(path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**11, 10)}
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", header.getvalue())
        archive.writestr("b.npy", header.getvalue())


def hold_objects(path: Path) -> None:
    np.savez(path, a=np.array([{"code": 1}], object), b=np.ones(2))


def encrypt(path: Path) -> None:
    data = bytearray(path.read_bytes())
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        start = 0
        while (start := data.find(mark, start)) >= 0:
            data[start + offset] |= 1
            start += 4
    path.write_bytes(data)


DAMAGES = [cut, empty, remove, turn_a_bit, leave_an_array_out, compress, claim_a_terabyte,
           hold_objects, encrypt]  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_a_typed_error(file: Path, damage: Callable[[Path], None]) -> None:
    damage(file)
    with pytest.raises(ParseError, match=r"^arrays\.npz, whole file: .* Make it again\.$"):
        read_arrays(file, ("a", "b"), hint="Make it again.")


@pytest.mark.parametrize("damage", [cut, empty, remove, turn_a_bit, compress, encrypt])
def test_a_damaged_file_is_not_whole(file: Path, damage: Callable[[Path], None]) -> None:
    assert is_whole(file)
    damage(file)
    assert not is_whole(file)


@pytest.mark.filterwarnings("ignore:Reading `.npy`")
@pytest.mark.parametrize("compressed", [False, True])
def test_any_change_is_a_typed_error_or_changes_nothing_that_is_checked(
    file: Path, compressed: bool
) -> None:
    """Changes of the archive, and of the header of an array whose checksum is right."""
    (np.savez_compressed if compressed else np.savez)(file, a=np.arange(4000.0))
    most_bytes = 40_000 if compressed else None
    archive = file.read_bytes()
    stream = io.BytesIO()
    np.save(stream, np.arange(40.0))
    rng = np.random.default_rng(5)
    for number in range(600):
        data = bytearray(stream.getvalue() if number % 2 else archive)
        for _ in range(int(rng.integers(1, 4))):
            place = int(rng.integers(140 if number % 2 else len(data)))
            change = int(rng.integers(3))
            if change == 0:
                data[place] ^= 1 << int(rng.integers(8))
            elif change == 1:
                data[place] = int(rng.choice(list(b"()[]{},':0123456789-<>|OVSUf \n#\"")))
            else:
                del data[place : place + int(rng.integers(1, 9))]
        if number % 2:
            with zipfile.ZipFile(file, "w") as changed:
                changed.writestr("a.npy", bytes(data))
        else:
            file.write_bytes(data)
        with contextlib.suppress(ParseError):
            read_arrays(file, ("a",), most_bytes=most_bytes)
        with contextlib.suppress(ParseError):
            is_whole(file, most_bytes)


def test_what_was_written_is_read(file: Path) -> None:
    arrays = read_arrays(file, ("a", "b"))
    assert np.array_equal(arrays["a"], np.arange(1000.0))
    assert arrays["b"].dtype == np.int32
    assert np.array_equal(arrays["b"], np.ones((3, 2)))


def test_all_arrays_or_those_that_are_there(file: Path) -> None:
    assert sorted(read_arrays(file)) == ["a", "b"]
    assert list(read_arrays(file, ("b",), optional=("a", "c"))) == ["b", "a"]


def test_compressed_entries_are_read_up_to_a_limit(file: Path) -> None:
    compress(file)
    most_bytes = 8_000_000 + 1000
    assert np.array_equal(
        read_arrays(file, ("a",), most_bytes=most_bytes)["a"], np.zeros(1_000_000)
    )
    assert is_whole(file, most_bytes)
    with pytest.raises(ParseError, match="larger than 7999999 bytes"):
        read_arrays(file, ("a",), most_bytes=7_999_999)


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_a_link_is_no_file_of_a_stage(file: Path, tmp_path: Path) -> None:
    link = tmp_path / "link.npz"
    link.symlink_to(file)
    with pytest.raises(ParseError, match="is a link"):
        read_arrays(link, ("a",))


def test_the_limit_counts_what_is_read(file: Path) -> None:
    compress(file)
    assert list(read_arrays(file, ("b",), most_bytes=1000)) == ["b"]


def test_what_is_written_is_what_was_given(tmp_path: Path) -> None:
    given = {"a": np.arange(3), "b": np.ones((2, 2), np.float32)}
    write_arrays(tmp_path / "x.npz", **given)
    with np.load(tmp_path / "x.npz") as stored:
        assert sorted(stored.files) == ["a", "b"]
        assert all((stored[name] == array).all() for name, array in given.items())

# SPDX-License-Identifier: GPL-3.0-or-later
"""Read and write the npz files that stages hand to each other: whole, and of bounded size.

A file may be cut by a full disk or changed by another program, and a job folder may come from
elsewhere: what a header states is compared with what the file holds before memory is taken.
"""

from __future__ import annotations

import io
import math
import os
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from .errors import ParseError
from .files import open_regular, write_bytes

DAMAGES = (
    ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError,
    SyntaxError, tokenize.TokenError,
)  # fmt: skip
"""What zipfile and numpy raise on files that are cut, changed or not theirs. RuntimeError holds
NotImplementedError: an unknown compression, or an encrypted entry. numpy reads the header of an
array as Python text."""

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def write_arrays(path: Path, **arrays: np.ndarray) -> None:
    """Write arrays as ``numpy.savez`` does, atomically. Raises OSError: that failed."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    write_bytes(path, stream.getvalue())


def read_arrays(
    path: Path, names: Iterable[str] | None = None, *, optional: Iterable[str] = (),
    most_bytes: int | None = None, hint: str = "",
) -> dict[str, np.ndarray]:  # fmt: skip
    """Read arrays of a file written by ``numpy.savez``.

    Parameters
    ----------
    path : Path
        The file itself, not a link to it.
    names, optional : iterable of str
        Arrays that it must hold and may hold, the others are not read; without names, all that it
        holds.
    most_bytes : int, optional
        Largest size of those that are read when unpacked; without it compressed entries are
        refused.
    hint : str
        The next step for the user, for the error.

    Raises
    ------
    ParseError
        It is missing, cut, changed, or not of this kind.
    """
    try:
        with open_regular(path) as stream, zipfile.ZipFile(stream) as archive:
            held = [entry.removesuffix(".npy") for entry in archive.namelist()]
            wanted = held if names is None else [*names, *(n for n in optional if n in held)]
            entries = [archive.getinfo(f"{name}.npy") for name in wanted]
            _check_entries(entries, stream, most_bytes)
            return {name: _array(archive, f"{name}.npy") for name in wanted}
    except OSError as error:
        raise ParseError(
            path, "whole file", f"cannot be read ({error.strerror or error}).", hint
        ) from error
    except DAMAGES as error:
        raise ParseError(path, "whole file", f"damaged ({error}).", hint) from None


def is_whole(path: Path, most_bytes: int | None = None) -> bool:
    """Return whether a file of ``numpy.savez`` is there and its checksums are right.

    Reads the whole file, with little memory; ``most_bytes`` as in :func:`read_arrays`.

    Raises
    ------
    ParseError
        It cannot be read, which says nothing about its content; or it is no regular file.
    """
    try:
        with open_regular(path) as stream, zipfile.ZipFile(stream) as archive:
            _check_entries(archive.infolist(), stream, most_bytes)
            return archive.testzip() is None
    except FileNotFoundError:
        return False
    except OSError as error:
        raise ParseError(
            path, "whole file", f"cannot be read ({error.strerror or error}).",
            "Check the disk and the permissions.",
        ) from error  # fmt: skip
    except DAMAGES:
        return False


def _check_entries(
    entries: Sequence[zipfile.ZipInfo], stream: IO[bytes], most_bytes: int | None
) -> None:
    """Raise ValueError where reading these could take more memory or time than allowed."""
    if most_bytes is None:
        most_bytes = os.fstat(stream.fileno()).st_size
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("compressed by another program")
    if sum(entry.file_size for entry in entries) > most_bytes:
        raise ValueError(f"its entries are larger than {most_bytes} bytes")


def _array(archive: zipfile.ZipFile, entry: str) -> np.ndarray:
    size_bytes = archive.getinfo(entry).file_size
    with archive.open(entry) as stream:
        _check_header(stream, size_bytes)
    with archive.open(entry) as stream:
        array: np.ndarray = np.lib.format.read_array(stream, allow_pickle=False)
        stream.read()  # the checksum is compared at the end
    return array


def _check_header(stream: IO[bytes], size_bytes: int) -> None:
    read_header = _HEADERS.get(np.lib.format.read_magic(stream))
    if read_header is None:
        raise ValueError("unknown version of the array format")
    shape, _, dtype = read_header(stream)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize > size_bytes:
        raise ValueError("an array is larger than its entry")

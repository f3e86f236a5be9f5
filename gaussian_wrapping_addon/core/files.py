# SPDX-License-Identifier: GPL-3.0-or-later
"""Atomic file writing, JSON with size limits, and safe relative paths."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import time
import uuid
from pathlib import Path, PurePosixPath
from typing import Any

from . import limits
from .errors import ParseError
from .names import is_reserved_name
from .regular_files import open_regular, read_bounded

_PARTIAL = ".writing."
"""In the names of files that are being written: the target's name, this, and eight hex digits."""


def write_json(path: Path, values: Any) -> None:
    """Write JSON atomically: a reader sees the old file or the new one."""
    write_bytes(path, json.dumps(values, indent=1, allow_nan=False).encode())


def write_bytes(path: Path, data: bytes) -> None:
    """Write bytes atomically: to a temporary file beside the target, which then replaces it."""
    partial = path.with_name(f"{path.name}{_PARTIAL}{uuid.uuid4().hex[:8]}")
    try:
        with partial.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, path)
    except OSError as error:
        # If the disk is full, the system names no file, or the temporary one.
        error.filename, error.filename2 = str(path), None
        raise
    finally:
        partial.unlink(missing_ok=True)


def seconds_since_written(path: Path) -> float:
    """Return the age of a file by the clock of its file system: those of computers differ.

    Raises
    ------
    OSError
        There is no such file.
    """
    written_s = path.stat().st_mtime
    probe = path.with_name(f"{path.name}{_PARTIAL}{uuid.uuid4().hex[:8]}")
    try:
        probe.touch(exist_ok=False)
        now_s = probe.stat().st_mtime
    except OSError:  # it cannot be written: the clock of this computer is all there is
        now_s = time.time()
    finally:
        with contextlib.suppress(OSError):
            probe.unlink(missing_ok=True)
    return now_s - written_s


def remove_partial_files(root: Path) -> None:
    """Remove what :func:`write_bytes` of killed processes left anywhere in a folder.

    Files written to within :data:`limits.PARTIAL_FILE_S` stay: another process, perhaps on another
    machine, may be at work on them. What cannot be removed stays as well.
    """
    written_before_s = time.time() - limits.PARTIAL_FILE_S
    for folder, _, names in os.walk(root):
        for name in names:
            if re.search(rf"{re.escape(_PARTIAL)}[0-9a-f]{{8}}$", name):
                with contextlib.suppress(OSError):
                    path = Path(folder, name)
                    if os.lstat(path).st_mtime < written_before_s:
                        path.unlink()


def overwrite_json(path: Path, values: Any) -> None:
    """Overwrite a JSON file in place, for a disk without room for a second file.

    Not atomic; padded with blanks if the previous content was longer.
    """
    data = json.dumps(values, allow_nan=False).encode()
    with open_regular(path, "r+b") as stream:
        stream.write(data.ljust(os.fstat(stream.fileno()).st_size))
        stream.flush()
        os.fsync(stream.fileno())


def finite_json(values: Any) -> Any:
    """Return JSON values with ``None`` instead of non-finite numbers, which JSON lacks.

    Tuples become lists and keys strings, as JSON would read them back.
    """
    if isinstance(values, dict):
        return {str(key): finite_json(value) for key, value in values.items()}
    if isinstance(values, (list, tuple)):
        return [finite_json(value) for value in values]
    if isinstance(values, float) and not math.isfinite(values):
        return None
    return values


def read_json(path: Path, *, most_bytes: int | None = None, follow_links: bool = False) -> Any:
    """Read JSON with limits on size and depth; NaN and infinities are rejected.

    Parameters
    ----------
    most_bytes : int, optional
        Default: ``limits.MAX_JSON_BYTES``.
    follow_links : bool
        Whether the path may be a link, as for files that the user has named.

    Raises
    ------
    ParseError
        Names the line, or the limit that was exceeded; or it is not a regular file, or the user
        may not read it.
    """
    try:
        data = read_bounded(path, most_bytes or limits.MAX_JSON_BYTES, follow_links=follow_links)
    except PermissionError as error:
        raise ParseError(
            path, "whole file", f"cannot be read: {error.strerror}.", "Check its permissions."
        ) from error

    def refuse(name: str) -> Any:
        raise ParseError(path, "whole file", f"{name} is not a number.", "Export the file again.")

    try:
        values = json.loads(data.decode("utf-8-sig"), parse_constant=refuse)
    except json.JSONDecodeError as error:
        raise ParseError(
            path, f"line {error.lineno}", f"not JSON: {error.msg}.", "Export the file again."
        ) from None
    except UnicodeDecodeError as error:
        raise ParseError(
            path, f"byte {error.start}", "not UTF-8 text.", "Save it as UTF-8."
        ) from None
    except RecursionError:
        raise _too_deep(path) from None
    except ValueError:  # of Python's limit on digits
        raise ParseError(
            path, "whole file", "a number has thousands of digits.", "Export the file again."
        ) from None
    _check_depth(path, values, 0)
    return values


def _check_depth(path: Path, values: Any, depth: int) -> None:
    if depth > limits.MAX_JSON_DEPTH:
        raise _too_deep(path)
    children = values.values() if isinstance(values, dict) else values
    if isinstance(values, (dict, list)):
        for child in children:
            _check_depth(path, child, depth + 1)


def _too_deep(path: Path) -> ParseError:
    return ParseError(path, "whole file", "nested too deeply.", "Export the file again.")


def real_path(path: str | Path) -> Path:
    """Return an absolute path with its links followed as far as they lead; never raises for them.

    ``Path.resolve`` raises a RuntimeError for links in a circle before Python 3.13.
    """
    return Path(os.path.realpath(path))


def resolve_inside(root: Path, name: str) -> Path | None:
    """Return the path of ``name`` under ``root``, or ``None`` if the name is unsafe.

    Rejected: absolute names, drives, UNC, ``..``, NUL, reserved Windows names, and links that
    lead out of the folder.
    """
    clean = name.replace("\\", "/")
    parts = PurePosixPath(clean).parts
    if not parts or "\0" in clean or len(clean.encode(errors="replace")) > limits.MAX_NAME_BYTES:
        return None
    if clean.startswith("/") or ":" in parts[0] or ".." in parts:
        return None
    if any(is_reserved_name(part) for part in parts):
        return None
    path = root.joinpath(*parts)
    if not real_path(path).is_relative_to(real_path(root)):
        return None
    return path

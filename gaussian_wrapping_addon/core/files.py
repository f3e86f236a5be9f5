# SPDX-License-Identifier: GPL-3.0-or-later
"""Files and folders: atomic writes, reads of folders one does not trust, array files."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import re
import stat
import time
import uuid
from pathlib import Path, PurePosixPath
from typing import IO, Any

from . import limits
from .errors import DatasetError, ParseError
from .names import is_reserved_name

# -- Open files of folders that may come from elsewhere: regular files, no links, bounded reads
#
# A job folder can be sent by anybody. A link in it leads writes and deletions out of it; a named
# pipe or a device stops a reader or fills the memory. The path *to* the folder is the user's own
# and may contain links.


_LINK_ERRNOS = (errno.ELOOP, getattr(errno, "EMLINK", errno.ELOOP))
"""Error numbers of ``open`` with ``O_NOFOLLOW`` on a link: EMLINK on some BSDs."""

_FLAGS = {
    "rb": os.O_RDONLY,
    "wb": os.O_WRONLY | os.O_CREAT,
    "ab": os.O_WRONLY | os.O_CREAT | os.O_APPEND,
    "r+b": os.O_RDWR,
}

_HINT = "Remove it, or put the file that it stands for in its place."


def open_regular(path: Path, mode: str = "rb", *, follow_links: bool = False) -> IO[bytes]:
    """Open a regular file and nothing else; never waits for the other end of a pipe.

    The mode is ``"rb"``, ``"r+b"``, or ``"wb"`` and ``"ab"``, which create the file if it is
    missing. Only the last part of the path is checked for links (:func:`reject_foreign_entries`),
    unless ``follow_links``, as for files that the user has named.

    Raises
    ------
    ParseError
        It is a link, a folder, a named pipe, a socket or a device.
    OSError
        It does not exist, or the system refuses.
    """
    # Where O_NOFOLLOW is missing (Windows), this look is all there is.
    if not follow_links and is_link(path):
        raise _not_regular(path, "a link")
    flags = _FLAGS[mode] | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
    # Without O_NONBLOCK, opening a named pipe waits until somebody opens its other end.
    flags |= getattr(os, "O_NONBLOCK", 0) | (0 if follow_links else getattr(os, "O_NOFOLLOW", 0))
    try:
        number = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in _LINK_ERRNOS and not follow_links:
            raise _not_regular(path, "a link") from None
        if error.errno == errno.ENXIO:  # a pipe that nobody reads, a socket, or no such device
            raise _not_regular(path, "a named pipe, a socket or a device") from None
        raise
    try:
        found = os.fstat(number).st_mode
        if not stat.S_ISREG(found):
            raise _not_regular(path, _kind(found))
        if mode == "wb":
            os.ftruncate(number, 0)  # not O_TRUNC, which acts before the check
        return os.fdopen(number, mode)
    except BaseException:
        os.close(number)
        raise


def read_bounded(path: Path, most_bytes: int, *, follow_links: bool = False) -> bytes:
    """Return the content of a regular file of at most ``most_bytes``.

    The size that the system states is not relied on: some files state 0 and have no end.

    Raises
    ------
    ParseError
        It is not a regular file, or larger.
    OSError
        It cannot be read.
    """
    with open_regular(path, follow_links=follow_links) as stream:
        data = stream.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise ParseError(
            path, "whole file", f"more than {most_bytes} bytes are too many.",
            "Check that it is the right file.",
        )  # fmt: skip
    return data


def touch_regular(path: Path) -> None:
    """Create an empty file, or set the times of an existing regular file to now.

    Raises
    ------
    ParseError, OSError
        As :func:`open_regular`.
    """
    open_regular(path, "ab").close()
    os.utime(path)


def is_link(path: Path) -> bool:
    """Return whether a path itself is a symbolic link, or a junction of Windows."""
    try:
        return _is_link(os.lstat(path))
    except OSError:
        return False


def is_real_folder(path: Path) -> bool:
    """Return whether a path is a folder and not a link to one."""
    try:
        found = os.lstat(path)
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and not _is_link(found)


def reject_foreign_entries(root: Path, *, but: frozenset[str] = frozenset()) -> None:
    """Raise if a folder holds, at any depth, anything but regular files and folders.

    The folder itself may be reached through links. What disappears meanwhile is no error: a job
    may be running. Folders named in ``but`` are not looked into.

    Raises
    ------
    DatasetError
        Names the first such entry, or a folder that cannot be read.
    """
    waiting = [Path(root)]
    while waiting:
        folder = waiting.pop()
        try:
            with os.scandir(folder) as entries:
                for entry in sorted(entries, key=lambda one: one.name):
                    _check_entry(entry, waiting, but)
        except FileNotFoundError:
            continue
        except OSError as error:
            raise DatasetError(
                f"{folder} cannot be read: {error.strerror or error}.", "Check its permissions."
            ) from None


def _check_entry(entry: os.DirEntry[str], folders: list[Path], but: frozenset[str]) -> None:
    try:
        found = entry.stat(follow_symlinks=False)
    except FileNotFoundError:
        return
    link = _is_link(found)
    if stat.S_ISDIR(found.st_mode) and not link:
        if entry.name not in but:
            folders.append(Path(entry.path))
    elif link or not stat.S_ISREG(found.st_mode):
        kind = "a link" if link else _kind(found.st_mode)
        raise DatasetError(
            f"{entry.path} is {kind}. Job folders hold regular files and folders only: anything "
            "else could lead out of them.",
            "Remove it, or put what it stands for in its place.",
        )


def _is_link(found: os.stat_result) -> bool:
    # On Windows a junction is a folder whose reparse tag is that of a mount point.
    junction = getattr(stat, "IO_REPARSE_TAG_MOUNT_POINT", -1)
    return stat.S_ISLNK(found.st_mode) or getattr(found, "st_reparse_tag", 0) == junction


def _kind(mode: int) -> str:
    for is_kind, name in (
        (stat.S_ISLNK, "a link"), (stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a named pipe"),
        (stat.S_ISSOCK, "a socket"),
    ):  # fmt: skip
        if is_kind(mode):
            return name
    return "a device"


def _not_regular(path: Path, kind: str) -> ParseError:
    return ParseError(path, "whole file", f"it is {kind}, not a regular file.", _HINT)


# -- Atomic file writing, JSON with size limits, and safe relative paths --------------------------


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

    By default it may have ``limits.MAX_JSON_BYTES``; the path may be a link if ``follow_links``, as
    for files that the user has named.

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
    if isinstance(values, (dict, list)):
        for child in values.values() if isinstance(values, dict) else values:
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
    return path if real_path(path).is_relative_to(real_path(root)) else None

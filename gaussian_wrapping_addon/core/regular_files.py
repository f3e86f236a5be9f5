# SPDX-License-Identifier: GPL-3.0-or-later
"""Open files of folders that may come from elsewhere: regular files, no links, bounded reads.

A job folder can be sent by anybody. A link in it leads writes and deletions out of it; a named pipe
or a device stops a reader or fills the memory. The path *to* the folder is the user's own and may
contain links.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import IO

from .errors import DatasetError, ParseError

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

    Parameters
    ----------
    path : Path
        The file. Only its last part is checked for links, see :func:`reject_foreign_entries`.
    mode : str
        ``"rb"``, ``"r+b"``, or ``"wb"`` and ``"ab"``, which create the file if it is missing.
    follow_links : bool
        Whether the path may be a link, as for files that the user has named.

    Raises
    ------
    ParseError
        It is a link, a folder, a named pipe, a socket or a device.
    OSError
        It does not exist, or the system refuses.
    """
    if not follow_links:
        # Where O_NOFOLLOW is missing (Windows), this look is all there is.
        _refuse_link(path)
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
    may be running.

    Parameters
    ----------
    but : frozenset of str
        Names of folders that are not looked into.

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


def _check_entry(
    entry: os.DirEntry[str], folders: list[Path], but: frozenset[str] = frozenset()
) -> None:
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


def _refuse_link(path: Path) -> None:
    if is_link(path):
        raise _not_regular(path, "a link")


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

# SPDX-License-Identifier: GPL-3.0-or-later
"""The place in which a case runs, and what it did outside of it.

``place/case/`` holds the input and is the working directory. Beside it lie somebody's files, a
home folder and a folder for temporary files, all of which have to be as before. An audit hook of
Python sees every file that this process opens or changes anywhere else, and every program started.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

CASE = "case"
HOME = "home"
TEMPORARY = "tmp"
BESIDE = "beside"
"""Somebody's files: never read, never written."""

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGES = {
    "os.mkdir": 1, "os.remove": 1, "os.rmdir": 1, "os.rename": 2, "os.link": 2, "os.symlink": 2,
    "os.truncate": 1, "os.chmod": 1, "os.chown": 1, "os.utime": 1, "shutil.rmtree": 1,
}  # fmt: skip
"""Audit events that change files, with their number of paths."""
_STARTS = ("subprocess.Popen", "os.posix_spawn", "os.exec", "os.fork", "os.forkpty", "os.system")


@dataclass
class Seen:
    """What the audit hook saw of one command."""

    changed_outside: list[str] = field(default_factory=list)
    read_beside: list[str] = field(default_factory=list)
    started: list[str] = field(default_factory=list)


class _Watch:
    """The audit hook, which Python cannot remove; idle between commands."""

    def __init__(self) -> None:
        self.place: Path | None = None
        self.allowed: tuple[str, ...] = ()
        self.seen = Seen()
        self._installed = False

    def install(self) -> None:
        if not self._installed:
            sys.addaudithook(self._hook)
            self._installed = True

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.place is None:
            return
        if event == "open":
            self._opened(arguments)
        elif event in _CHANGES:
            for path in arguments[: _CHANGES[event]]:
                self._changed(event, path)
        elif event in _STARTS:
            self.seen.started.append(f"{event} {arguments[0]!s}")

    def _opened(self, arguments: tuple[Any, ...]) -> None:
        path, _, flags = arguments
        if isinstance(path, int):
            return
        if isinstance(flags, int) and flags & _WRITING:
            self._changed("open", path)
        assert self.place is not None
        if _real(path).startswith(os.path.join(self.place, BESIDE) + os.sep):
            self.seen.read_beside.append(os.fsdecode(path))

    def _changed(self, event: str, path: Any) -> None:
        if isinstance(path, int) or path is None:
            return
        real = _real(path)
        if not real.startswith(self.allowed) and "__pycache__" not in real:
            self.seen.changed_outside.append(f"{event} {real}")


def _real(path: Any) -> str:
    # Where a link leads counts: it is followed by what comes next.
    try:
        return os.path.realpath(os.fsdecode(path))
    except (OSError, ValueError):
        return os.fsdecode(path)


_watch = _Watch()


@contextlib.contextmanager
def watched(place: Path) -> Iterator[Seen]:
    """Record what this process does to files outside of ``place`` while the block runs."""
    _watch.install()
    private = os.environ["GAUSSIAN_WRAPPING_DATA"]
    _watch.allowed = (os.path.realpath(place), os.path.realpath(private), os.devnull)
    _watch.seen = Seen()
    _watch.place = Path(os.path.realpath(place))
    try:
        yield _watch.seen
    finally:
        _watch.place = None


def make_place(place: Path) -> Path:
    """Make the surroundings of a case in a new folder; return the folder of the input."""
    for name in (CASE, HOME, TEMPORARY, BESIDE, f"{BESIDE}/album"):
        (place / name).mkdir(parents=True)
    (place / BESIDE / "profile").write_text("alias ls='ls -l'\n")
    (place / BESIDE / "album" / "photo.jpg").write_bytes(b"photo")
    (place / BESIDE / "album" / "notes.txt").write_text("a year of work\n")
    return place / CASE


def content(place: Path) -> dict[str, str]:
    """Return what a folder holds, by path: kind, and hash of files or target of links.

    Nothing is followed, waited for or read without end. The folder itself is ``"."``.
    """
    found = {}
    waiting = [place]
    while waiting:
        folder = waiting.pop()
        if not os.access(folder, os.R_OK | os.X_OK):
            found[os.path.relpath(folder, place)] = "folder that may not be read"
            continue
        for entry in os.scandir(folder):
            name = os.path.relpath(entry.path, place)
            state = entry.stat(follow_symlinks=False)
            if stat.S_ISDIR(state.st_mode):
                found[name] = "folder"
                waiting.append(Path(entry.path))
            elif stat.S_ISLNK(state.st_mode):
                found[name] = f"link to {os.readlink(entry.path)}"
            elif stat.S_ISREG(state.st_mode):
                found[name] = _hash(Path(entry.path), state.st_size)
            else:
                found[name] = f"kind {stat.S_IFMT(state.st_mode):o}"
    return found


_HASHED_BYTES = 4 * 1024 * 1024
"""Longer files, which are sparse, are told apart by their size and beginning."""


def _hash(path: Path, size: int) -> str:
    if not os.access(path, os.R_OK):
        return f"file of {size} bytes that may not be read"
    with path.open("rb") as stream:
        digest = hashlib.sha256(stream.read(_HASHED_BYTES)).hexdigest()
    return f"file of {size} bytes, {digest}"


def changes(before: dict[str, str], after: dict[str, str], allowed: tuple[str, ...]) -> list[str]:
    """Return the entries that differ, but those in ``case/`` that the command may write."""
    mine = tuple(f"{CASE}/{name}" for name in allowed)
    return [
        f"{name}: {before.get(name, 'nothing')} -> {after.get(name, 'nothing')}"
        for name in sorted({*before, *after})
        if before.get(name) != after.get(name)
        and not any(name == one or name.startswith(f"{one}/") for one in mine)
    ]

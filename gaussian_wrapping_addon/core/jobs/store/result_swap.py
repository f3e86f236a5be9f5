# SPDX-License-Identifier: GPL-3.0-or-later
"""A new result takes the place of the earlier one at its end, or not at all.

What is written lies in a folder inside of the result folder until all of it is there: on the same
disk, so that taking its place is renaming alone. No region has a name with a dot.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_logger = logging.getLogger(__name__)

NEW = ".new"
"""In the result folder, while a result is being written."""
EARLIER = ".earlier"
"""In the result folder, for the moment of the change: what the new result replaces."""


@contextmanager
def new_result(result: Path, last: tuple[str, ...] = ()) -> Iterator[Path]:
    """Give an empty folder for the new result; put its content in place when the block ends.

    Each entry of the folder replaces that of its name in ``result``; others there stay. Where the
    block, or taking the place, ends with an error, the result is as it was before.

    Parameters
    ----------
    result : Path
        The result folder; made where there is none.
    last : tuple of str
        Entries that tell of the others: they change after them.

    Raises
    ------
    OSError
        An entry cannot be replaced.
    """
    begun = not result.exists()
    result.mkdir(exist_ok=True)
    recover(result)
    new = result / NEW
    new.mkdir()
    try:
        yield new
        _swap(new, result, last)
    finally:
        shutil.rmtree(new, ignore_errors=True)
        if begun:
            with contextlib.suppress(OSError):  # not empty: it is the result
                result.rmdir()


def recover(result: Path) -> None:
    """Bring back what a change that was cut off has set aside, and remove what it had begun."""
    earlier = result / EARLIER
    if earlier.is_dir():
        _logger.warning("an earlier export was cut off; its result is brought back")
        for path in sorted(earlier.iterdir()):
            _remove(result / path.name)
            os.replace(path, result / path.name)
        earlier.rmdir()
    _remove(result / NEW)


def _swap(new: Path, result: Path, last: tuple[str, ...]) -> None:
    """Rename all entries of ``new`` into ``result``; after an error, rename them back."""
    earlier = result / EARLIER
    earlier.mkdir()
    names = sorted((path.name for path in new.iterdir()), key=lambda name: (name in last, name))
    moved: list[tuple[Path, Path]] = []

    def move(source: Path, target: Path) -> None:
        os.replace(source, target)
        moved.append((source, target))

    try:
        for name in names:
            if os.path.lexists(result / name):
                move(result / name, earlier / name)
            move(new / name, result / name)
    except BaseException:
        for source, target in reversed(moved):
            os.replace(target, source)
        earlier.rmdir()
        raise
    # In place: what cannot be removed now has another name, so that it is not brought back.
    old = result / f"{NEW}{EARLIER}"
    _remove(old)
    os.replace(earlier, old)
    shutil.rmtree(old, ignore_errors=True)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Replace a job's result all at once, or not at all.

A new result is written to a subfolder of the result folder until it is complete: on the same disk,
so that replacing takes renames only. Region names contain no dot.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...regular_files import is_real_folder

_logger = logging.getLogger(__name__)

NEW = ".new"
"""Subfolder of the result folder in which a new result is written."""
EARLIER = ".earlier"
"""Subfolder of the result folder that holds the replaced files during the swap."""


@contextmanager
def new_result(result: Path, last: tuple[str, ...] = ()) -> Iterator[Path]:
    """Yield an empty folder for the new result; move its content into place when the block ends.

    Each entry of the folder replaces the one of its name in ``result``; others stay. If the block
    or the swap raises, the result is unchanged.

    Parameters
    ----------
    result : Path
        The result folder; created if missing.
    last : tuple of str
        Entries that describe the others and are replaced after them.

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
    """Undo an interrupted swap: restore the earlier files and remove the new ones."""
    earlier = result / EARLIER
    if is_real_folder(earlier):
        _logger.warning("an earlier export was interrupted; the previous result is restored")
        for path in sorted(earlier.iterdir()):
            _remove(result / path.name)
            os.replace(path, result / path.name)
        earlier.rmdir()
    elif os.path.lexists(earlier):
        _remove(earlier)  # not ours: its content is not a result
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
    # Swap complete: rename the old files before deleting, so that recover() ignores leftovers.
    old = result / f"{NEW}{EARLIER}"
    _remove(old)
    os.replace(earlier, old)
    shutil.rmtree(old, ignore_errors=True)


def _remove(path: Path) -> None:
    if is_real_folder(path):
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)

# SPDX-License-Identifier: GPL-3.0-or-later
"""A small disk in memory, where this user may mount one, and its last byte taken."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import DISK_FULL_ERRNOS

DISK_BYTES = 64 * 1024 * 1024


@contextlib.contextmanager
def mounted_disk(place: Path) -> Iterator[Path]:
    """Mount the disk on a new folder; skip the test where that is not allowed."""
    place.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(place)]
    try:
        mounted = subprocess.run(words, check=False, capture_output=True).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("this user cannot mount a small disk (tmpfs)")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def fill(path: Path) -> None:
    """Write a file until nothing is left on its disk."""
    with path.open("ab", buffering=0) as stream:
        try:
            while stream.write(bytes(4096)):
                pass
        except OSError as error:
            if error.errno not in DISK_FULL_ERRNOS:
                raise

# SPDX-License-Identifier: GPL-3.0-or-later
"""Folders that nobody can write into, not even root."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Make a folder and those in it read-only for a while; skip where that cannot be done.

    Modes do not bind root, who mounts the folder onto itself instead.
    """
    folders = [folder, *(path for path in folder.rglob("*") if path.is_dir())]
    for path in folders:
        path.chmod(0o555)
    mounted = os.access(folder, os.W_OK) and _mounted("--bind", str(folder), str(folder))
    try:
        if mounted:
            _mounted("-o", "remount,bind,ro", str(folder))
        if os.access(folder, os.W_OK):
            pytest.skip("this user may write into read-only folders, and cannot mount any")
        yield
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=True)
        for path in folders:
            path.chmod(0o755)


def _mounted(*arguments: str) -> bool:
    mount = shutil.which("mount")
    if mount is None:
        return False
    return subprocess.run([mount, *arguments], check=False, capture_output=True).returncode == 0

# SPDX-License-Identifier: GPL-3.0-or-later
"""A private data folder; threads; which tests are slow, and which share a process in parallel runs.

No test sees or changes the worker that the person who runs it has set up.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections import Counter
from pathlib import Path

import pytest

_DATA = "GAUSSIAN_WRAPPING_DATA"

_folder = tempfile.mkdtemp(prefix="gwrap-data-")
os.environ[_DATA] = _folder
# As in workers (core/processes/spawn.py), before anything imports numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
atexit.register(shutil.rmtree, _folder, ignore_errors=True)

_ROOT = Path(__file__).resolve().parents[1]
SLOW_TESTS = Path(__file__).with_name("slow_tests.txt")
"""Lines ``SECONDS FILE`` or ``SECONDS FILE::TEST``, made by ``tools/slow_tests.py``."""


def slow_seconds() -> dict[str, float]:
    """Return the seconds of each slow file or test of the list."""
    seconds = {}
    for line in SLOW_TESTS.read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            number, name = line.split()
            seconds[name] = float(number)
    return seconds


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark slow tests, keep each file in one process, and start with the slowest files."""
    seconds = slow_seconds()
    of_file: Counter[str] = Counter()
    for name, value in seconds.items():
        of_file[name.partition("::")[0]] += value
    parallel = "PYTEST_XDIST_WORKER" in os.environ
    for item in items:
        file = item.path.relative_to(_ROOT).as_posix()
        test = f"{file}::{getattr(item, 'originalname', item.name)}"
        if file in seconds or test in seconds:
            item.add_marker(pytest.mark.slow)
        if parallel and item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(file))
    if parallel:
        items.sort(key=lambda item: -of_file[item.path.relative_to(_ROOT).as_posix()])

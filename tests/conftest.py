# SPDX-License-Identifier: GPL-3.0-or-later
"""A private data folder, threads, compiled kernels; which tests are slow or share a process.

No test sees or changes the worker that the person who runs it has set up.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from importlib import metadata
from pathlib import Path

import pytest

_DATA = "GAUSSIAN_WRAPPING_DATA"

_folder = tempfile.mkdtemp(prefix="gwrap-data-")
os.environ[_DATA] = _folder
# As in workers (core/worker/spawn.py), before anything imports numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
atexit.register(shutil.rmtree, _folder, ignore_errors=True)

_ROOT = Path(__file__).resolve().parents[1]
SLOW_TESTS = Path(__file__).with_name("slow_tests.txt")
"""Lines ``SECONDS FILE`` or ``SECONDS FILE::TEST``, made by ``tools/slow_tests.py``."""


_STAGES = _ROOT / "tests" / "core" / "kernels" / "kernel_stages.py"
_WARMED = (
    ("training", "one_view", "losses", "query", "autograd"),
    ("fields", "meshing", "texture"),
)
"""The stages of each process that compiles before the tests."""


def compile_kernels_once() -> None:
    """Compile most kernels in two processes, so that no two processes of tests compile the same.

    They stand in the ``__pycache__`` beside their sources, where children find them too, and a
    stamp there says for which sources. What fails is left to the tests.
    """
    core = _ROOT / "gaussian_wrapping_addon" / "core"
    state = hashlib.sha256(sys.version.encode())
    for distribution in ("numba", "llvmlite", "numpy"):
        try:
            state.update(metadata.version(distribution).encode())
        except metadata.PackageNotFoundError:
            return
    for path in sorted(core.rglob("*.py")):
        state.update(path.read_bytes())
    stamp = core / "__pycache__" / "compiled-for-tests"
    if stamp.is_file() and stamp.read_text() == state.hexdigest():
        return
    processes = [
        subprocess.Popen(
            [sys.executable, str(_STAGES), *stages], cwd=_ROOT,
            env={**os.environ, "PYTHONPATH": str(_ROOT)},
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        for stages in _WARMED
    ]  # fmt: skip
    if [process.wait() for process in processes] == [0, 0]:
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(state.hexdigest())


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile kernels before the processes of a parallel run start."""
    options = session.config.option
    if getattr(options, "numprocesses", None) and not options.collectonly:
        compile_kernels_once()


def slow_seconds() -> dict[str, float]:
    """Return the seconds of each slow file or test of the list."""
    seconds = {}
    for line in SLOW_TESTS.read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            number, name = line.split()
            seconds[name] = float(number)
    return seconds


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark slow tests, and start with the slowest files."""
    seconds = slow_seconds()
    of_file: Counter[str] = Counter()
    for name, value in seconds.items():
        of_file[name.partition("::")[0]] += value
    for item in items:
        file = item.path.relative_to(_ROOT).as_posix()
        test = f"{file}::{getattr(item, 'originalname', item.name)}"
        if file in seconds or test in seconds:
            item.add_marker(pytest.mark.slow)
    if "PYTEST_XDIST_WORKER" in os.environ:
        items.sort(key=lambda item: -of_file[item.path.relative_to(_ROOT).as_posix()])

# SPDX-License-Identifier: GPL-3.0-or-later
"""A worker that has imported pycolmap still ends in order when it is asked to."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[3] / "gaussian_wrapping_addon"
CODE = """
import os, signal, sys, threading, time
sys.path[:0] = {path!r}
{load}
asked = []
signal.signal(signal.SIGTERM, lambda *_: asked.append(True))
signal.signal(signal.SIGINT, lambda *_: asked.append(True))
failed = []
threading.excepthook = failed.append
threads = [threading.Thread(target=load) for _ in range({threads})]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
if not threads:
    load()
for number in (signal.SIGTERM, signal.SIGINT):
    os.kill(os.getpid(), number)
    time.sleep(0.05)
sys.exit(40 + len(asked) + 10 * len(failed))
"""
PYCOLMAP = """
def load():
    from gaussian_wrapping_addon.core.readers.lenses import _native
    from gaussian_wrapping_addon.core.readers.source_model import LensCamera
    _native(LensCamera("PINHOLE", 8, 8, (1.0, 1.0, 4.0, 4.0)))
"""
IMPOLITE = """
def load():
    import ctypes
    from gaussian_wrapping_addon.core.worker.spawn import kept_signal_handlers
    with kept_signal_handlers():
        ctypes.CDLL(None).signal(15, 0)
        ctypes.CDLL(None).signal(2, 0)
"""


@pytest.mark.skipif(os.name == "nt", reason="processes of Windows get no SIGTERM")
@pytest.mark.parametrize(
    ("load", "threads"), [(PYCOLMAP, 0), (PYCOLMAP, 1), (PYCOLMAP, 4), (IMPOLITE, 0), (IMPOLITE, 1)]
)
def test_the_handlers_of_a_worker_stay(load: str, threads: int) -> None:
    code = CODE.format(path=sys.path, load=load, threads=threads)
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert ended.returncode == 42, ended.stderr.decode()[-2000:]


def test_handlers_that_python_sets_itself_stay_as_they_were() -> None:
    from gaussian_wrapping_addon.core.worker.spawn import kept_signal_handlers

    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    with kept_signal_handlers():
        pass
    assert {number: signal.getsignal(number) for number in before} == before


def test_pycolmap_is_imported_in_one_place() -> None:
    places = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if "import pycolmap" in (text := path.read_text(encoding="utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Import) and any(name.name == "pycolmap" for name in node.names)
    }
    assert places == {"core/readers/lenses.py"}

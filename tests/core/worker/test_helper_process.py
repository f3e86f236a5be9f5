# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper processes: progress, typed failures, crashes, deadlines, cancelling."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import (
    Cancelled,
    DatasetError,
    MemoryShortageError,
    MeshingError,
    ResourceError,
    UsageError,
    WorkerError,
    WrapError,
)
from gaussian_wrapping_addon.core.progress import Progress, ProgressEvent
from gaussian_wrapping_addon.core.worker import helper_process

HELPERS = {
    "good": "sys.stdout.write('not json\\n[1]\\n'); sys.stdout.flush(); "
    "emit(fraction=0.5, message='half'); (folder / 'out').write_text('1')",
    "broken_file": "raise errors.ParseError('a.bin', 'byte 3', 'it is short.', 'Copy it again.')",
    "bad_setting": "raise errors.SettingError('a.b', '1 to 3')",
    "no_surface": "raise errors.MeshingError('No surface.')",
    "base": "raise errors.WrapError('Odd.')",
    "crash": "os.kill(os.getpid(), 11)",
    "raises": "raise RuntimeError('unexpected words')",
    "sleeps": "time.sleep(60)",
    "large": "held = b'x' * (150 * 2**20)",
    "greedy": "bytearray(4 * 2**30)",
    "limited": "import resource; resource.setrlimit(resource.RLIMIT_AS, 2 * (3 * 2**30,)); "
    "bytearray(4 * 2**30)",
    "killed": "os.kill(os.getpid(), 9)",
    "no_room": "raise ImportError('x.so: failed to map segment from shared object')",
}


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Run one of ``HELPERS`` as a helper process in a scratch folder."""

    def start(name: str, progress: Progress | None = None, **options: object) -> Path:
        body = (
            "import os, sys, time\nfrom pathlib import Path\n"
            f"sys.path.insert(0, {str(Path(__file__).resolve().parents[3])!r})\n"
            "from gaussian_wrapping_addon.core.worker import helper_entry\n"
            "from gaussian_wrapping_addon.core import errors\n"
            "from gaussian_wrapping_addon.core.worker.helper_process import emit\n"
            "import types, importlib\n"
            "def main(folder):\n"
            f"    {HELPERS[name]}\n"
            "module = types.ModuleType('m'); module.main = main\n"
            "helper_entry.importlib = types.SimpleNamespace(import_module=lambda n: module)\n"
            "sys.exit(helper_entry.main(sys.argv[1:]))\n"
        )
        script = tmp_path / "script.py"
        script.write_text(body)

        def command(module: str, *arguments: str, python: str | None = None) -> list[str]:
            return [sys.executable, str(script), *arguments]

        monkeypatch.setattr(helper_process, "child_command", command)
        helper_process.run_helper(name, tmp_path, progress or Progress(), **options)  # type: ignore[arg-type]
        return tmp_path

    return start


def test_progress_and_results_arrive_between_noise(run) -> None:
    events: list[ProgressEvent] = []
    folder = run("good", Progress("x", events.append))
    assert (folder / "out").exists()
    assert [(e.fraction, e.message) for e in events] == [(0.5, "half")]


@pytest.mark.parametrize(
    ("name", "kind", "message", "hint"),
    [
        ("broken_file", DatasetError, "a.bin, byte 3: it is short.", "Copy it again."),
        ("bad_setting", UsageError, "Setting a.b is out of range.", "1 to 3"),
        ("no_surface", MeshingError, "No surface.", ""),
        ("base", WorkerError, "Odd.", ""),
    ],
)
def test_typed_failures_keep_exit_code_message_and_hint(
    run, name: str, kind: type, message: str, hint: str
) -> None:
    with pytest.raises(WrapError) as caught:
        run(name)
    assert (type(caught.value), caught.value.message) == (kind, message)
    assert hint in caught.value.hint


def test_a_crash_names_the_signal(run) -> None:
    with pytest.raises(WorkerError, match="signal 11"):
        run("crash")


def test_an_exception_brings_its_last_words_and_the_log_the_others(
    run, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(WorkerError, match="unexpected words") as caught:
        run("raises")
    assert caught.value.message == "raises ended with code 1: RuntimeError: unexpected words"
    assert "raises: Traceback" in caplog.text


def test_the_deadline_ends_the_helper(run) -> None:
    begun_s = time.monotonic()
    with pytest.raises(ResourceError, match="longer than"):
        run("sleeps", deadline_s=0.5)
    assert time.monotonic() - begun_s < 10


def test_cancelling_ends_the_helper_within_two_seconds(run) -> None:
    begun_s = time.monotonic()
    progress = Progress(is_cancelled=lambda: time.monotonic() - begun_s > 0.3)
    with pytest.raises(Cancelled):
        run("sleeps", progress)
    assert time.monotonic() - begun_s < 2.5


def test_the_memory_limit_holds(run) -> None:
    with pytest.raises(WorkerError, match="MemoryError"):
        run("greedy", memory_bytes=2 * 2**30)


linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits are Linux's")


@linux
@pytest.mark.parametrize("memory_bytes", [None, 8 * 2**30])
def test_what_the_system_does_not_give_is_told_apart(
    run, monkeypatch: pytest.MonkeyPatch, memory_bytes: int | None
) -> None:
    """A limit that the user has set (ulimit -v) is below what the helper may take."""
    monkeypatch.setattr(helper_process, "is_limited_below", lambda _: True)
    with pytest.raises(MemoryShortageError, match="MemoryError") as caught:
        run("limited", memory_bytes=memory_bytes)
    assert "ulimit" in caught.value.hint


@linux
def test_native_code_that_crashes_under_a_users_limit_was_short_of_memory(
    run, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(WorkerError, match="signal 11"):
        run("crash", memory_bytes=8 * 2**30)
    monkeypatch.setattr(helper_process, "is_limited_below", lambda _: True)
    with pytest.raises(MemoryShortageError, match="signal 11"):
        run("crash", memory_bytes=8 * 2**30)


@linux
def test_a_lower_limit_of_the_user_stays() -> None:
    code = (
        "import resource, sys\n"
        f"sys.path.insert(0, {str(Path(__file__).resolve().parents[3])!r})\n"
        "from gaussian_wrapping_addon.core.worker.helper_process import *\n"
        "G = 2**30\n"
        "resource.setrlimit(resource.RLIMIT_AS, (3 * G, 4 * G))\n"
        "assert is_limited_below(3 * G + 1) and not is_limited_below(3 * G)\n"
        "limit_address_space(8 * G)\n"
        "assert resource.getrlimit(resource.RLIMIT_AS) == (3 * G, 4 * G)\n"
        "limit_address_space(2 * G)\n"
        "assert resource.getrlimit(resource.RLIMIT_AS) == (2 * G, 2 * G)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@linux
@pytest.mark.parametrize(("name", "words"), [("killed", "signal 9"), ("no_room", "want of memory")])
def test_a_helper_that_the_system_kills_or_gives_no_room_was_short_of_memory(
    run, name: str, words: str
) -> None:
    with pytest.raises(MemoryShortageError, match=words):
        run(name)


@linux
def test_the_peak_is_the_helpers_own_and_the_largest_is_kept(
    run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(helper_process, "_largest_helper_bytes", 0)
    assert helper_process.largest_helper_bytes() == 0
    parents_bytes = b"x" * (600 * 2**20)
    run("good")
    small_bytes = helper_process.largest_helper_bytes()
    run("large")
    large_bytes = helper_process.largest_helper_bytes()
    assert small_bytes + 140 * 2**20 < large_bytes < len(parents_bytes)
    run("good")
    assert helper_process.largest_helper_bytes() == large_bytes

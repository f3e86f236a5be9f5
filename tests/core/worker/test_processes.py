# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes: which is meant, its group, memory, entry point, and its end."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.worker import spawn as module
from gaussian_wrapping_addon.core.worker.helper_process import child_command, peak_memory_bytes
from gaussian_wrapping_addon.core.worker.spawn import (
    CALLER_OPTION,
    Caller,
    caller_option,
    child_environment,
    group_options,
    kill_group,
    process_alive,
    process_start_ticks,
    run_to_end,
    spawn,
)

PACKAGE = Path(__file__).resolve().parents[3] / "gaussian_wrapping_addon"
TELL = (
    "import json, os, sys\n"
    "open_files = [n for n in range(3, 64) if os.path.exists(f'/proc/self/fd/{n}')"
    " and os.path.basename(os.path.realpath(f'/proc/self/fd/{n}')) == 'held']\n"
    "print(json.dumps({'read': sys.stdin.read(), 'group': os.getpgid(0), 'own': os.getpid(),"
    " 'environment': dict(os.environ), 'files': open_files}))\n"
)
NAP = "import time; time.sleep(60)"


def test_a_child_leads_a_group_and_inherits_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    for name in ("OMP_WAIT_POLICY", "OPENBLAS_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    with (tmp_path / "held").open("wb") as held:
        os.set_inheritable(held.fileno(), True)
        code, output, words = run_to_end([sys.executable, "-I", "-c", TELL], 60.0)
    told = json.loads(output)
    assert (code, words, told["read"], told["files"]) == (0, "", "", [])
    assert told["group"] == told["own"] != os.getpgid(0)
    assert "PYTHONPATH" not in told["environment"]
    assert told["environment"]["OMP_WAIT_POLICY"] == "PASSIVE"
    assert told["environment"]["OPENBLAS_NUM_THREADS"] == "1"
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    assert child_environment()["OMP_WAIT_POLICY"] == "ACTIVE"


def test_an_environment_can_be_given() -> None:
    process = spawn([sys.executable, "-I", "-c", TELL], environment={"ONLY": "1"})
    told = json.loads(process.communicate(timeout=60)[0])["environment"]
    assert told["ONLY"] == "1"
    assert "OMP_WAIT_POLICY" not in told


def test_on_windows_a_group_without_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.sys, "platform", "win32")
    monkeypatch.setattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0x200, raising=False)
    monkeypatch.setattr(subprocess, "CREATE_NO_WINDOW", 0x8000000, raising=False)
    assert group_options() == {"creationflags": 0x8000200}


def test_what_a_child_has_started_ends_with_it() -> None:
    code = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([sys.executable, '-c', {NAP!r}])\n"
        "print(child.pid, flush=True)\n" + NAP
    )
    process = spawn([sys.executable, "-I", "-c", code])
    assert process.stdout is not None
    grandchild = int(process.stdout.readline())
    kill_group(process)
    process.communicate()
    assert process.returncode != 0
    deadline_s = time.monotonic() + 10.0
    while process_alive(grandchild, 0):
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


def test_deadlines_and_missing_programs() -> None:
    begun_s = time.monotonic()
    with pytest.raises(subprocess.TimeoutExpired):
        run_to_end([sys.executable, "-I", "-c", NAP], 0.5)
    assert time.monotonic() - begun_s < 30.0
    with pytest.raises(FileNotFoundError):
        run_to_end(["/no/such/program"], 1.0)


def test_nothing_else_starts_processes() -> None:
    """But for the set-up of the worker, which runs foreign Pythons, and what is sent to farms."""
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.name in ("spawn.py", "child.py", "install.py"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Attribute)
                and isinstance(node.func.value, ast.Name)
                and node.func.value.id == "subprocess"
                and node.func.attr in ("Popen", "run", "call", "check_call", "check_output")
            ):
                wrong.append(f"{path.relative_to(PACKAGE)}:{node.lineno}")
    assert wrong == []


def ended(pid: int, started: int, monkeypatch: pytest.MonkeyPatch) -> bool:
    monkeypatch.setitem(sys._xoptions, CALLER_OPTION, f"{pid}:{started}")
    return Caller().ended()


def test_every_child_is_isolated_and_knows_its_caller() -> None:
    assert child_command("jobs.worker")[:4] == [sys.executable, "-I", "-X", caller_option()]
    assert caller_option() == f"gwrap_caller={os.getpid()}:{process_start_ticks(os.getpid())}"


def test_a_caller_that_was_dead_at_the_start_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    child = subprocess.Popen([sys.executable, "-c", "pass"])
    child.wait()
    assert ended(child.pid, 0, monkeypatch)
    own, ticks = os.getpid(), process_start_ticks(os.getpid())
    assert not ended(own, ticks, monkeypatch)
    if sys.platform.startswith("linux"):  # another process with the caller's number is not it
        assert ended(own, ticks + 1, monkeypatch)


@pytest.mark.parametrize("text", ["", "x", "1", "-1:0", "1:x", "9" * 30 + ":0"])
def test_without_a_caller_told_the_parent_counts(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys._xoptions, CALLER_OPTION, text)
    caller = Caller()
    assert caller.ended() == text.startswith("9")
    another = os.getppid() + 1
    monkeypatch.setattr(os, "getppid", lambda: another)
    assert caller.ended()


def test_numbers_that_are_no_pids_are_not_alive() -> None:
    for pid in (0, -1, 2**31, 10**30):
        assert not process_alive(pid, 0)


def test_a_module_is_found_from_any_folder_and_other_names_are_refused(tmp_path: Path) -> None:
    for name, code in (("jobs.commands.doctor", None), ("../x", 2), ("os;1", 2), ("a..b", 2)):
        done = subprocess.run(
            child_command(name), cwd=tmp_path, capture_output=True, env=child_environment(),
            check=False,
        )  # fmt: skip
        if code is None:
            assert b'"subject": "Python"' in done.stdout, done.stderr.decode()
        else:
            assert done.returncode == code


PRINT_PEAKS = (
    "import json, sys\n"
    "sys.path[:0] = json.loads(sys.argv[1])\n"
    "from gaussian_wrapping_addon.core.worker.helper_process import peak_memory_bytes\n"
    "print(json.dumps(peak_memory_bytes()))\n"
)


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="elsewhere it includes the parent's"
)
def test_a_small_child_of_a_large_parent_is_small() -> None:
    held = b"x" * (300 * 2**20)
    done = subprocess.run(
        [sys.executable, "-c", PRINT_PEAKS, json.dumps(sys.path)],
        capture_output=True, check=True, env=child_environment(),
    )  # fmt: skip
    child = json.loads(done.stdout)
    assert 2**20 < child["worker"] < len(held) < peak_memory_bytes()["worker"]
    assert child["largest_helper"] == 0

# SPDX-License-Identifier: GPL-3.0-or-later
"""Which process is meant, and whether the caller of a child has ended."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from gaussian_wrapping_addon.core.worker.helper_process import child_command
from gaussian_wrapping_addon.core.worker.spawn import (
    CALLER_OPTION,
    Caller,
    caller_option,
    process_alive,
    process_start_ticks,
)


def ended(pid: int, started: int, monkeypatch: pytest.MonkeyPatch) -> bool:
    monkeypatch.setitem(sys._xoptions, CALLER_OPTION, f"{pid}:{started}")
    return Caller().ended()


def test_every_child_knows_its_caller() -> None:
    assert child_command("jobs.worker")[2:4] == ["-X", caller_option()]
    assert caller_option() == f"gwrap_caller={os.getpid()}:{process_start_ticks(os.getpid())}"


def test_a_caller_that_was_dead_at_the_start_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    child = subprocess.Popen([sys.executable, "-c", "pass"])
    child.wait()
    assert ended(child.pid, 0, monkeypatch)
    assert not ended(os.getpid(), process_start_ticks(os.getpid()), monkeypatch)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="start times of Linux")
def test_another_process_with_the_pid_of_the_caller_is_not_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert ended(os.getpid(), process_start_ticks(os.getpid()) + 1, monkeypatch)


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


@pytest.mark.parametrize("pid", [0, -1, 2**31, 10**30])
def test_numbers_that_are_no_pids_are_not_alive(pid: int) -> None:
    assert not process_alive(pid, 0)

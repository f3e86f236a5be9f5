# SPDX-License-Identifier: GPL-3.0-or-later
"""Leases: one process runs a part, and what a dead or silent one held is taken over."""

from __future__ import annotations

import dataclasses
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.jobs.parts import lease as lease_module
from gaussian_wrapping_addon.core.jobs.parts.graph import (
    PartState,
    new_state,
    read_state,
    state_path,
    write_state,
)
from gaussian_wrapping_addon.core.jobs.parts.lease import PartHeldError, PartLease
from gaussian_wrapping_addon.core.progress import ProgressEvent
from tests.core.jobs.farm_jobs import wait_until

TAKEN: list[PartLease] = []


@pytest.fixture(autouse=True)
def _ended() -> Iterator[None]:
    """End what a test has taken: its thread would write on."""
    yield
    for lease in TAKEN:
        lease.finish("FAILED")
    TAKEN.clear()


def lease_in(root: Path, attempt: int = 1) -> PartLease:
    TAKEN.append(PartLease(root, "train", "plan1", attempt))
    return TAKEN[-1]


def elsewhere(**changes: object) -> PartState:
    """Return the state of a part that another computer runs."""
    state = dataclasses.replace(new_state("plan1", 1), place="other boot pid:[1]")
    return dataclasses.replace(state, **changes)  # type: ignore[arg-type]


def silent(root: Path, seconds: float) -> None:
    then_s = time.time() - seconds
    os.utime(state_path(root, "train"), (then_s, then_s))


def test_a_lease_shows_progress_and_how_the_part_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lease_module, "BEAT_S", 0.05)
    lease = lease_in(tmp_path)
    assert lease.take()
    lease.event(ProgressEvent("train", 0.4, "iteration 6", {"psnr": 20.0, "iteration": 6.0}))
    lease.event(ProgressEvent("train", 0.5, "iteration 7", {"iteration": 7.0, "loss": math.inf}))
    end_s = time.monotonic() + 5.0
    while (state := read_state(tmp_path, "train")) is None or state.fraction != 0.5:
        assert time.monotonic() < end_s
        time.sleep(0.02)
    assert (state.state, state.message, state.pid) == ("RUNNING", "iteration 7", os.getpid())
    assert state.figures == {"psnr": 20.0, "iteration": 7.0}
    lease.finish("DONE", fraction=1.0, exit_code=0)
    state = read_state(tmp_path, "train")
    assert state is not None
    assert (state.state, state.fraction, state.exit_code) == ("DONE", 1.0, 0)
    assert state.peak_memory_bytes > 0


def test_a_living_process_keeps_its_part(tmp_path: Path) -> None:
    first = lease_in(tmp_path)
    assert first.take()
    with pytest.raises(PartHeldError, match=f"is run by process {os.getpid()} of"):
        lease_in(tmp_path).take()
    asked: list[int] = []
    with pytest.raises(Cancelled):
        lease_in(tmp_path).take(lambda: len(asked) > 1 or bool(asked.append(1)))
    first.finish("DONE")
    second = lease_in(tmp_path)
    assert not second.take(lambda: False)  # done by the first
    second.finish("FAILED", error="never begun")
    state = read_state(tmp_path, "train")
    assert state is not None
    assert state.state == "DONE"


def test_a_dead_process_loses_its_part(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    write_state(tmp_path, "train", dataclasses.replace(new_state("plan1", 1), pid=ended.pid))
    assert lease_in(tmp_path, 2).take()


def test_another_computer_keeps_its_part_as_long_as_it_shows_life(tmp_path: Path) -> None:
    write_state(tmp_path, "train", elsewhere())
    with pytest.raises(PartHeldError, match="of other"):
        lease_in(tmp_path).take()
    silent(tmp_path, limits.SILENT_S - 20)
    with pytest.raises(PartHeldError):
        lease_in(tmp_path).take()
    silent(tmp_path, limits.SILENT_S + 20)
    assert lease_in(tmp_path).take()


def test_a_process_that_comes_back_finds_its_part_taken_and_leaves_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lease_module, "BEAT_S", 0.05)
    lease = lease_in(tmp_path)
    assert lease.take()
    write_state(tmp_path, "train", elsewhere(token="theirs"))
    wait_until(lambda: lease.is_lost, 5.0)
    lease.finish("FAILED", error="too late")
    state = read_state(tmp_path, "train")
    assert state is not None
    assert (state.token, state.state) == ("theirs", "RUNNING")


@pytest.mark.parametrize("plan", ["plan1", "plan2"])
def test_only_a_part_of_the_same_plan_is_done(plan: str, tmp_path: Path) -> None:
    write_state(tmp_path, "train", elsewhere(state="DONE", plan=plan))
    assert lease_in(tmp_path).take() is (plan == "plan2")

# SPDX-License-Identifier: GPL-3.0-or-later
"""Job folders: ownership, locks, states of processes here and on other computers."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.store import job_folder
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.worker.spawn import process_alive, process_start_ticks


def dead_pid() -> int:
    child = subprocess.Popen([sys.executable, "-c", "pass"])
    child.wait()
    return child.pid


def test_only_a_new_folder_or_one_of_a_job_is_taken(tmp_path: Path) -> None:
    photo = tmp_path / "photos" / "holiday.jpg"
    photo.parent.mkdir()
    photo.write_bytes(b"x")
    with pytest.raises(UsageError, match="other files"):
        JobFolder(photo.parent).create()
    assert list(photo.parent.iterdir()) == [photo]
    with pytest.raises(UsageError, match="is a file"):
        JobFolder(photo).create()
    folder = JobFolder(tmp_path / "new" / "deep")
    folder.create()
    (folder.root / "log.txt").write_text("x")
    folder.create()
    assert folder.stages.is_dir()


def test_a_running_worker_that_does_not_live_is_lost(tmp_path: Path) -> None:
    folder, pid = JobFolder(tmp_path), os.getpid()
    started = process_start_ticks(pid)
    living = JobStatus(state="RUNNING", pid=pid, pid_started=started)
    folder.write_status(living)
    assert folder.read_status() == living
    dead = [(dead_pid(), 0), (1, 0)]  # no worker is the first process
    if started:
        dead.append((pid, started + 1))  # its number was given again
    for pid, started in dead:
        folder.write_status(JobStatus("RUNNING", pid=pid, pid_started=started))
        assert folder.read_status().state == "LOST"
        assert "resume" in folder.read_status().hint.lower()


def test_a_worker_that_ends_between_two_looks_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = JobFolder(tmp_path)
    folder.write_status(JobStatus(state="RUNNING", pid=1234))

    def ends_now(pid: int, started: int) -> bool:
        folder.write_status(JobStatus(state="DONE", pid=pid, exit_code=0))
        return False

    monkeypatch.setattr(job_folder, "owner_alive", ends_now)
    assert folder.read_status().state == "DONE"


def test_a_status_of_version_0_1_0_is_read(tmp_path: Path) -> None:
    """It had neither ``phase`` nor ``put_back``: a finished job with an error was one put back."""
    folder = JobFolder(tmp_path)
    for status, put_back in (
        (JobStatus("DONE", "export", 1.0), False),
        (JobStatus("DONE", "export", 1.0, error="No surface."), True),
        (JobStatus("FAILED", "mesh", 0.8, error="No surface."), False),
    ):
        values = {
            name: value
            for name, value in asdict(status).items()
            if name not in ("phase", "put_back")
        }
        write_json(folder.status_path, values)
        assert folder.read_status() == replace(status, put_back=put_back)
        write_json(folder.status_path, {**values, "put_back": "yes"})
        assert folder.read_status() == JobStatus(), "not of its kind"


@pytest.mark.parametrize(
    "content",
    ["", "{", "[]", '{"state": "X"}', '{"fraction": null}', '{"state": "RUNNING", "pid": "7"}'],
)
def test_half_a_status_or_one_that_holds_other_things_reads_as_not_yet(
    tmp_path: Path, content: str
) -> None:
    folder = JobFolder(tmp_path)
    folder.status_path.write_text(content)
    assert folder.read_status() == JobStatus()


@pytest.mark.parametrize(
    "case", ["dead", "reused", "half", "empty", "other", "clock", "first", "without start"]
)
def test_a_stale_lock_is_taken_over(case: str, tmp_path: Path) -> None:
    if case == "without start" and not sys.platform.startswith("linux"):
        pytest.skip("only Linux tells when processes began")
    folder = JobFolder(tmp_path)
    here, ticks = os.getppid(), process_start_ticks(os.getppid())
    owner = {
        "dead": {"pid": dead_pid(), "started": 1},
        "reused": {"pid": here, "started": ticks + 1},
        "clock": {"pid": here, "started": ticks + 10**12},  # it began when the clock was ahead
        "other": {"pid": "me"},
        "first": {"pid": 1, "started": 0},
        "without start": {"pid": here, "started": 0},
    }.get(case)
    text = json.dumps(owner) if owner else {"half": '{"pid": 1', "empty": ""}[case]
    folder.lock_path.write_text(text)
    os.utime(folder.lock_path, (2e9 * 2, 2e9 * 2))
    assert not folder.locked()
    folder.lock()
    assert folder.locked()
    assert json.loads(folder.lock_path.read_text())["pid"] == os.getpid()
    assert [p.name for p in tmp_path.iterdir()] == ["lock.json"]
    folder.unlock()
    assert not folder.lock_path.exists()


def test_a_living_owner_keeps_its_lock_whatever_the_clock_says(tmp_path: Path) -> None:
    folder = JobFolder(tmp_path)
    parent = os.getppid()
    write_json(folder.lock_path, {"pid": parent, "started": process_start_ticks(parent)})
    for time_s in (0.0, 4e9):
        os.utime(folder.lock_path, (time_s, time_s))
        with pytest.raises(UsageError, match=f"Process {parent} is working"):
            folder.lock()
    assert [p.name for p in tmp_path.iterdir()] == ["lock.json"]


def test_two_that_take_over_at_once_leave_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one has its lock in place between our look at the stale one and our move."""
    folder = JobFolder(tmp_path)
    write_json(folder.lock_path, {"pid": dead_pid(), "started": 1})
    parent = os.getppid()

    def slow(pid: int, started: int) -> bool:
        alive = process_alive(pid, started)
        if not alive:
            write_json(folder.lock_path, {"pid": parent, "started": process_start_ticks(parent)})
        return alive

    monkeypatch.setattr(job_folder, "owner_alive", slow)
    with pytest.raises(UsageError, match=f"Process {parent} is working"):
        folder.lock()
    assert json.loads(folder.lock_path.read_text())["pid"] == parent
    assert [p.name for p in tmp_path.iterdir()] == ["lock.json"]


ELSEWHERE = "attic boot pid:[1]"


@pytest.fixture
def held(tmp_path: Path) -> JobFolder:
    """Return a folder that process 1 of another computer holds."""
    folder = JobFolder(tmp_path / "out")
    folder.create()
    write_json(folder.lock_path, {"pid": 1, "started": 1, "place": ELSEWHERE})
    folder.write_status(JobStatus("RUNNING", pid=1, pid_started=1, place=ELSEWHERE))
    return folder


def age(path: Path, seconds: float) -> None:
    then_s = time.time() - seconds
    os.utime(path, (then_s, then_s))


def test_a_second_client_is_refused_and_told_where_the_first_is(held: JobFolder) -> None:
    assert held.locked()
    with pytest.raises(UsageError, match="Process 1 of attic is working in"):
        held.lock()
    assert held.read_status().state == "RUNNING"


def test_a_silent_computer_loses_the_folder(held: JobFolder) -> None:
    age(held.lock_path, limits.SILENT_S + 20.0)
    age(held.status_path, limits.SILENT_S + 20.0)
    assert not held.locked()
    assert held.read_status().state == "LOST"
    held.lock()
    assert held.locked()


def test_showing_life_keeps_it(held: JobFolder) -> None:
    age(held.lock_path, limits.SILENT_S + 20.0)
    held.show_life()
    assert held.locked()

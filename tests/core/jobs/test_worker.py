# SPDX-License-Identifier: GPL-3.0-or-later
"""Client and worker process together: bad input, cancel, crash, a second worker."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.errors import EXIT_RESOURCES, ParseError, UsageError
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.settings import JobSettings, MeshingSettings
from gaussian_wrapping_addon.core.worker.helper_process import child_command
from gaussian_wrapping_addon.core.worker.spawn import (
    CALLER_OPTION,
    process_alive,
    process_start_ticks,
)

BATCH = Path(__file__).resolve().parents[3] / "gaussian_wrapping_addon" / "batch.py"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    return tmp_path / "photos"


def job_in(source: Path, command: str = "wrap", **settings: Any) -> JobFolder:
    """Return the folder of a job that has not begun."""
    folder = JobFolder(source.parent / "out")
    folder.create()
    write_job(folder.job_path, make_job(command, source, JobSettings(**settings)))
    return folder


def test_an_empty_folder_fails_with_words_and_code_3(source: Path) -> None:
    client = JobClient.start(source.parent / "out", make_job("wrap", source, JobSettings()))
    status = client.wait(60)
    assert (status.state, status.exit_code) == ("FAILED", 3)
    assert status.error
    assert status.hint
    assert not client.folder.lock_path.exists()
    # The file of such a job is changed: to no job, which the client and the worker refuse.
    client.folder.job_path.write_text("{}")
    with pytest.raises(UsageError, match="does not hold the entries of a job"):
        JobClient.resume(client.folder.root)
    done = subprocess.run(child_command("jobs.worker", str(client.folder.root), "0"), check=False)
    assert done.returncode == 2
    assert client.folder.read_status().state == "FAILED"


def test_a_worker_removes_what_killed_ones_left(source: Path) -> None:
    folder = job_in(source)
    left = folder.stages / "train-a" / "gaussians.npz.writing.0123abcd"
    left.parent.mkdir()
    left.touch()
    os.utime(left, (1.0, 1.0))
    JobClient.start(folder.root, make_job("wrap", source, JobSettings())).wait(60)
    assert not list(folder.root.rglob("*.writing.*"))


def test_a_killed_worker_is_lost_and_says_the_signal(source: Path) -> None:
    client = JobClient.start(source.parent / "out", make_job("wrap", source, JobSettings()))
    assert client._process is not None
    os.kill(client._process.pid, signal.SIGKILL)  # at once: an empty folder would end it
    status = client.wait(60)
    assert status.state in ("LOST", "FAILED")
    assert "signal 9: killed, probably out of memory" in status.error
    assert "--max-gaussians 48000" in status.hint  # 0.6 of the default's 80 000


@pytest.mark.parametrize(
    ("command", "stage", "result", "meshing", "wanted", "unwanted"),
    [
        ("mesh", "", True, {}, "--points", "--max-gaussians"),
        ("mesh", "mesh", True, {}, "--set tiles=N. The earlier result is unchanged", "more tiles"),
        ("mesh", "texture", False, {}, "--edge-length", "unchanged"),
        ("mesh", "mesh", True, {"tiles": "4"}, "more tiles", "--max-gaussians"),
        ("mesh", "mesh", True, {"method": "pivots"}, "--set method=pam", "--set tiles"),
        ("wrap", "mesh", True, {}, "--points", "unchanged"),
        ("wrap", "train", False, {}, "--max-gaussians 48000", "--points"),
        ("more", "", True, {}, "--max-gaussians 48000", "--points"),
    ],
)
def test_a_killed_worker_is_told_what_its_stage_can_do_with_less(
    source: Path, command: str, stage: str, result: bool, meshing: dict, wanted: str,
    unwanted: str,
) -> None:  # fmt: skip
    folder = job_in(source, command, meshing=MeshingSettings(**meshing))
    if result:
        folder.result.mkdir()
        write_json(folder.result / "report.json", {})
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        started = process_start_ticks(process.pid)
        folder.write_status(JobStatus("RUNNING", stage, pid=process.pid, pid_started=started))
        client = JobClient(folder, process)
        process.kill()
        status = client.wait(60)
    assert (status.state, status.exit_code) == ("LOST", EXIT_RESOURCES)
    assert wanted in status.hint
    assert unwanted not in status.hint


def test_a_worker_killed_between_two_looks_is_killed_too(source: Path) -> None:
    folder = job_in(source, "mesh")

    class Late(subprocess.Popen):
        """Is killed after it was asked for its code."""

        def poll(self) -> int | None:
            if self.returncode is None:
                os.kill(self.pid, signal.SIGKILL)
                os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT)  # ended, its code is kept
            return self.returncode

    with Late([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        started = process_start_ticks(process.pid)
        folder.write_status(JobStatus("RUNNING", "mesh", pid=process.pid, pid_started=started))
        status = JobClient(folder, process).poll()
    assert "signal 9" in status.error
    assert "--points" in status.hint
    assert status.exit_code == EXIT_RESOURCES


def test_who_may_not_lock_leaves_the_owner_alone(source: Path) -> None:
    folder = job_in(source)
    folder.write_status(JobStatus("CANCELLED"))
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as owner:
        lock = {"pid": owner.pid, "started": process_start_ticks(owner.pid)}
        write_json(folder.lock_path, lock)
        before = folder.status_path.read_bytes()
        with pytest.raises(UsageError, match="running"):
            JobClient.resume(folder.root)
        done = subprocess.run(
            child_command("jobs.worker", str(folder.root), "0"), capture_output=True, check=False
        )
        assert done.returncode == 2
        assert str(owner.pid).encode() in done.stdout
        assert folder.status_path.read_bytes() == before
        assert read_json(folder.lock_path) == lock
        owner.kill()


# A worker that starts late and works until it is told to stop, or for a while.
LATE = """
import sys, time
time.sleep({late_s})
sys.path[:0] = {path!r}
from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.jobs import runner, worker
def run_job(folder, job, event, cancelled):
    end_s = time.monotonic() + {works_s}
    while not cancelled() and time.monotonic() < end_s:
        time.sleep(0.05)
    if cancelled():
        raise Cancelled()
runner.run_job, worker.PARENT_POLL_S = run_job, 0.05
sys.exit(worker.main(sys.argv[1:]))
"""
CALLER = """
import os, sys, time
sys.path[:0] = {path!r}
from pathlib import Path
from gaussian_wrapping_addon.core.jobs import client
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job
from gaussian_wrapping_addon.core.settings import JobSettings
real = client.child_command
def child_command(module, *arguments, python=None):
    command = real(module, *arguments, python=python)
    return [*command[: command.index("-u")], "-c", {late!r}, *arguments]
client.child_command = child_command
root = Path(sys.argv[1])
job = make_job("wrap", root / "photos", JobSettings())
started = client.JobClient.start(root / "out", job, python=sys.executable, keep_running={keep})
sys.stdout.write(str(started._process.pid))
sys.stdout.flush()
time.sleep({alive_s})
os.kill(os.getpid(), 9)
"""


def abandon_worker(root: Path, *, late_s: float, alive_s: float, keep: bool) -> int:
    """Start a worker from a process that is killed; return the worker's pid."""
    (root / "photos").mkdir()
    late = LATE.format(late_s=late_s, works_s=8.0, path=sys.path)
    text = CALLER.format(path=sys.path, late=late, keep=keep, alive_s=alive_s)
    done = subprocess.run(
        [sys.executable, "-c", text, str(root)], capture_output=True, text=True, check=False
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    return int(done.stdout)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="a caller is killed by a signal")
@pytest.mark.parametrize(("late_s", "alive_s"), [(0.4, 0.0), (0.0, 0.05), (0.0, 0.6)])
def test_a_worker_ends_with_its_caller_even_if_that_dies_first(
    tmp_path: Path, late_s: float, alive_s: float
) -> None:
    pid = abandon_worker(tmp_path, late_s=late_s, alive_s=alive_s, keep=False)
    end_s = time.monotonic() + 30.0
    while process_alive(pid, 0) and time.monotonic() < end_s:
        time.sleep(0.02)
    assert not process_alive(pid, 0), "an orphan works on"
    folder = JobFolder(tmp_path / "out")
    assert folder.read_status().state == "CANCELLED"
    assert not folder.locked()


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="a caller is killed by a signal")
def test_a_worker_that_was_told_to_continue_outlives_its_caller(tmp_path: Path) -> None:
    pid = abandon_worker(tmp_path, late_s=0.0, alive_s=0.0, keep=True)
    folder = JobFolder(tmp_path / "out")
    end_s = time.monotonic() + 30.0
    while folder.read_status().state != "RUNNING" and time.monotonic() < end_s:
        time.sleep(0.02)
    time.sleep(0.3)  # several polls
    assert folder.read_status().state == "RUNNING"
    os.kill(pid, signal.SIGKILL)


def test_a_worker_behind_a_launcher_is_not_stopped(source: Path) -> None:
    """In a virtual environment on Windows, the worker's parent is not its caller."""
    folder = job_in(source)
    pid = os.getppid()  # not the worker's parent, which is this process
    caller = f"{CALLER_OPTION}={pid}:{process_start_ticks(pid)}"
    script = LATE.format(late_s=0.0, works_s=0.5, path=sys.path)
    command = [sys.executable, "-X", caller, "-c", script, str(folder.root), "1"]
    done = subprocess.run(command, check=False)
    assert (done.returncode, folder.read_status().state) == (0, "DONE")


def test_results_inside_the_photo_folder_are_refused(source: Path) -> None:
    with pytest.raises(UsageError, match="inside"):
        JobClient.start(source / "out", make_job("wrap", source, JobSettings()))
    assert list(source.iterdir()) == []


def test_a_bad_region_is_refused_before_anything_starts(source: Path) -> None:
    path = source.parent / "r.json"
    for body in ({}, {"version": 1, "vertices": [[0, 0, 0]]}):
        write_json(path, body)
        with pytest.raises(ParseError, match=r"r\.json"):
            make_job("wrap", source, JobSettings(regions=(str(path),)))


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["wrap"], 2),
        (["dance"], 2),
        (["wrap", "photos", "--out", "out", "--no-blend"], 3),
        (["wrap", "photos", "--out", "out", "--edge-length", "nan", "--no-blend"], 2),
        (["wrap", "photos", "--out", "out", "--export", "fbx", "--no-blend"], 2),
    ],
)
def test_exit_codes_of_bad_command_lines(tmp_path: Path, arguments: list[str], code: int) -> None:
    (tmp_path / "photos").mkdir()
    begun_s = time.monotonic()
    done = subprocess.run(
        [sys.executable, str(BATCH), *arguments], cwd=tmp_path, capture_output=True, check=False
    )
    assert done.returncode == code, done.stdout.decode() + done.stderr.decode()
    assert b"Traceback" not in done.stdout + done.stderr
    assert done.stdout.strip()
    assert time.monotonic() - begun_s < 5.0
    assert not (tmp_path / "out").exists()

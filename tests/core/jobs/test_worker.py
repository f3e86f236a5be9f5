# SPDX-License-Identifier: GPL-3.0-or-later
"""Client and worker process together: bad input, cancel, crash, a second worker."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.errors import EXIT_RESOURCES, ParseError, UsageError
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.jobs import client as client_module
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.settings import JobSettings, MeshingSettings
from gaussian_wrapping_addon.core.worker.helper_process import child_command
from gaussian_wrapping_addon.core.worker.spawn import (
    CALLER_OPTION,
    process_alive,
    process_start_ticks,
)

BATCH = Path(__file__).resolve().parents[3] / "gaussian_wrapping_addon" / "batch.py"


def test_an_empty_folder_fails_with_words_and_code_3(tmp_path: Path) -> None:
    source = tmp_path / "photos"
    source.mkdir()
    client = JobClient.start(tmp_path / "out", make_job("wrap", source, JobSettings()))
    status = client.wait(60)
    assert status.state == "FAILED"
    assert status.exit_code == 3
    assert status.error
    assert status.hint
    assert not client.folder.lock_path.exists()


def test_a_killed_worker_is_lost_and_says_the_signal(tmp_path: Path) -> None:
    # A FIFO as a photo keeps the worker from ending by itself only where it is opened; a source
    # that vanishes would end it. So stop the process at once instead, before it can do either.
    source = tmp_path / "photos"
    source.mkdir()
    client = JobClient.start(tmp_path / "out", make_job("wrap", source, JobSettings()))
    assert client._process is not None
    os.kill(client._process.pid, signal.SIGKILL)
    status = client.wait(60)
    assert status.state in ("LOST", "FAILED")
    assert "signal 9: killed, probably out of memory" in status.error
    assert "--max-gaussians 48000" in status.hint  # 0.6 of the default's 80 000


def test_a_worker_removes_what_killed_ones_left(tmp_path: Path) -> None:
    source = tmp_path / "photos"
    source.mkdir()
    folder = JobFolder(tmp_path / "out")
    folder.create()
    left = folder.stages / "train-a" / "gaussians.npz.writing.0123abcd"
    left.parent.mkdir()
    left.touch()
    os.utime(left, (1.0, 1.0))
    JobClient.start(folder.root, make_job("wrap", source, JobSettings())).wait(60)
    assert not left.exists()
    assert not list(folder.root.rglob("*.writing.*"))


@pytest.mark.parametrize(
    ("command", "stage", "result", "meshing", "wanted", "unwanted"),
    [
        ("mesh", "", True, {}, "--points", "--max-gaussians"),
        ("mesh", "mesh", True, {}, "--set tiles=N. The earlier result is unchanged", "more tiles"),
        ("mesh", "texture", False, {}, "--edge-length", "unchanged"),
        ("mesh", "mesh", True, {"tiles": "4"}, "more tiles", "--max-gaussians"),
        ("mesh", "mesh", True, {"method": "pivots"}, "--set method=pam", "--set tiles"),
        ("wrap", "mesh", True, {}, "--points", "unchanged"),
        ("more", "texture", True, {}, "--points", "--max-gaussians"),
        ("wrap", "train", False, {}, "--max-gaussians 48000", "--points"),
        ("more", "", True, {}, "--max-gaussians 48000", "--points"),
    ],
)
def test_a_killed_worker_is_told_what_its_stage_can_do_with_less(
    tmp_path: Path, command: str, stage: str, result: bool, meshing: dict, wanted: str,
    unwanted: str,
) -> None:  # fmt: skip
    (tmp_path / "photos").mkdir()
    folder = JobFolder(tmp_path / "out")
    folder.create()
    settings = JobSettings(meshing=MeshingSettings(**meshing))
    write_job(folder.job_path, make_job(command, tmp_path / "photos", settings))
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


def test_a_worker_killed_between_two_looks_is_killed_too(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    folder = JobFolder(tmp_path / "out")
    folder.create()
    write_job(folder.job_path, make_job("mesh", tmp_path / "photos", JobSettings()))

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


def test_a_locked_folder_is_refused(tmp_path: Path) -> None:
    source = tmp_path / "photos"
    source.mkdir()
    job = make_job("wrap", source, JobSettings())
    JobClient.start(tmp_path / "out", job).wait(60)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        lock = {"pid": other.pid, "started": process_start_ticks(other.pid)}
        write_json(tmp_path / "out" / "lock.json", lock)
        with pytest.raises(UsageError, match="running"):
            JobClient.resume(tmp_path / "out")
        other.kill()


def test_a_worker_that_may_not_lock_leaves_the_owner_alone(tmp_path: Path) -> None:
    source = tmp_path / "photos"
    source.mkdir()
    first = JobClient.start(tmp_path / "out", make_job("wrap", source, JobSettings()))
    first.wait(60)
    folder = first.folder
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as owner:
        lock = {"pid": owner.pid, "started": process_start_ticks(owner.pid)}
        write_json(folder.lock_path, lock)
        before = folder.status_path.read_bytes()
        done = subprocess.run(
            child_command("jobs.worker", str(folder.root), "0"), capture_output=True, check=False
        )
        assert done.returncode == 2
        assert str(owner.pid).encode() in done.stdout
        assert folder.status_path.read_bytes() == before
        assert read_json(folder.lock_path) == lock
        owner.kill()


# A worker that starts late and works until it is told to stop.
LATE = """
import sys, time
time.sleep({late_s})
sys.path[:0] = {path!r}
from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.jobs import runner, worker
def run_job(folder, job, event, cancelled):
    end_s = time.monotonic() + 8.0
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
    late = LATE.format(late_s=late_s, path=sys.path)
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


def test_a_worker_behind_a_launcher_is_not_stopped(tmp_path: Path) -> None:
    """In a virtual environment on Windows, the worker's parent is not its caller."""
    (tmp_path / "photos").mkdir()
    target = JobFolder(tmp_path / "out")
    target.create()
    write_job(target.job_path, make_job("wrap", tmp_path / "photos", JobSettings()))
    script = (
        "import sys, time\n"
        f"sys.path[:0] = {sys.path!r}\n"
        "from gaussian_wrapping_addon.core.errors import Cancelled\n"
        "from gaussian_wrapping_addon.core.jobs import runner, worker\n"
        "def run_job(folder, job, event, cancelled):\n"
        "    time.sleep(0.5)\n"
        "    if cancelled():\n"
        "        raise Cancelled()\n"
        "runner.run_job, worker.PARENT_POLL_S = run_job, 0.05\n"
        "sys.exit(worker.main(sys.argv[1:]))\n"
    )
    pid = os.getppid()  # not the worker's parent, which is this process
    caller = f"{CALLER_OPTION}={pid}:{process_start_ticks(pid)}"
    command = [sys.executable, "-X", caller, "-c", script, str(target.root), "1"]
    done = subprocess.run(command, check=False)
    assert (done.returncode, target.read_status().state) == (0, "DONE")


def test_results_inside_the_photo_folder_are_refused(tmp_path: Path) -> None:
    source = tmp_path / "photos"
    source.mkdir()
    with pytest.raises(UsageError, match="inside"):
        JobClient.start(source / "out", make_job("wrap", source, JobSettings()))
    assert list(source.iterdir()) == []


@pytest.mark.parametrize("body", [{}, {"class_name": "x"}, {"version": 1, "vertices": [[0, 0, 0]]}])
def test_a_bad_region_is_refused_before_anything_starts(tmp_path: Path, body: dict) -> None:
    (tmp_path / "photos").mkdir()
    write_json(tmp_path / "r.json", body)
    settings = JobSettings(regions=(str(tmp_path / "r.json"),))
    with pytest.raises(ParseError, match=r"r\.json"):
        make_job("wrap", tmp_path / "photos", settings)


def test_a_broken_job_file_is_refused_by_the_client_and_by_the_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "photos"
    source.mkdir()
    client = JobClient.start(tmp_path / "out", make_job("wrap", source, JobSettings()))
    client.wait(60)
    client.folder.job_path.write_text("{}")
    with pytest.raises(UsageError, match="does not hold the entries of a job"):
        JobClient.resume(tmp_path / "out")
    job = make_job("wrap", source, JobSettings())
    monkeypatch.setattr(client_module, "read_job", lambda _: job)
    status = JobClient.resume(tmp_path / "out").wait(60)
    assert status.state == "FAILED"
    assert status.exit_code == 2


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ([], 2),
        (["wrap"], 2),
        (["wrap", "photos"], 2),
        (["dance"], 2),
        (["wrap", "missing", "--out", "out", "--no-blend"], 3),
        (["wrap", "photos", "--out", "out", "--no-blend"], 3),
        (["wrap", "photos", "--out", "out", "--texture-size", "big", "--no-blend"], 2),
        (["wrap", "photos", "--out", "out", "--edge-length", "nan", "--no-blend"], 2),
        (["wrap", "photos", "--out", "out", "--export", "fbx", "--no-blend"], 2),
        (["mesh", "--out", "photos", "--no-blend"], 2),
        (["resume", "photos", "--no-blend"], 2),
        (["check", "photos"], 3),
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


def test_job_files_do_not_carry_program_paths(tmp_path: Path) -> None:
    job = make_job("wrap", tmp_path, JobSettings())
    assert "python" not in str(JobFile.from_json(job.to_json()).to_json()).lower()

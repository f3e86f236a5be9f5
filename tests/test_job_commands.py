# SPDX-License-Identifier: GPL-3.0-or-later
"""``status`` and ``cancel``: a job seen and stopped from another terminal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.command_line import job_commands
from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs import client as client_module
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.settings import JobSettings
from gaussian_wrapping_addon.core.worker.spawn import process_alive, process_start_ticks

# A worker that works until it is told to stop, and then for ``deaf_s``.
WORKER = """
import sys, time
sys.path[:0] = {path!r}
from gaussian_wrapping_addon.core.errors import Cancelled
from gaussian_wrapping_addon.core.jobs import runner, worker
from gaussian_wrapping_addon.core.progress import ProgressEvent
def run_job(folder, job, event, cancelled):
    event(ProgressEvent("train", 0.412, "iteration 10 of 20", {{}}, 75.0, ""))
    while not cancelled():
        time.sleep(0.02)
    time.sleep({deaf_s})
    raise Cancelled()
runner.run_job = run_job
sys.exit(worker.main([{root!r}, "0"]))
"""


@pytest.fixture
def folder(tmp_path: Path) -> JobFolder:
    (tmp_path / "photos").mkdir()
    folder = JobFolder(tmp_path / "out")
    folder.create()
    write_job(folder.job_path, make_job("wrap", tmp_path / "photos", JobSettings()))
    folder.write_status(JobStatus("CANCELLED", "train", 0.3))
    return folder


@pytest.fixture
def started(folder: JobFolder) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Receives worker processes, which the test need not end."""
    processes: list[subprocess.Popen[bytes]] = []
    yield processes
    for process in processes:
        process.kill()
        process.wait()


def start_worker(folder: JobFolder, deaf_s: float = 0.0) -> subprocess.Popen[bytes]:
    text = WORKER.format(path=sys.path, root=str(folder.root), deaf_s=deaf_s)
    # As the client does: a module's name in the command line marks a worker.
    process = subprocess.Popen(
        [sys.executable, "-c", text, client_module.WORKER_MODULE], start_new_session=True
    )
    end_s = time.monotonic() + 10.0
    while folder.read_status().state != "RUNNING" or folder.read_status().stage != "train":
        assert time.monotonic() < end_s
        time.sleep(0.02)
    return process


def said(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    capsys.readouterr()
    code = batch.main(list(words))
    return code, capsys.readouterr().out


def test_a_running_job_is_shown_and_cancelled(
    folder: JobFolder, started: list, capsys: pytest.CaptureFixture[str]
) -> None:
    process = start_worker(folder)
    started.append(process)
    code, text = said(capsys, "status", str(folder.root))
    assert code == 0
    assert f"running (process {process.pid})" in text
    assert "[ 41.2 %] train   iteration 10 of 20 · 1 min 15 s left" in text
    code, text = said(capsys, "cancel", str(folder.root))
    assert code == 0
    assert f"cancelled; continue with: resume {folder.root}" in text
    assert process.wait(5) == 5
    code, text = said(capsys, "status", str(folder.root))
    assert text.splitlines()[0] == "cancelled"
    assert f"continue with: resume {folder.root}" in text


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="workers are known on Linux")
def test_a_worker_that_does_not_listen_is_ended(
    folder: JobFolder,
    started: list,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    process = start_worker(folder, deaf_s=60.0)
    started.append(process)
    monkeypatch.setattr(limits, "CANCEL_GRACE_S", 0.3)
    monkeypatch.setattr(client_module, "KILL_GRACE_S", 0.3)
    code, text = said(capsys, "cancel", str(folder.root))
    assert (code, "cancelled; continue" in text) == (0, True)
    assert process.wait(5) == -signal.SIGKILL


def test_a_process_that_is_no_worker_is_not_ended(
    folder: JobFolder,
    started: list,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The pid comes from the folder, which may come from elsewhere."""
    other = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    started.append(other)
    ticks = process_start_ticks(other.pid)
    folder.write_status(JobStatus("RUNNING", "train", pid=other.pid, pid_started=ticks))
    monkeypatch.setattr(limits, "CANCEL_GRACE_S", 0.1)
    monkeypatch.setattr(job_commands, "AFTER_KILL_S", 0.1)
    code, text = said(capsys, "cancel", str(folder.root))
    assert code == 1
    assert f"does not stop. End process {other.pid}" in text
    assert process_alive(other.pid, ticks)


@pytest.mark.parametrize("state", ["DONE", "FAILED", "CANCELLED", "NEW", "RUNNING"])
def test_without_a_running_job_nothing_is_written(
    folder: JobFolder, capsys: pytest.CaptureFixture[str], state: str
) -> None:
    folder.write_status(JobStatus(state, pid=2**30, heartbeat_s=1.0))
    code, text = said(capsys, "cancel", str(folder.root))
    assert (code, text) == (0, f"no job is running in {folder.root}\n")
    assert not folder.cancel_path.exists()


def test_a_worker_that_is_coming_up_is_cancelled_too(
    folder: JobFolder, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.write_status(JobStatus(heartbeat_s=time.time()))
    seen = []

    def ends(_client: JobClient, _seconds: float) -> bool:
        seen.append(folder.cancel_path.exists())
        return True

    monkeypatch.setattr(job_commands, "_ends_within", ends)
    assert said(capsys, "cancel", str(folder.root))[0] == 0
    assert seen == [True]


def test_the_status_of_ended_jobs(folder: JobFolder, capsys: pytest.CaptureFixture[str]) -> None:
    folder.write_status(JobStatus("DONE", "export", 1.0))
    assert said(capsys, "status", str(folder.root)) == (0, f"done\nresults: {folder.result}\n")
    failed = JobStatus("FAILED", "mesh", 0.8, "meshing", error="No\x1b[2J surface.", hint="Look.")
    folder.write_status(failed)
    assert said(capsys, "status", str(folder.root))[1].splitlines() == [
        "failed",
        "[ 80.0 %] mesh    meshing",
        r"error: No\x1b[2J surface. Look.",
        f"continue with: resume {folder.root}",
    ]
    folder.write_status(JobStatus("RUNNING", "train", 0.5, pid=2**30))
    assert said(capsys, "status", str(folder.root))[1].startswith("lost\n")


@pytest.mark.parametrize("command", ["status", "cancel"])
def test_a_folder_without_a_job_is_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    code, text = said(capsys, command, str(tmp_path))
    assert code == 2
    assert "holds no job" in text
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_cancel_makes_no_file_behind_a_link(
    folder: JobFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_json(folder.lock_path, {"pid": os.getpid(), "started": process_start_ticks(os.getpid())})
    folder.cancel_path.symlink_to(tmp_path / "new")
    code, text = said(capsys, "cancel", str(folder.root))
    assert code == 3
    assert "cancel, whole file: it is a link" in text
    assert not (tmp_path / "new").exists()

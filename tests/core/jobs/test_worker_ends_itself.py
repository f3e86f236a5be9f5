# SPDX-License-Identifier: GPL-3.0-or-later
"""A cancelled worker whose main thread does not respond exits by itself, with its helpers."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.names import JOB_MARKER
from gaussian_wrapping_addon.core.worker.spawn import process_alive

DEAF = """
import os, subprocess, sys, threading, time
from pathlib import Path
from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.worker import helper_process
from gaussian_wrapping_addon.core.jobs import worker
from gaussian_wrapping_addon.core.jobs.store.job_folder import (
    JobFolder, JobStatus, process_start_ticks
)
limits.CANCEL_ALONE_S = 0.2
worker.PARENT_POLL_S = 0.05
folder = JobFolder(Path(sys.argv[1]))
folder.lock()
helper = subprocess.Popen(["sleep", "60"], start_new_session=True)
helper_process._running.add(helper)
(folder.root / "helper").write_text(str(helper.pid))
pid = os.getpid()
status = JobStatus(state="RUNNING", pid=pid, pid_started=process_start_ticks(pid))
reporter = worker._Reporter(folder, status)
reporter.write()
threading.Thread(target=reporter.keep_heartbeat, args=(None,), daemon=True).start()
time.sleep(60)
"""


# The phase tells, not the words: nobody waits for a compilation.
COMPILES = DEAF.replace("CANCEL_ALONE_S = 0.2", "CANCEL_ALONE_S = 1000.0").replace(
    "reporter.write()",
    """
from gaussian_wrapping_addon.core.progress import COMPILING, Progress
Progress("train", reporter.event).enter(COMPILING, "any words")
""",
)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc, which Linux has")
@pytest.mark.parametrize("code", [DEAF, COMPILES], ids=["deaf", "compiling"])
def test_a_worker_that_does_not_listen_ends_itself(code: str, tmp_path: Path) -> None:
    folder = JobFolder(tmp_path)
    (tmp_path / JOB_MARKER).touch()
    folder.job_path.write_text("{}")
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], cwd=os.getcwd())
    try:
        end_s = time.monotonic() + 30.0
        while folder.read_status().state != "RUNNING" and time.monotonic() < end_s:
            time.sleep(0.02)
        helper = int((tmp_path / "helper").read_text())
        JobClient.attach(tmp_path).cancel()
        assert process.wait(20) == 5
    finally:
        process.kill()
    assert folder.read_status().state == "CANCELLED"
    assert not folder.locked()
    end_s = time.monotonic() + 5.0
    while process_alive(helper, 0) and time.monotonic() < end_s:
        time.sleep(0.02)
    assert not process_alive(helper, 0), "a helper was left behind"


def test_a_deaf_worker_ends_before_others_end_it_and_both_before_twelve_seconds() -> None:
    assert limits.CANCEL_ALONE_S + 1.0 < limits.CANCEL_GRACE_S
    assert limits.CANCEL_GRACE_S + 2.0 < 12.0


def test_a_status_that_holds_other_things_is_not_taken(tmp_path: Path) -> None:
    folder = JobFolder(tmp_path)
    for text in ('{"state": "RUNNING", "pid": "7"}', '{"fraction": null}', '{"state": "X"}'):
        folder.status_path.write_text(text)
        assert folder.read_status() == JobStatus()

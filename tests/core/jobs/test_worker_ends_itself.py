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
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.names import JOB_MARKER
from gaussian_wrapping_addon.core.worker.spawn import process_alive
from tests.core.jobs.farm_jobs import wait_until

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
    wait_until(lambda: not process_alive(helper, 0), 5.0)  # no helper is left behind
    # It ends before others end it, and both before twelve seconds.
    assert limits.CANCEL_ALONE_S + 1.0 < limits.CANCEL_GRACE_S < 10.0

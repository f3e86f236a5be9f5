# SPDX-License-Identifier: GPL-3.0-or-later
"""A job folder that a process of another computer holds: refused while it shows life."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus

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

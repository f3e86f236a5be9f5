# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs in a folder whose disk does not answer for a while: Blender goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import bpy
import pytest

import gaussian_wrapping_addon
from gaussian_wrapping_addon.core import limits
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobStatus
from gaussian_wrapping_addon.ops import job_timer
from tests.blender.job_play import running_job, status_of

STALL_S = 0.05
POLL_WAIT_S = job_timer.POLL_WAIT_S
"""As people have it; the fixture ``addon`` waits longer, so that one look is enough."""

pytestmark = pytest.mark.usefixtures("ended_workers")


@pytest.fixture
def running(photos: Path, worker: Callable[..., None]) -> Path:
    """A job at work."""
    return running_job(photos, worker)


class SleepingDisk:
    """Looks at a job get no answer until :meth:`wake`; the answer is a status of its own."""

    def __init__(self, folder: Path) -> None:
        self.job = job_timer.jobs[str(folder)]
        self.told = replace(self.job.client.poll(), message="told late")
        self.kills = 0
        self._awake = threading.Event()

    def poll(self) -> JobStatus:
        assert self._awake.wait(60.0)
        return self.told

    def kill(self) -> None:
        self.kills += 1

    def wake(self) -> None:
        status_read = self.job.status_read
        self._awake.set()
        assert status_read is None or status_read.finished(60.0)


@pytest.fixture
def disk(running: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SleepingDisk]:
    sleeping = SleepingDisk(running)
    with monkeypatch.context() as patch:
        patch.setattr(job_timer, "POLL_WAIT_S", POLL_WAIT_S)
        patch.setattr(sleeping.job.client, "poll", sleeping.poll)
        patch.setattr(sleeping.job.client, "kill", sleeping.kill)
        yield sleeping
        sleeping.wake()


def longest_look_s(looks: int) -> float:
    longest_s = 0.0
    for _ in range(looks):
        begun_s = time.perf_counter()
        assert job_timer.poll_jobs()
        longest_s = max(longest_s, time.perf_counter() - begun_s)
    return longest_s


def test_it_holds_nobody_up_and_its_answer_comes_later(running: Path, disk: SleepingDisk) -> None:
    assert min(longest_look_s(4) for _ in range(5)) < STALL_S
    assert status_of(running).message != "told late"
    disk.wake()
    job_timer.poll_jobs()
    assert status_of(running).message == "told late"


def test_a_cancelled_job_is_ended_by_force_all_the_same(running: Path, disk: SleepingDisk) -> None:
    job_timer.poll_jobs()
    job_timer.cancel(str(running))
    now_s = time.monotonic()
    job_timer.poll_jobs(lambda: now_s + limits.CANCEL_GRACE_S - 1.0)
    assert disk.kills == 0
    job_timer.poll_jobs(lambda: now_s + limits.CANCEL_GRACE_S + 1.0)
    assert job_timer.is_running(str(running)), "nothing is known yet"
    end_s = time.monotonic() + 20.0
    while not disk.kills and time.monotonic() < end_s:
        time.sleep(0.01)
    assert disk.kills == 1


@pytest.mark.parametrize("away", ["detached", "another file", "disabled"])
def test_an_answer_that_nobody_waits_for_changes_nothing(
    away: str, running: Path, disk: SleepingDisk
) -> None:
    disk.told = replace(disk.told, state="DONE", result=str(running / "result"))
    job_timer.poll_jobs()
    assert disk.job.status_read is not None
    if away == "detached":
        job_timer.detach(bpy.context.scene)
    elif away == "another file":
        bpy.ops.wm.read_homefile(use_empty=True)
    else:
        gaussian_wrapping_addon.unregister()
    disk.wake()
    job_timer.poll_jobs()
    if away == "disabled":
        gaussian_wrapping_addon.register()
        assert job_timer.jobs == {}
    assert len(bpy.data.objects) == 0

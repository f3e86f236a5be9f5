# SPDX-License-Identifier: GPL-3.0-or-later
"""A job outlives its Blender: killed or quit, and reopened from the saved file by another one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.jobs.client import PYTHON_VARIABLE
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.worker.spawn import process_alive
from tests.blender.job_play import write_fake_python

SCRIPT = Path(__file__).with_name("one_blender.py")
END_S = 30.0


def environment(tmp_path: Path, python: Path) -> dict[str, str]:
    return {
        **os.environ,
        "BLENDER_USER_RESOURCES": str(tmp_path / "profile"),
        PYTHON_VARIABLE: str(python),
        "GW_FAKE": "slow",
    }


def words(stream: Any) -> dict[str, Any]:
    """Return the next line of JSON that a Blender says."""
    for line in stream:
        if line.startswith("{"):
            return dict(json.loads(line))
    pytest.fail("Blender ended without a word")


def wait_until_ended(pid: int) -> None:
    end_s = time.monotonic() + END_S
    while process_alive(pid, 0):
        assert time.monotonic() < end_s, f"process {pid} was left behind"
        time.sleep(0.05)


def kill_and_reopen(
    tmp_path: Path, photos: Path, env: dict[str, str], keep: str, timeout_s: float = 60.0
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Start a job in one Blender, kill it, open the file in another; return what both said."""
    blend = tmp_path / "work.blend"
    command = [sys.executable, str(SCRIPT)]
    first = subprocess.Popen(
        [*command, "start", str(blend), str(photos), keep],
        env=env, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        begun = words(first.stdout)
    finally:
        first.kill()
        first.communicate()
    if keep == "keep":
        time.sleep(1.5)  # longer than a worker needs to see that its parent has gone
        assert process_alive(begun["pid"], 0)
    else:
        wait_until_ended(begun["pid"])
        assert JobFolder(Path(begun["folder"])).read_status().state == "CANCELLED"
    second = subprocess.run(
        [*command, "reopen", str(blend), str(photos)],
        env=env, capture_output=True, text=True, timeout=timeout_s, check=False,
    )  # fmt: skip
    assert second.returncode == 0, second.stdout + second.stderr
    wait_until_ended(begun["pid"])
    return begun, words(iter(second.stdout.splitlines()))


@pytest.mark.parametrize(("keep", "found"), [("end", "CANCELLED"), ("keep", "RUNNING")])
def test_a_killed_blender_finds_its_job_again(
    tmp_path: Path, photos: Path, keep: str, found: str
) -> None:
    env = environment(tmp_path, write_fake_python(tmp_path))
    begun, end = kill_and_reopen(tmp_path, photos, env, keep)
    assert end["found"] == found
    expected = "gwrap.resume_job" if found == "CANCELLED" else "gwrap.cancel_job"
    assert expected in end["offered"]
    assert (end["state"], end["meshes"]) == ("DONE", 1), end["error"]
    assert not JobFolder(Path(begun["folder"])).locked()


def test_quitting_leaves_no_process_behind(tmp_path: Path, photos: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), "quit", str(tmp_path / "work.blend"), str(photos), "end"],
        env=environment(tmp_path, write_fake_python(tmp_path)),
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    wait_until_ended(words(iter(done.stdout.splitlines()))["pid"])


@pytest.mark.proof
@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("keep", "found"), [("end", "CANCELLED"), ("keep", "RUNNING")])
def test_the_same_with_the_real_worker(tmp_path: Path, keep: str, found: str) -> None:
    from tests.synthetic import write_ball_scene

    photos = tmp_path / "ball"
    write_ball_scene(photos)
    env = {**environment(tmp_path, Path(sys.executable)), "GW_WAIT_S": "700"}
    _, end = kill_and_reopen(tmp_path, photos, env, keep, timeout_s=800.0)
    assert end["found"] == found
    assert (end["state"], end["meshes"]) == ("DONE", 1), end["error"]

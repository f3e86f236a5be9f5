# SPDX-License-Identifier: GPL-3.0-or-later
"""A queue of jobs: done though workers are killed; bad ones are named, finished ones kept."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import EXIT_BAD_DATA, EXIT_DONE, EXIT_USAGE
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.processes.helper_process import child_command
from gaussian_wrapping_addon.core.processes.process_identity import process_alive
from tests.core.jobs.farm_jobs import kill, parent_of
from tests.core.jobs.finished_sphere import write_finished_sphere


def queue_of(root: Path, count: int) -> list[str]:
    """Make job folders of spheres, trained and not meshed; return their names."""
    names = [f"ball{number}" for number in range(count)]
    (root / "jobs").mkdir()
    for name in names:
        folder = write_finished_sphere(root / name)
        folder.write_status(JobStatus())
        folder.root.rename(root / "jobs" / name)
    return names


def run_queue(
    root: Path, names: list[str], computers: str, look: Callable[[], None] = lambda: None
) -> tuple[int, list[str]]:
    """Run the queue; return its exit code and what it said."""
    request = {
        "out": str(root / "jobs"), "jobs": names, "computers": computers, "processes": 2,
        "certificates": "",
    }  # fmt: skip
    command = child_command("jobs.queue_process", json.dumps(request))
    lines: list[str] = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:

        def read() -> None:
            assert process.stdout is not None
            for line in process.stdout:
                values = json.loads(line)
                lines.append(values.get("line") or values.get("error") or "")

        reader = threading.Thread(target=read)
        reader.start()
        end_s = time.monotonic() + 400.0
        while process.poll() is None:
            assert time.monotonic() < end_s, lines
            look()
            time.sleep(0.05)
        reader.join()
    return process.returncode, lines


def table_of(root: Path) -> dict[str, dict[str, object]]:
    return {row["name"]: row for row in read_json(root / "jobs" / "queue.json")["jobs"]}


def test_jobs_run_in_turn_and_what_is_done_is_kept(tmp_path: Path) -> None:
    names = queue_of(tmp_path, 2)
    (tmp_path / "jobs" / "broken").mkdir()
    broken = JobFolder(tmp_path / "jobs" / "broken")
    broken.create()
    job = (tmp_path / "jobs" / names[0] / "job.json").read_text()
    broken.job_path.write_text(job.replace("ball0/photos", "no photos"))
    code, lines = run_queue(tmp_path, [*names, "broken"], "")
    assert code == EXIT_BAD_DATA
    table = table_of(tmp_path)
    assert [row["state"] for row in table.values()] == ["done", "done", "failed"]
    assert all(int(str(table[name]["faces"])) > 100 for name in names)
    assert table["broken"]["error"]
    assert any("ball1: done (2 of 3)" in line for line in lines)
    report = tmp_path / "jobs" / names[0] / "result" / "report.json"
    written = report.stat().st_mtime_ns
    code, lines = run_queue(tmp_path, names, "")
    assert code == EXIT_DONE
    assert lines[:2] == ["ball0: was done before", "ball1: was done before"]
    assert report.stat().st_mtime_ns == written


@pytest.mark.timeout(900)
@pytest.mark.skipif(sys.platform == "win32", reason="processes are killed by a signal")
def test_jobs_run_side_by_side_though_two_workers_are_killed(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed: set-up-worker --add farm")
    names = queue_of(tmp_path, 4)
    folders = {name: JobFolder(tmp_path / "jobs" / name) for name in names}
    killed: dict[str, int] = {}
    at_once = [0]

    def look() -> None:
        at_work = []
        for name, folder in folders.items():
            status = folder.read_status()
            if status.state == "RUNNING" and process_alive(status.pid, status.pid_started):
                at_work.append((name, status))
        at_once[0] = max(at_once[0], len(at_work))
        for name, status in at_work:
            if status.stage in ("mesh", "texture") and len(killed) < 2 and name not in killed:
                killed[name] = status.pid
                # First the job's own process, then the Dask worker that it belongs to.
                kill(status.pid if len(killed) == 1 else parent_of(status.pid))

    code, lines = run_queue(tmp_path, names, "local", look)
    assert code == EXIT_DONE, lines
    assert len(killed) == 2
    assert at_once[0] == 2
    assert {row["state"] for row in table_of(tmp_path).values()} == {"done"}
    assert len([line for line in lines if ": done (" in line]) == 4
    assert not any(process_alive(f.read_status().pid, 0) for f in folders.values())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["queue", "none", "--out", "o"], "is not a folder"),
        (["queue", "empty", "--out", "o"], "holds 0 folders"),
        (["queue", "sets", "--out", "sets/o"], "lies inside"),
        (["queue", "sets", "--out", "o"], "can be wrapped"),
    ],
)
def test_folders_that_hold_no_photos_are_refused(
    words: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "sets" / "a").mkdir(parents=True)
    assert batch.main(words) == EXIT_USAGE
    assert says in capsys.readouterr().out
    assert not (tmp_path / "o").exists()

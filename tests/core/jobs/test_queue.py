# SPDX-License-Identifier: GPL-3.0-or-later
"""A queue of jobs: done though workers are killed; bad ones are named, finished ones kept."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon import batch
from gaussian_wrapping_addon.core.errors import EXIT_BAD_DATA, EXIT_DONE, EXIT_USAGE
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.jobs import client, queue_process
from gaussian_wrapping_addon.core.jobs.commands import run_in_worker
from gaussian_wrapping_addon.core.jobs.parts.graph import OTHER_CODE, plan_if_missing
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.worker.helper_process import child_command
from gaussian_wrapping_addon.core.worker.spawn import Caller, process_alive
from tests.core.jobs.farm_jobs import kill, parent_of
from tests.core.jobs.finished_sphere import write_finished_sphere
from tests.synthetic import write_ball_scene


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


@pytest.mark.proof
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
    assert not list((tmp_path / "jobs").rglob("lock*.json"))


ELSEWHERE = {"pid": 1, "started": 1, "place": "attic boot pid:[1]"}
"""Lock of a process on another computer."""


def test_a_changed_job_is_not_done_though_an_earlier_one_is(tmp_path: Path) -> None:
    folder = write_finished_sphere(tmp_path)
    assert not queue_process._is_done(folder), "nothing has made a result"
    folder.result.mkdir()
    assert not queue_process._is_done(folder), "nobody knows for which job"
    job = read_job(folder.job_path)
    plan_if_missing(folder)
    assert queue_process._is_done(folder)
    write_job(folder.job_path, replace(job, settings=replace(job.settings, seed=7)))
    assert not queue_process._is_done(folder)
    write_job(folder.job_path, job)
    folder.write_status(JobStatus("FAILED"))
    assert not queue_process._is_done(folder)


def test_jobs_that_another_process_holds_are_waited_for_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queue_process, "HELD_S", 0.2)
    monkeypatch.setattr(queue_process, "POLL_S", 0.02)
    names = ["a", "b"]
    for name in names:
        (tmp_path / name).mkdir()
        write_finished_sphere(tmp_path / name / "made").root.rename(tmp_path / name / "out")
        write_json(JobFolder(tmp_path / name / "out").lock_path, ELSEWHERE)
    held = JobFolder(tmp_path / "a" / "out")
    assert not queue_process._is_free(held, lambda: False)
    assert not queue_process._is_free(held, lambda: True)
    queue = queue_process._Queue(JobFolder(tmp_path), [f"{name}/out" for name in names], {})
    queue._caller = Caller()
    ended = list(queue._in_turn(queue.names))
    assert [(name, code) for name, code, _ in ended] == [(n, EXIT_USAGE) for n in queue.names]
    assert all("A job is running in" in error for _, _, error in ended)
    monkeypatch.setattr(queue_process, "HELD_S", 60.0)
    threading.Timer(0.1, held.unlock).start()
    assert queue_process._is_free(held, lambda: False)


@pytest.mark.skipif(sys.platform == "win32", reason="a process is ended by a signal")
def test_a_worker_of_another_version_runs_no_job(tmp_path: Path) -> None:
    (name,) = queue_of(tmp_path, 1)
    request = {"out": str(tmp_path / "jobs"), "job": name, "code": "0" * 12}
    command = child_command("jobs.queue_process", json.dumps(request))
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == OTHER_CODE
    assert "Install the same version" in done.stdout
    assert JobFolder(tmp_path / "jobs" / name).read_status().state == "NEW"


def test_what_is_no_queue_and_a_second_one_is_told_and_jobs_run_their_parts_themselves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[dict[str, object]] = []
    monkeypatch.setattr(run_in_worker, "run_in_worker", lambda r, **_: asked.append(r) or 0)
    monkeypatch.setattr(client, "worker_python", lambda *_: sys.executable)
    out = tmp_path / "jobs"
    (tmp_path / "sets" / "a").mkdir(parents=True)
    for sets, place, says in (
        ("none", "jobs", "is not a folder"),
        ("sets/a", "jobs", "holds 0 folders"),
        ("sets", "sets/jobs", "lies inside"),
        ("sets", "jobs", "can be wrapped"),
    ):
        words = ["queue", str(tmp_path / sets), "--out", str(tmp_path / place)]
        assert batch.main(words) == EXIT_USAGE
        assert says in capsys.readouterr().out
        assert not (tmp_path / place).exists()
    (tmp_path / "sets" / "a").rmdir()
    write_ball_scene(tmp_path / "sets" / "ball", photos=4, width=32, height=24)
    words = ["queue", str(tmp_path / "sets"), "--out", str(out), "--computers", "local"]
    assert batch.main(words) == EXIT_DONE
    assert (asked[0]["jobs"], asked[0]["computers"]) == (["ball"], "local")
    # With workers of their own, jobs would wait for places that other jobs hold.
    job = read_job(out / "ball" / "job.json")
    assert job.settings.computers == ""
    write_job(out / "ball" / "job.json", replace(job, settings=replace(job.settings, seed=7)))
    assert batch.main([*words, "--seed", "7"]) == EXIT_DONE
    assert read_job(out / "ball" / "job.json").settings.seed == 7
    write_json(JobFolder(out).lock_path, ELSEWHERE)
    assert batch.main(words) == EXIT_USAGE
    assert f"A queue is running in {out}." in capsys.readouterr().out
    assert read_job(out / "ball" / "job.json").settings.seed == 7, "nothing was written"
    assert len(asked) == 2

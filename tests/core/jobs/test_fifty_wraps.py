# SPDX-License-Identifier: GPL-3.0-or-later
"""Fifty wraps on two processes, killed twice: all done, with the results that they have alone.

Processes are found in ``/proc``, by a variable that all of them inherit from the queue.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.kills import result_contents
from benchmarks.provenance import ROOT
from benchmarks.runs import BATCH
from gaussian_wrapping_addon.core.errors import EXIT_DONE
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.jobs.queue_process import MODULE, TABLE_NAME
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.worker.spawn import process_alive
from tests.core.jobs.farm_jobs import kill, parent_of, wait_until
from tests.core.jobs.finished_sphere import write_cube
from tests.synthetic import write_ball_scene
from tools.version_comparison.contents import differences

WRAPS, PROCESSES, SEED, COMPARED = 50, 2, 0, 6
OPTIONS = (
    "--preset", "draft", "--iterations", "200", "--max-gaussians", "1500", "--points", "500",
    "--texture-size", "128", "--export", "glb,ply", "--threads", "1",
)  # fmt: skip
STAGES = ("train", "mesh", "texture")
DELAY_S = 1.5
"""A strike comes up to so long after its stage has begun: they take some seconds."""

LONGEST_S, LONGEST_END_S = 3600.0, 60.0
MARK = "GW_QUEUE_BENCHMARK"
LEFT_BEHIND = ("lock*.json", "lock.*", "cancel", "*.writing.*", "*.making*", "*.stale")
KEPT_BY_DASK = ("dask-scratch-space", "global.lock", "purge.lock")
"""What Dask keeps beside temporary files for good: an empty folder and two empty files."""


def started(environment: dict[str, str], *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(BATCH), *words, *OPTIONS], cwd=ROOT, env=environment,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def marked_processes(mark: str) -> dict[int, list[str]]:
    """Return the command lines of living processes that have inherited a mark."""
    wanted = f"{MARK}={mark}".encode()
    found = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if wanted not in (path / "environ").read_bytes().split(b"\0"):
                continue
            words = (path / "cmdline").read_bytes().decode(errors="replace").split("\0")
        except OSError:  # it has ended meanwhile
            continue
        if any(words):  # a zombie has none
            found[int(path.name)] = words
    return found


def queue_process(mark: str) -> int:
    """Return the process that is scheduler and client; those of single jobs have its module."""
    lines = marked_processes(mark).items()
    return next(pid for pid, line in lines if MODULE in line and '"jobs"' in line[-2])


def at_work(folders: list[JobFolder]) -> dict[str, tuple[int, str]]:
    """Return process and stage of the jobs that are running."""
    found = {}
    for folder in folders:
        status = folder.read_status()
        if status.state == "RUNNING" and process_alive(status.pid, status.pid_started):
            found[folder.root.name] = (status.pid, status.stage)
    return found


def wait_for_strike(
    process: subprocess.Popen[str], folders: list[JobFolder], stage: str, delay_s: float,
    after_jobs: int, jobs: int,
) -> dict[str, tuple[int, str]]:  # fmt: skip
    """Wait until some jobs are done and so many run, one of them in a stage; return those."""
    while True:
        done = sum(folder.read_status().state == "DONE" for folder in folders)
        if done >= after_jobs and any(now == stage for _, now in at_work(folders).values()):
            time.sleep(delay_s)
            running = at_work(folders)
            if len(running) >= jobs:
                return running
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)


def wrap_alone(photos: Path, out: Path, region: Path) -> None:
    words = ["wrap", str(photos), "--out", str(out), "--region", str(region), "--no-blend"]
    with started(dict(os.environ), *words) as process:
        said, _ = process.communicate(timeout=LONGEST_S)
    assert process.returncode == EXIT_DONE, said


def files_of(job: Path) -> set[str]:
    """Return the files of a result that have content."""
    result = JobFolder(job).result
    found = (path for path in result.rglob("*") if path.is_file() and path.stat().st_size)
    return {path.relative_to(result).as_posix() for path in found}


@pytest.mark.proof
@pytest.mark.timeout(3 * 3600)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are read in /proc")
def test_a_queue_that_is_killed_twice_ends_with_the_results_of_single_wraps(
    tmp_path: Path,
) -> None:
    sets, out, temporary = (tmp_path / name for name in ("sets", "jobs", "temporary"))
    temporary.mkdir()
    names = [f"thing-{number:02d}" for number in range(WRAPS)]
    for number, name in enumerate(names):
        write_ball_scene(sets / name, photos=12 + number // 10, width=64 + number % 10, height=48)
    region = write_cube(tmp_path / "things.json", 1.3)
    wrap_alone(sets / names[0], tmp_path / "warm", region)  # compiles kernels
    mark = f"{os.getpid()}-{time.time_ns()}"
    environment = {**os.environ, MARK: mark, "TMPDIR": str(temporary)}
    words = ["queue", str(sets), "--out", str(out), "--region", str(region)]
    words += ["--computers", "local", "--processes", str(PROCESSES)]
    folders = [JobFolder(out / name) for name in names]
    random = np.random.default_rng(SEED)
    stages, delays_s = random.choice(STAGES, 2), random.uniform(0.0, DELAY_S, 2)
    after = random.integers([1, WRAPS // 2], [WRAPS // 2, WRAPS - 2 * PROCESSES])
    with started(environment, *words) as process:
        # A Dask worker with its job.
        running = wait_for_strike(process, folders, stages[0], delays_s[0], after[0], 1)
        struck = [next((n for n, (_, at) in running.items() if at == stages[0]), min(running))]
        kill(parent_of(running[struck[0]][0]))
        # Scheduler and client with all jobs.
        running = wait_for_strike(process, folders, stages[1], delays_s[1], after[1], PROCESSES)
        struck += running
        kill(queue_process(mark))
        said, _ = process.communicate(timeout=LONGEST_S)
    assert process.returncode != EXIT_DONE
    wait_until(lambda: not marked_processes(mark), LONGEST_END_S)
    with started(environment, *words) as again:
        more, _ = again.communicate(timeout=LONGEST_S)
    assert again.returncode == EXIT_DONE, more
    wait_until(lambda: not marked_processes(mark), LONGEST_END_S)
    assert "Traceback" not in said + more
    rows = read_json(out / TABLE_NAME)["jobs"]
    assert [row["name"] for row in rows if row["state"] != "done"] == []
    assert len(rows) == WRAPS
    assert [path for pattern in LEFT_BEHIND for path in out.rglob(pattern)] == []
    assert [path for path in temporary.rglob("*") if path.name not in KEPT_BY_DASK] == []
    wanted = files_of(tmp_path / "warm")
    assert wanted
    assert [name for name in names if files_of(out / name) != wanted] == []
    others = random.permutation(names).tolist()
    for name in list(dict.fromkeys([*struck, *others]))[: max(COMPARED, len(struck))]:
        alone = tmp_path / "alone" / name
        wrap_alone(sets / name, alone, region)
        contents = result_contents(alone)
        assert len(contents.items) > 100
        assert differences(contents, result_contents(out / name)) == [], name

# SPDX-License-Identifier: GPL-3.0-or-later
"""Run the queue, end a Dask worker with its job, then the queue's own process, and run it again."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.errors import WorkerError
from gaussian_wrapping_addon.core.jobs.queue_process import MODULE
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.processes.process_identity import process_alive

from ..speed_error.runs import BATCH, ROOT
from .processes import POLL_S, marked_environment, parent_of, queue_process, wait_until_gone

PROCESSES = 2
OPTIONS = (
    "--preset", "draft", "--iterations", "200", "--max-gaussians", "1500", "--points", "500",
    "--texture-size", "128", "--export", "glb,ply", "--threads", "1",
)  # fmt: skip
LONGEST_S = 3600.0
LONGEST_END_S = 60.0
STAGES = ("train", "mesh", "texture")
DELAY_S = 1.5
"""A strike comes up to so long after its stage has begun: they take some seconds."""


@dataclasses.dataclass(frozen=True)
class Strike:
    """When something is ended by SIGKILL, drawn from a seed."""

    after_jobs: int
    """Finished by then."""
    stage: str
    """Of a job that is ended."""
    delay_s: float
    """After that stage was seen."""


@dataclasses.dataclass(frozen=True)
class Struck:
    """What a strike met."""

    what: str
    stages: dict[str, str]
    """Jobs that were running in what was ended, and their stages."""
    jobs_done: int


@dataclasses.dataclass(frozen=True)
class Course:
    """What happened from the first command to the end of the second."""

    strikes: tuple[Struck, ...]
    first_code: int
    first_s: float
    end_s: float
    """From the second strike until no process of the queue was left."""
    second_code: int
    second_s: float
    left: tuple[str, ...]
    """Processes that were left after the first or second command."""
    said: str
    """Output of both commands."""


def draw(count: int, seed: int) -> tuple[Strike, Strike]:
    """Draw a strike in the first half of the jobs and one in the second."""
    random = np.random.default_rng(seed)
    edges = [1, count // 2, max(count // 2, count - 2 * PROCESSES)]
    counts = [int(random.integers(a, max(b, a + 1))) for a, b in pairwise(edges)]
    stages = random.choice(STAGES, 2).tolist()
    delays = random.uniform(0.0, DELAY_S, 2).tolist()
    one, two = (Strike(*drawn) for drawn in zip(counts, stages, delays, strict=True))
    return one, two


def command_of(sets: Path, out: Path, region: Path) -> list[str]:
    """Return the command line of the queue."""
    return [
        sys.executable, str(BATCH), "queue", str(sets), "--out", str(out), "--region", str(region),
        "--computers", "local", "--processes", str(PROCESSES), *OPTIONS,
    ]  # fmt: skip


def carry_out(command: list[str], out: Path, names: list[str], seed: int) -> Course:
    """Run the queue of a command to its end with two strikes on the way.

    Raises
    ------
    WorkerError
        The queue ended before it could be struck.
    """
    temporary = out.with_name("temporary")
    temporary.mkdir()
    mark = f"{os.getpid()}-{time.time_ns()}"
    environment = marked_environment(mark, temporary)
    one, two = draw(len(names), seed)
    begun_s = time.monotonic()
    with _started(command, environment) as process:
        struck = [_strike_worker(one, out, names, process)]
        struck.append(_strike_queue(two, out, names, process, mark))
        struck_s = time.monotonic()
        said, _ = process.communicate(timeout=LONGEST_S)
    first_s = time.monotonic() - begun_s
    _, left = wait_until_gone(mark, LONGEST_END_S)
    end_s = time.monotonic() - struck_s
    begun_s = time.monotonic()
    with _started(command, environment) as again:
        more, _ = again.communicate(timeout=LONGEST_S)
    second_s = time.monotonic() - begun_s
    _, left_again = wait_until_gone(mark, LONGEST_END_S)
    lines = (" ".join(line) for line in (*left.values(), *left_again.values()))
    return Course(
        tuple(struck), process.returncode, first_s, end_s, again.returncode, second_s,
        tuple(lines), said + more,
    )  # fmt: skip


def _started(command: list[str], environment: dict[str, str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True,
    )  # fmt: skip


def at_work(out: Path, names: list[str]) -> dict[str, tuple[int, str]]:
    """Return process and stage of the jobs that are running."""
    found = {}
    for name in names:
        status = JobFolder(out / name).read_status()
        if status.state == "RUNNING" and process_alive(status.pid, status.pid_started):
            found[name] = (status.pid, status.stage)
    return found


def _strike_worker(
    strike: Strike, out: Path, names: list[str], process: subprocess.Popen[str]
) -> Struck:
    """End the Dask worker that a job is a child of, and so the job."""
    done, running = _wait_for(strike, out, names, process, 1)
    name = next((n for n, (_, stage) in running.items() if stage == strike.stage), min(running))
    pid, stage = running[name]
    os.kill(parent_of(pid), signal.SIGKILL)
    return Struck("a Dask worker", {name: stage}, done)


def _strike_queue(
    strike: Strike, out: Path, names: list[str], process: subprocess.Popen[str], mark: str
) -> Struck:
    """End the process of the queue, which is scheduler and client, with all its jobs."""
    done, running = _wait_for(strike, out, names, process, PROCESSES)
    os.kill(queue_process(mark, MODULE), signal.SIGKILL)
    stages = {name: stage for name, (_, stage) in running.items()}
    return Struck("the queue: scheduler and client", stages, done)


def _wait_for(
    strike: Strike, out: Path, names: list[str], process: subprocess.Popen[str], jobs: int
) -> tuple[int, dict[str, tuple[int, str]]]:
    """Wait for the moment of a strike; return how many jobs are done, and those that run.

    Parameters
    ----------
    jobs : int
        How many have to run at that moment.
    """
    while True:
        while _done(out, names) < strike.after_jobs or not any(
            stage == strike.stage for _, stage in at_work(out, names).values()
        ):
            if process.poll() is not None:
                said = process.stdout.read() if process.stdout else ""
                raise WorkerError(f"The queue ended before it was struck: {said}")
            time.sleep(POLL_S)
        time.sleep(strike.delay_s)
        running = at_work(out, names)
        if len(running) >= jobs:
            return _done(out, names), running


def _done(out: Path, names: list[str]) -> int:
    return sum(JobFolder(out / name).read_status().state == "DONE" for name in names)

# SPDX-License-Identifier: GPL-3.0-or-later
"""Interrupt the small job in one of the ways, wait for its end, resume it, compare."""

from __future__ import annotations

import contextlib
import datetime
import functools
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from tools.version_comparison.contents import differences

from ..speed_error.runs import BATCH, ROOT
from ..study.record import code_of_tree
from .outcomes import Outcome
from .processes import POLL_S, wait_until_gone, worker_of
from .small_job import LONGEST_S, Reference, result_contents, resume, start
from .trials import CALLER, CALLER_DELAY_S, CANCEL, DISK, LEAST_SHARE, MEMORY, STAGES, START, Trial

WAIT_S = 30.0
"""A process that is left after this long stays."""
LARGE_DISK = "1g"
SHOWN_DIFFERENCES = 5


def carry_out(trial: Trial, reference: Reference, place: Path) -> Outcome:
    """Make one trial in a folder of its own below ``place``, which is removed afterwards."""
    out = place / trial.identity
    limit = _limit(trial, reference)
    with _small_disk(out, limit) if trial.way == DISK else contextlib.nullcontext():
        job = out / "job" if trial.way == DISK else out
        memory = functools.partial(_limit_address_space, limit) if trial.way == MEMORY else None
        process = start(job, memory)
        hit = START
        if trial.way == CALLER:
            _wait_for_worker(job, process)
            time.sleep(trial.share * CALLER_DELAY_S)
            process.kill()
        elif trial.stage:
            hit = _wait_for_moment(trial, reference, job, process)
            _strike(trial, job)
        struck_s = time.monotonic()
        output, errors = process.communicate(timeout=LONGEST_S)
        _, left = wait_until_gone(job, WAIT_S)
        end_s = time.monotonic() - struck_s
        if not trial.stage and trial.way != CALLER:
            hit = JobFolder(job).read_status().stage or START
            end_s = 0.0  # no moment was chosen
        code = None if trial.way == CALLER else process.returncode
        if code == 0:
            hit = ""
        if trial.way == DISK:
            _mount(out, LARGE_DISK, "remount")
        again = resume(job) if code != 0 else None
        apart = differences(reference.contents, result_contents(job))
        said = output + errors + ("" if again is None else again.stdout + again.stderr)
    shutil.rmtree(out)
    lines = (output + errors).strip().splitlines()
    return Outcome(
        trial=trial,
        hit=hit,
        code=code,
        message=_without_places(lines[-1], job) if lines else "",
        end_s=round(end_s, 2),
        left=len(left),
        traceback="Traceback" in said,
        resumed=0 if again is None else again.returncode,
        compared=len(reference.contents.items),
        differences=tuple(f"{name}: {how}" for name, how in apart[:SHOWN_DIFFERENCES]),
        code_name=code_of_tree().name,
        date=datetime.date.today().isoformat(),
    )


def _without_places(text: str, job: Path) -> str:
    """Return a message without the folders of this machine: records are published."""
    return text.replace(str(job), "DIR").replace(str(ROOT), "REPOSITORY")


def _limit(trial: Trial, reference: Reference) -> int:
    """Return the size of the disk, or the limit of the address space; 0 for other ways."""
    if trial.way == DISK:
        return round(max(trial.share, LEAST_SHARE) * reference.disk_bytes)
    if trial.way == MEMORY:
        least = max(trial.share, LEAST_SHARE)
        lowest = reference.packages_bytes // 2
        return round(lowest + least * (reference.peak_bytes - lowest))
    return 0


def _limit_address_space(limit: int) -> None:
    """Limit this process and its children."""
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _wait_for_worker(out: Path, process: subprocess.Popen[str]) -> None:
    while not worker_of(out) and process.poll() is None:
        time.sleep(POLL_S)


def _wait_for_moment(
    trial: Trial, reference: Reference, out: Path, process: subprocess.Popen[str]
) -> str:
    """Wait for the trial's moment; return the stage that the job is at, empty if it has ended."""
    folder = JobFolder(out)
    wanted = STAGES.index(trial.stage)
    _wait_for_worker(out, process)
    while process.poll() is None and STAGES.index(folder.read_status().stage or START) < wanted:
        time.sleep(POLL_S)
    time.sleep(trial.share * reference.stage_seconds.get(trial.stage, 0.0))
    return "" if process.poll() is not None else folder.read_status().stage or START


def _strike(trial: Trial, out: Path) -> None:
    if trial.way == CANCEL:
        subprocess.run(
            [sys.executable, str(BATCH), "cancel", str(out)], capture_output=True, check=False
        )
    elif worker := worker_of(out):
        with contextlib.suppress(ProcessLookupError):
            os.kill(worker, signal.SIGKILL)


@contextlib.contextmanager
def _small_disk(place: Path, size: int) -> Iterator[None]:
    """Mount a disk of a few bytes.

    Raises
    ------
    ResourceError
        This user may not mount one.
    """
    place.mkdir(parents=True)
    _mount(place, str(size))
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def _mount(place: Path, size: str, *options: str) -> None:
    words = ["mount", "-t", "tmpfs", "-o", ",".join([*options, f"size={size}"]), "tmpfs"]
    done = subprocess.run([*words, str(place)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise ResourceError(
            f"A small disk could not be mounted: {done.stderr.strip()}",
            "Run as root, or leave these trials out: --ways kill cancel memory caller.",
        )

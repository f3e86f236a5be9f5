# SPDX-License-Identifier: GPL-3.0-or-later
"""Interrupt jobs and compare what they end in after a resume: ``python -m benchmarks.kills``.

A small job is ended by SIGKILL at random moments of every stage, cancelled, run on disks and in
address spaces that are too small, and left by its caller. Each time it is resumed, and its result
is compared bit for bit with that of the job without interruption. Outcomes are kept in
``benchmarks/records/kills``: what has one is not tried again, so that the command may be stopped at
any time. At the end ``docs/benchmarks/kills.md`` is written. Linux only: processes are found in
``/proc``, and small disks are mounted, which root may do.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import datetime
import functools
import hashlib
import logging
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.errors import (
    EXIT_CANCELLED,
    EXIT_DONE,
    EXIT_RESOURCES,
    ResourceError,
    WorkerError,
)
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.jobs.client import WORKER_MODULE
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.machine import processor_name
from tools.version_comparison.contents import Contents, LeftOut, differences, read_contents

from .provenance import DOCUMENTS, RECORDS, ROOT, code_of_tree, versions, write_page
from .runs import BATCH
from .scenes.cache import ensure_scene
from .tables import Table

KILL, CANCEL, DISK, MEMORY, CALLER = "kill", "cancel", "disk", "memory", "caller"
WAYS = {
    KILL: "worker ended by SIGKILL",
    CANCEL: "cancelled by the command line",
    DISK: "disk full",
    MEMORY: "address space limited",
    CALLER: "caller ended by SIGKILL within 0.5 s of the worker's start",
}
SHARES = {KILL: 1.0, CANCEL: 0.2, DISK: 0.2, MEMORY: 0.2, CALLER: 0.5}
"""Trials of each way, as shares of ``--n``."""

START = "start"
"""Before the first stage: the worker loads its packages."""
STAGES = (START, "cameras", "train", "mesh", "texture", "export")
CALLER_DELAY_S = 0.5
LEAST_SHARE = 0.02
"""Smallest disk, of the room that the job takes; smallest limit of memory, of what its packages
take to the most that it takes."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """One interruption."""

    way: str
    number: int
    stage: str
    """At which it happens; empty where a limit, not a moment, is drawn."""
    share: float
    """Of the stage's time, of the disk's or memory's limit, or of :data:`CALLER_DELAY_S`."""

    @property
    def identity(self) -> str:
        """Key of its outcome."""
        return f"{self.way}-{self.number:03d}"

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return dataclasses.asdict(self)


def draw(count: int, seed: int, ways: tuple[str, ...] = tuple(WAYS)) -> list[Trial]:
    """Draw the trials of a seed: those of more kills begin with those of fewer.

    Parameters
    ----------
    count : int
        Kills; the other ways are tried as often as :data:`SHARES` says, at least once.
    """
    trials = []
    for way in ways:
        digest = hashlib.sha256(f"{seed} {way}".encode()).digest()
        random = np.random.default_rng(int.from_bytes(digest[:8], "little"))
        timed = way in (KILL, CANCEL)
        for number in range(max(round(SHARES[way] * count), 1)):
            stage = STAGES[number % len(STAGES)] if timed else ""
            trials.append(Trial(way, number, stage, round(float(random.uniform()), 4)))
    return trials


POLL_S = 0.02


def processes_of(folder: Path) -> list[int]:
    """Return the processes whose command line names a folder or something in it."""
    name = str(folder).encode()
    return [pid for pid, line in _command_lines() if name in line]


def worker_of(folder: Path) -> int:
    """Return the process number of a job's worker; 0 where there is none."""
    names = (WORKER_MODULE.encode(), str(folder).encode())
    found = (
        pid for pid, line in _command_lines() if all(name in line.split(b"\0") for name in names)
    )
    return next(found, 0)


def wait_until_gone(folder: Path, longest_s: float) -> tuple[float, list[int]]:
    """Wait until no process names a folder; return the seconds, and which are left."""
    begun_s = time.monotonic()
    while left := processes_of(folder):
        if time.monotonic() - begun_s > longest_s:
            break
        time.sleep(POLL_S)
    return time.monotonic() - begun_s, left


def peak_address_space(pid: int) -> int:
    """Return the largest address space that a process has had, in bytes; 0 if it has ended."""
    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    sizes = [line.split()[1] for line in text.splitlines() if line.startswith("VmPeak:")]
    return int(sizes[0]) * 1024 if sizes else 0


def _command_lines() -> list[tuple[int, bytes]]:
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            line = (path / "cmdline").read_bytes()
        except OSError:  # it has ended meanwhile
            continue
        if line:  # a zombie has none
            found.append((int(path.name), line))
    return found


SCENE = "spot"
PHOTOS, WIDTH_PX, HEIGHT_PX = 10, 80, 60
ARGUMENTS = (
    "--preset", "draft", "--iterations", "120", "--max-gaussians", "2000", "--points", "800",
    "--texture-size", "128", "--export", "glb,ply", "--no-blend", "--threads", "1",
)  # fmt: skip
_JOB_POLL_S = 0.01
BLOCK_BYTES = 4096
"""A small disk in memory (tmpfs) rounds files up to pages."""
LONGEST_S = 600.0

LEFT_OUT = (
    LeftOut(r"^stages\[\d+\]\.reused$", "a finished stage is not made again: what resuming is for"),
)
"""What differs after a resume on purpose, besides what two runs of one version differ in."""


@dataclasses.dataclass(frozen=True)
class Reference:
    """The job without interruption."""

    contents: Contents
    stage_seconds: dict[str, float]
    """Time on the clock of each stage, and of the start before the first."""
    disk_bytes: int
    """Most that the folder took at any time."""
    packages_bytes: int
    """Address space of the worker when it began its first stage."""
    peak_bytes: int
    """Largest address space of the worker."""


def scene_folder() -> Path:
    """Return the scene; it is rendered on first use."""
    return ensure_scene(SCENE, photos=PHOTOS, width=WIDTH_PX, height=HEIGHT_PX)


def start(out: Path, prepare: Callable[[], None] | None = None) -> subprocess.Popen[str]:
    """Start the job through the command line, as a user would.

    Parameters
    ----------
    prepare : callable, optional
        Called in the child before it becomes the command, to set limits.
    """
    scene = scene_folder()
    words = ["wrap", str(scene), "--out", str(out), "--region", str(scene / "region.json")]
    return _batch([*words, *ARGUMENTS], prepare)


def resume(out: Path) -> subprocess.CompletedProcess[str]:
    """Resume the job and wait for its end."""
    process = _batch(["resume", str(out), "--no-blend"], None)
    output, errors = process.communicate(timeout=LONGEST_S)
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)


def _batch(words: list[str], prepare: Callable[[], None] | None) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(BATCH), *words],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=prepare,
    )  # fmt: skip


def result_contents(out: Path) -> Contents:
    """Return everything in the result of a job."""
    found = read_contents(out, LEFT_OUT)
    inside = f"{JobFolder(out).result.name}/"
    items = {name: item for name, item in found.items.items() if name.startswith(inside)}
    return Contents(items, found.left_out)


def make_reference(out: Path) -> Reference:
    """Run the job to its end and look what it needs.

    Raises
    ------
    WorkerError
        It failed.
    """
    begun_s = time.monotonic()
    folder, seen, disk, packages, peak = JobFolder(out), {START: begun_s}, 0, 0, 0
    process = start(out)
    while process.poll() is None:
        status, worker = folder.read_status(), worker_of(out)
        if worker:
            peak = max(peak, peak_address_space(worker))
        if status.stage and status.stage not in seen:
            seen[status.stage] = time.monotonic()
            packages = packages or peak
        disk = max(disk, room(out))
        time.sleep(_JOB_POLL_S)
    output, errors = process.communicate()
    if process.returncode != 0:
        raise WorkerError(f"The job without interruption failed: {output}{errors}")
    times = [*seen.values(), time.monotonic()]
    seconds = {
        name: end - begin for name, begin, end in zip(seen, times[:-1], times[1:], strict=True)
    }
    return Reference(result_contents(out), seconds, disk, packages, peak)


def room(folder: Path) -> int:
    """Return the bytes that a folder takes on a disk of pages."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            try:
                size = (Path(place) / name).stat().st_size
            except OSError:  # renamed meanwhile
                continue
            total += -(-size // BLOCK_BYTES) * BLOCK_BYTES
    return total


LONGEST_END_S = 12.0
"""After a moment that was chosen, no process of a job is left after this long."""
CODES: dict[str, tuple[int | None, ...]] = {
    KILL: (EXIT_DONE, EXIT_RESOURCES),
    CANCEL: (EXIT_DONE, EXIT_CANCELLED),
    DISK: (EXIT_DONE, EXIT_RESOURCES),
    MEMORY: (EXIT_DONE, EXIT_RESOURCES),
    CALLER: (None,),
}
"""With which exit codes the interrupted command may end; done, where it ended before."""
PATH = RECORDS / "kills" / "outcomes.json"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One interruption and what came after it."""

    trial: Trial
    hit: str
    """Stage at which it struck; empty: the job had ended, or fitted its limit."""
    code: int | None
    """Exit code of the command that was interrupted; ``None`` where it was the one that was
    killed."""
    message: str
    """Last line of what it said."""
    end_s: float
    """From the interruption until no process of the job was left."""
    left: int
    """Processes that were left at the end."""
    traceback: bool
    """Whether the command or the job's output showed one."""
    resumed: int
    """Exit code of the resume."""
    compared: int
    """Arrays, images, entries of reports and files of the result that were compared."""
    differences: tuple[str, ...]
    """Between its result and that of the job without interruption."""
    code_name: str
    """Version of the program."""
    date: str
    commit: str = ""
    """Empty in records of before it was kept, as is the machine."""
    machine: str = ""

    @property
    def faults(self) -> list[str]:
        """What is not as it should be, in words."""
        found = []
        if self.code not in CODES[self.trial.way]:
            found.append(f"ended with code {self.code}: {self.message}")
        if self.traceback:
            found.append("showed a traceback")
        if self.left:
            found.append(f"left {self.left} processes")
        if self.end_s > LONGEST_END_S:
            found.append(f"ended after {self.end_s:.1f} s")
        if self.resumed:
            found.append(f"resumed with code {self.resumed}")
        if self.differences:
            found.append(f"another result: {'; '.join(self.differences)}")
        return found

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(values: dict[str, Any]) -> Outcome:
        """Return what :meth:`to_json` wrote."""
        trial = Trial(**values["trial"])
        return Outcome(**{**values, "trial": trial, "differences": tuple(values["differences"])})


def read_outcomes(path: Path = PATH) -> dict[str, Outcome]:
    """Return the outcomes so far by the identity of their trials."""
    if not path.is_file():
        return {}
    known = (Outcome.from_json(values) for values in read_json(path)["outcomes"])
    return {outcome.trial.identity: outcome for outcome in known}


def write_outcomes(outcomes: dict[str, Outcome], path: Path = PATH) -> None:
    """Write all outcomes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ordered = [outcomes[name].to_json() for name in sorted(outcomes)]
    write_json(path, {"version": 1, "outcomes": ordered})


WAIT_S = 30.0
"""A process that is left after this long stays."""
LARGE_DISK = "1g"
SHOWN_DIFFERENCES = 5


def carry_out(trial: Trial, reference: Reference, place: Path) -> Outcome:
    """Make one trial in a folder of its own below ``place``, which is removed afterwards."""
    out, code_before = place / trial.identity, code_of_tree()
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
        code_name=code_before.name,
        commit=code_before.commit,
        machine=f"{processor_name()}; {versions()}",
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


PAGE = "kills.md"
COMMAND = "python -m benchmarks.kills"


_NOTE = (
    "Ended before: the job was done at the moment drawn, or fitted the limit drawn. Longest end: "
    "from the interruption until no process of the job was left; at most "
    f"{LONGEST_END_S:.0f} s are right. Disks have 2 to 100 % of the room that the job takes; the "
    "address space is limited to a part between half of what the worker takes before its first "
    "stage and all that the job takes."
)


def write_document(out: Path, outcomes: dict[str, Outcome], count: int) -> Path:
    """Write the page into a folder and return its path."""
    every = list(outcomes.values())
    return write_page(out / PAGE, "Interrupted jobs", [o.commit for o in every], page(every, count))


def page(outcomes: list[Outcome], count: int) -> list[str]:
    """Return the lines of the page below its title."""
    dates = sorted({o.date for o in outcomes})
    codes = sorted({o.code_name for o in outcomes})
    machines = "; ".join(sorted({o.machine for o in outcomes if o.machine})) or "not recorded"
    items = max((o.compared for o in outcomes), default=0)
    faults = [
        f"- {o.trial.identity} (at {o.hit or 'the end'}): {fault}"
        for o in outcomes
        for fault in o.faults
    ]
    lines = [
        f"`{COMMAND} --n {count}`, {' and '.join(dates)}. Machine: {machines}.",
        f"Content of the core (git's tree): {', '.join(codes)}.",
        "",
        f"A small job ({PHOTOS} photos of {WIDTH_PX} x {HEIGHT_PX} pixels with cameras, 1 thread)",
        "goes through all stages by the command line. It is interrupted at a moment drawn from a",
        "seed and resumed, and its result is compared with that of the job without interruption:",
        f"{items} arrays, images, textures, files and entries of reports, bit for bit; times,",
        "dates and wording are left out.",
        "",
        _table(outcomes).markdown(),
        "### What was not as it should be",
        "",
        *(faults or ["Nothing."]),
    ]
    return lines


def _table(outcomes: list[Outcome]) -> Table:
    rows = []
    for way, words in WAYS.items():
        those = [o for o in outcomes if o.trial.way == way]
        if not those:
            continue
        struck = [o for o in those if o.hit]
        stages = ", ".join(
            f"{stage} {n}" for stage in STAGES if (n := sum(o.hit == stage for o in struck))
        )
        timed = way not in (DISK, MEMORY)
        wanted = ", ".join("none" if c is None else str(c) for c in CODES[way] if c != 0)
        rows.append(
            (
                words,
                len(those),
                len(those) - len(struck),
                stages,
                f"{sum(o.code in CODES[way] for o in those)} ({wanted})" if way != CALLER else None,
                sum(not o.traceback for o in those),
                sum(not o.left for o in those),
                f"{max(o.end_s for o in those):.1f}" if timed else None,
                sum(not o.resumed for o in those),
                sum(not o.differences for o in those),
            )
        )
    header = (
        "interruption", "trials", "ended before", "struck at", "right exit code (which)",
        "no traceback", "no process left", "longest end, s", "resumed", "same result",
    )  # fmt: skip
    return Table("Trials", header, rows, (_NOTE,))


_logger = logging.getLogger("benchmarks")


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the trials that have no outcome; return 1 where anything was not as it should be."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.kills",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--n", type=int, default=100, help="kills; other ways in proportion")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ways", nargs="+", choices=tuple(WAYS), default=list(WAYS))
    parser.add_argument("--again", action="store_true", help="forget the outcomes so far")
    parser.add_argument("--document", action="store_true", help="try nothing, write the page")
    parser.add_argument("--out", type=Path, default=DOCUMENTS, help="folder of the page")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    options.out.mkdir(parents=True, exist_ok=True)  # before hours of trials, not after
    outcomes = {} if options.again else read_outcomes()
    trials = draw(options.n, options.seed, tuple(options.ways))
    missing = [trial for trial in trials if trial.identity not in outcomes]
    if missing and not options.document:
        with tempfile.TemporaryDirectory(prefix="kills-") as folder:
            place = Path(folder)
            make_reference(place / "warm")  # compiles kernels
            reference = make_reference(place / "reference")
            _logger.info(
                "undisturbed: %s; %.1f MB on the disk, address space %.2f to %.2f GB",
                ", ".join(f"{k} {v:.1f} s" for k, v in reference.stage_seconds.items()),
                reference.disk_bytes / 1e6, reference.packages_bytes / 1e9,
                reference.peak_bytes / 1e9,
            )  # fmt: skip
            for trial in missing:
                outcome = carry_out(trial, reference, place)
                outcomes[trial.identity] = outcome
                write_outcomes(outcomes)
                _logger.info(
                    "%s at %s: code %s, %s", trial.identity, outcome.hit or "its end",
                    outcome.code, "; ".join(outcome.faults) or "as it should be",
                )  # fmt: skip
    path = write_document(options.out, outcomes, options.n)
    _logger.info("%s", path)
    return int(any(outcome.faults for outcome in outcomes.values()))


if __name__ == "__main__":
    raise SystemExit(main())

# SPDX-License-Identifier: GPL-3.0-or-later
"""The job that is interrupted: a small scene through all stages, and what it needs undisturbed."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from gaussian_wrapping_addon.core.errors import WorkerError
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from tools.version_comparison.contents import Contents, LeftOut, read_contents

from ..scenes import ensure_scene
from ..speed_error.runs import BATCH, ROOT
from .processes import peak_address_space, worker_of
from .trials import START

SCENE = "spot"
PHOTOS, WIDTH_PX, HEIGHT_PX = 10, 80, 60
ARGUMENTS = (
    "--preset", "draft", "--iterations", "120", "--max-gaussians", "2000", "--points", "800",
    "--texture-size", "128", "--export", "glb,ply", "--no-blend", "--threads", "1",
)  # fmt: skip
POLL_S = 0.01
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
        time.sleep(POLL_S)
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

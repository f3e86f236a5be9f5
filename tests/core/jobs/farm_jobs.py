# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs on several processes for tests: start one, look at its parts, end processes of it."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.parts.graph import PartState, read_state
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.settings import MeshingSettings
from gaussian_wrapping_addon.core.worker.spawn import process_alive
from tests.core.jobs.finished_sphere import write_cube, write_finished_sphere

DEADLINE_S = 1500.0
"""Long: on a busy computer each part takes tens of seconds to start."""


def tiled_sphere(root: Path, tiles: int = 3, **changes: object) -> tuple[JobFolder, JobFile]:
    """Return the folder of a finished training of a sphere, and the job that meshes it in tiles."""
    folder = write_finished_sphere(root)
    earlier = read_job(folder.job_path)
    path = write_cube(root / "ball.json")
    settings = dataclasses.replace(
        earlier.settings, meshing=MeshingSettings(points=300, tiles=str(tiles)),
        regions=(str(path),), **changes,
    )  # fmt: skip
    return folder, make_job("mesh", Path(earlier.source), settings)


def run(folder: JobFolder, job: JobFile, look: Callable[[], None] = lambda: None) -> JobStatus:
    """Run a job to its end, looking at it all the time."""
    return wait(JobClient.start(folder.root, job, python=sys.executable), look)


def wait(client: JobClient, look: Callable[[], None] = lambda: None) -> JobStatus:
    """Wait for the end of a job."""
    end_s = time.monotonic() + DEADLINE_S
    while (status := client.poll()).active:
        assert time.monotonic() < end_s, status
        look()
        time.sleep(0.02)
    return status


def states(folder: JobFolder) -> dict[str, PartState]:
    """Return the states of all parts that were begun."""
    names = [path.stem for path in (folder.root / "parts").glob("*.json")]
    return {name: state for name in names if (state := read_state(folder.root, name))}


def running(folder: JobFolder) -> Iterator[tuple[str, PartState]]:
    """Yield the parts that living processes run."""
    for name, state in states(folder).items():
        if state.state == "RUNNING" and process_alive(state.pid, state.pid_started):
            yield name, state


def kind_of(name: str) -> str:
    """Return the kind of a part."""
    return name.partition("-")[0]


def parent_of(pid: int) -> int:
    """Return the parent of a process; 0 if it has ended."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return 0
    return int(text.rsplit(")", 1)[1].split()[1])


def kill(pid: int) -> None:
    """End a process as a power cut does."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def wait_until(what: Callable[[], bool], seconds: float = 20.0) -> None:
    """Wait until something is so."""
    end_s = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end_s
        time.sleep(0.05)


def mesh_in(folder: JobFolder, region: str = "ball") -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a result."""
    with np.load(folder.result / region / "mesh.npz", allow_pickle=False) as arrays:
        return arrays["vertices"], arrays["faces"]


def same_mesh(one: JobFolder, two: JobFolder) -> bool:
    """Return whether the meshes of two results are equal, bit for bit."""
    pairs = zip(mesh_in(one), mesh_in(two), strict=True)
    return all(a.dtype == b.dtype and np.array_equal(a, b) for a, b in pairs)

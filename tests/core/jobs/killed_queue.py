# SPDX-License-Identifier: GPL-3.0-or-later
"""A queue of small wraps that is killed twice: photo sets, strikes, and what is looked at after it.

SIGKILL ends a Dask worker with its job, later the process of the queue, when a seed says so.
Linux only: processes are found in ``/proc``, by a variable that all of them inherit.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.camera_places import Boxes, render
from benchmarks.kills import result_contents
from benchmarks.provenance import ROOT
from benchmarks.runs import BATCH
from benchmarks.scenes.build import SparsePoints, write_colmap
from benchmarks.scenes.geometry import around_thing
from gaussian_wrapping_addon.core.errors import WorkerError
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.jobs.queue_process import MODULE, TABLE_NAME
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.regions.scene_regions import write_region
from gaussian_wrapping_addon.core.regions.shapes import Region
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.worker.spawn import process_alive
from tools.version_comparison.contents import differences

PHOTOS, WIDTH_PX, HEIGHT_PX = 12, 64, 48


DISTANCE = 2.6
"""Of the cameras from the boxes."""


REACH = 0.75
"""The boxes lie within this distance of 0 along each axis."""


_ROOM = 3.2
"""Half a side of the room around them."""


_MOST_BOXES = 3


_POINTS = 4000
"""Sparse points that are tried; those that two photos see are kept."""


def write_photo_sets(folder: Path, count: int, seed: int) -> list[str]:
    """Write photo sets as COLMAP projects into a new folder; return their names in order."""
    names = [f"thing-{number:02d}" for number in range(count)]
    for number, name in enumerate(names):
        _write(folder / name, np.random.default_rng([seed, number]))
    return names


def write_things_region(path: Path) -> Path:
    """Write the region in which the things of all sets lie; return its path."""
    half = np.full(3, REACH + 0.1)
    write_region(path, Region.box(path.stem, -half, half))
    return path


def _write(folder: Path, random: np.random.Generator) -> None:
    (folder / "images").mkdir(parents=True)
    boxes = _draw(random)
    cameras = around_thing(PHOTOS, WIDTH_PX, HEIGHT_PX, DISTANCE, random, "photo")
    photos = [render(boxes, camera) for camera in cameras]
    for camera, photo in zip(cameras, photos, strict=True):
        Image.fromarray(photo).save(folder / "images" / camera.name)
    write_colmap(folder / "sparse" / "0", cameras, seen_points(boxes, cameras, photos, _POINTS))


def _draw(random: np.random.Generator) -> Boxes:
    """Return a room with a few boxes about its middle."""
    lower, upper = [np.full(3, -_ROOM)], [np.full(3, _ROOM)]
    for _ in range(random.integers(1, _MOST_BOXES + 1)):
        half = random.uniform(0.25, 0.45, 3)
        middle = random.uniform(half - REACH, REACH - half)
        lower.append(middle - half)
        upper.append(middle + half)
    first = int(random.integers(1_000_000))
    looks = first + np.arange(6 * len(lower)).reshape(-1, 6)
    return Boxes(np.array(lower), np.array(upper), looks)


def face_points(boxes: Boxes, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return (count, 3) random points of the boxes' faces, evenly by area, and their normals.

    Normals of the first box, which is seen from inside, point inward.
    """
    random = np.random.default_rng(seed)
    size = boxes.upper - boxes.lower
    areas = np.stack([size[:, (a + 1) % 3] * size[:, (a + 2) % 3] for a in range(3)], 1)
    shares = np.repeat(areas, 2, 1).reshape(-1) / (2.0 * areas.sum())
    face = random.choice(len(shares), count, p=shares)
    box, side = face // 6, face % 6
    inside = random.random((count, 3))
    inside[np.arange(count), side // 2] = side % 2
    normals = np.zeros((count, 3))
    normals[np.arange(count), side // 2] = np.where(side % 2 == 1, 1.0, -1.0)
    normals[box == 0] *= -1.0
    return boxes.lower[box] + inside * size[box], normals


def shown_in(
    boxes: Boxes, camera: Camera, points: np.ndarray, far_m: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Return which (n, 3) points a photo shows, rows in increasing order, and at which pixels.

    Points deeper than ``far_m`` are left out.
    """
    pixels, depth = camera.project(points)
    shown = (depth > 0.1) & (depth <= far_m) & (pixels >= 1).all(1)
    shown &= (pixels < (camera.width - 1, camera.height - 1)).all(1)
    rows = np.flatnonzero(shown)
    rows = rows[_in_sight(boxes, camera.center, points[rows])]
    return rows, pixels[rows]


def seen_points(
    boxes: Boxes, cameras: Sequence[Camera], images: Sequence[np.ndarray], count: int
) -> SparsePoints:
    """Return random points of the boxes' faces that at least two photos see, with exact tracks."""
    points, _ = face_points(boxes, count)
    found: list[tuple[int, int, np.ndarray]] = []
    colors = np.zeros((count, 3), np.uint8)
    for index, camera in enumerate(cameras):
        rows, pixels = shown_in(boxes, camera, points)
        at = pixels.astype(np.int64)
        colors[rows] = images[index][at[:, 1], at[:, 0]]
        found += [(row, index, pixel) for row, pixel in zip(rows.tolist(), pixels, strict=True)]
    seen = np.bincount([row for row, _, _ in found], minlength=count)
    number = np.cumsum(seen >= 2) - 1
    kept = sorted((number[row], view, pixel) for row, view, pixel in found if seen[row] >= 2)
    return SparsePoints(
        points[seen >= 2], colors[seen >= 2], np.zeros(int((seen >= 2).sum())),
        np.array([row for row, _, _ in kept], np.int64),
        np.array([view for _, view, _ in kept], np.int64),
        np.array([pixel for _, _, pixel in kept]).reshape(-1, 2),
    )  # fmt: skip


def _in_sight(boxes: Boxes, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Tell which points nothing stands before; the first box is seen from inside and hides none."""
    way = points - eye
    clear = np.ones(len(points), np.bool_)
    if not len(points):
        return clear
    # What lies between is in the box around the eye and all points.
    first_corner, last_corner = np.minimum(way.min(0), 0.0), np.maximum(way.max(0), 0.0)
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    lower, upper = boxes.lower[1:] - eye, boxes.upper[1:] - eye
    between = ((lower <= last_corner) & (upper >= first_corner)).all(1)
    for low, high in zip(lower[between], upper[between], strict=True):
        a, b = low / way, high / way
        first, last = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
        clear &= ~((first < last) & (last > 0.0) & (first < 1.0 - 1e-6))
    return clear


MARK = "GW_QUEUE_BENCHMARK"
"""Environment variable that marks a queue and everything that it starts."""


POLL_S = 0.05


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


def queue_process(mark: str, module: str) -> int:
    """Return the process that holds scheduler and client; 0 where there is none.

    Parameters
    ----------
    module : str
        Its module; the processes of single jobs have the same.
    """
    lines = marked_processes(mark).items()
    return next((pid for pid, line in lines if module in line and '"jobs"' in line[-2]), 0)


def parent_of(pid: int) -> int:
    """Return the parent of a process; 0 if it has ended."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return 0
    return int(text.rsplit(")", 1)[1].split()[1])


def wait_until_gone(mark: str, longest_s: float) -> tuple[float, dict[int, list[str]]]:
    """Wait until no marked process is left; return the seconds, and which are left."""
    begun_s = time.monotonic()
    while (left := marked_processes(mark)) and time.monotonic() - begun_s < longest_s:
        time.sleep(POLL_S)
    return time.monotonic() - begun_s, left


def marked_environment(mark: str, temporary: Path) -> dict[str, str]:
    """Return the environment of a marked queue whose temporary files lie in a folder."""
    return {**os.environ, MARK: mark, "TMPDIR": str(temporary)}


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


SHOWN_DIFFERENCES = 5


LEFT_BEHIND = ("lock*.json", "lock.*", "cancel", "*.writing.*", "*.making*", "*.stale")
"""Patterns of what only exists while something runs."""


KEPT_BY_DASK = ("dask-scratch-space", "global.lock", "purge.lock")
"""What Dask keeps beside temporary files for good: an empty folder and two empty files."""


def table_of(out: Path) -> list[dict[str, Any]]:
    """Return the rows of the queue's table of results."""
    rows: list[dict[str, Any]] = read_json(out / TABLE_NAME)["jobs"]
    return rows


def left_behind(out: Path, temporary: Path) -> list[str]:
    """Return what a queue has left that it should not, as paths within its folders."""
    found = {path for pattern in LEFT_BEHIND for path in out.rglob(pattern)}
    found |= {p for p in temporary.rglob("*") if p.name not in KEPT_BY_DASK}
    return [path.relative_to(out.parent).as_posix() for path in sorted(found)]


def files_of(job: Path) -> set[str]:
    """Return the files of a result that have content."""
    result = JobFolder(job).result
    found = (path for path in result.rglob("*") if path.is_file() and path.stat().st_size)
    return {path.relative_to(result).as_posix() for path in found}


def wrap_alone(photos: Path, out: Path, region: Path) -> None:
    """Make one job by ``wrap`` in one process.

    Raises
    ------
    WorkerError
        It failed.
    """
    words = ["wrap", str(photos), "--out", str(out), "--region", str(region), *OPTIONS]
    done = subprocess.run(
        [sys.executable, str(BATCH), *words, "--no-blend"],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=LONGEST_S,
    )  # fmt: skip
    if done.returncode:
        raise WorkerError(f"The wrap alone failed: {done.stdout}{done.stderr}")


def apart(job: Path, alone: Path) -> tuple[int, list[str]]:
    """Return how many items of two results were compared, and how they differ."""
    one, two = result_contents(alone), result_contents(job)
    found = [f"{name}: {how}" for name, how in differences(one, two)[:SHOWN_DIFFERENCES]]
    return len(one.items), found

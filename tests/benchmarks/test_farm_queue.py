# SPDX-License-Identifier: GPL-3.0-or-later
"""The queue that is killed twice: its photo sets, its moments, what counts as a fault, its page."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.farm_queue.checks import apart, files_of, left_behind
from benchmarks.farm_queue.document import write_document
from benchmarks.farm_queue.outcome import Outcome, read_outcome, write_outcome
from benchmarks.farm_queue.photo_sets import (
    PHOTOS,
    REACH,
    write_photo_sets,
    write_things_region,
)
from benchmarks.farm_queue.processes import (
    marked_environment,
    marked_processes,
    queue_process,
    wait_until_gone,
)
from benchmarks.farm_queue.strikes import DELAY_S, PROCESSES, STAGES, Struck, draw
from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.jobs.queue_process import MODULE
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.regions.region import read_region

ROW = {"name": "thing-00", "state": "done", "seconds": 9.0, "psnr": 14.25, "faces": 996}
GOOD = Outcome(
    0, ({**ROW, "error": ""}, {**ROW, "name": "thing-01", "error": ""}),
    (
        Struck("a Dask worker", {"thing-00": "train"}, 1),
        Struck("the queue", {"thing-01": "mesh"}, 1),
    ),
    1, 60.0, 0.2, 0, 30.0, (), (), (), ("thing-00",), 900, (), False, "0123456789", "AMD EPYC",
    "2026-11-26",
)  # fmt: skip


def test_sets_follow_from_the_seed_and_load_as_projects(tmp_path: Path) -> None:
    names = write_photo_sets(tmp_path / "a", 2, 0)
    assert write_photo_sets(tmp_path / "b", 2, 0) == names == ["thing-00", "thing-01"]
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*")]
    assert len(files) == 2 * (PHOTOS + 3)
    same = [(tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files]
    assert all(same)
    first, second = (sorted((tmp_path / "a" / n / "images").iterdir()) for n in names)
    assert all(a.read_bytes() != b.read_bytes() for a, b in zip(first, second, strict=True))
    scene = load_scene(tmp_path / "a" / names[0], tmp_path / "work", Progress(), threads=1)
    assert len(scene.views) == PHOTOS
    corners = read_region(write_things_region(tmp_path / "things.json")).vertices
    world = scene.world_from_scene.points(scene.points)
    near = (np.abs(world) < np.abs(corners).max()).all(1)
    assert near.sum() > 20
    assert np.abs(world[near]).max() < REACH + 0.01


def test_moments_follow_from_the_seed_and_leave_jobs_to_strike() -> None:
    assert draw(50, 0) == draw(50, 0)
    drawn = [draw(50, seed) for seed in range(200)]
    assert len(set(drawn)) == 200
    assert all(1 <= one.after_jobs < 25 <= two.after_jobs < 50 - PROCESSES for one, two in drawn)
    assert {strike.stage for pair in drawn for strike in pair} == set(STAGES)
    assert all(0.0 <= strike.delay_s <= DELAY_S for pair in drawn for strike in pair)
    assert all(two.after_jobs + PROCESSES <= 8 for _, two in (draw(8, seed) for seed in range(50)))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are read in /proc")
def test_marked_processes_are_found_with_their_children(tmp_path: Path) -> None:
    mark = f"test-{os.getpid()}"
    code = "import subprocess,sys; subprocess.run([sys.executable, '-c', 'input()', *sys.argv[1:]])"
    command = [sys.executable, "-c", code, MODULE, '{"out": "x", "jobs": []}']
    environment = marked_environment(mark, tmp_path)
    with subprocess.Popen(command, stdin=subprocess.PIPE, env=environment) as process:
        while len(found := marked_processes(mark)) < 2:
            assert process.poll() is None
        assert process.pid in found
        assert queue_process(mark, MODULE) in found
        assert queue_process(f"{mark}0", MODULE) == 0
        _, left = wait_until_gone(mark, 0.1)
        assert set(left) == set(found)
        process.communicate(b"\n")
    assert wait_until_gone(mark, 20.0)[1] == {}


def test_what_is_left_is_found(tmp_path: Path) -> None:
    out, temporary = tmp_path / "jobs", tmp_path / "temporary"
    (out / "a" / "result").mkdir(parents=True)
    (temporary / "dask-scratch-space").mkdir(parents=True)
    (temporary / "dask-scratch-space" / "global.lock").touch()
    (out / "a" / "result" / "mesh.ply").write_text("ply")
    (out / "a" / "result" / "empty.ply").touch()
    assert files_of(out / "a") == {"mesh.ply"}
    assert left_behind(out, temporary) == []
    for name in ("lock.json", "cancel", "status.json.writing.01234567", "x.making"):
        (out / "a" / name).touch()
    (temporary / "dask-scratch-space" / "worker-1").mkdir()
    assert left_behind(out, temporary) == [
        "jobs/a/cancel", "jobs/a/lock.json", "jobs/a/status.json.writing.01234567",
        "jobs/a/x.making", "temporary/dask-scratch-space/worker-1",
    ]  # fmt: skip


def test_results_are_compared(tmp_path: Path) -> None:
    for name, values in (("a", [1.0, 2.0]), ("b", [1.0, 2.0]), ("c", [1.0, 2.5])):
        (tmp_path / name / "result").mkdir(parents=True)
        np.savez(tmp_path / name / "result" / "mesh.npz", vertices=np.array(values))
    assert apart(tmp_path / "a", tmp_path / "b") == (2, [])
    _, (line,) = apart(tmp_path / "a", tmp_path / "c")
    assert "result/mesh.npz : vertices" in line


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"rows": ({**ROW, "state": "failed", "error": "No room."},)},
            "thing-00 is failed: No room.",
        ),
        ({"first_code": 0}, "the first command ended with code 0"),
        ({"second_code": 4}, "the second command ended with code 4"),
        ({"processes_left": ("python worker",)}, "left running: python worker"),
        ({"left_behind": ("jobs/a/lock.json",)}, "left behind: jobs/a/lock.json"),
        ({"incomplete": ("thing-01",)}, "not whole: thing-01"),
        ({"differences": ("thing-00, mesh.npz",)}, "another result: thing-00, mesh.npz"),
        ({"traceback": True}, "a traceback was shown"),
    ],
)
def test_each_fault_is_told(change: dict[str, object], words: str, tmp_path: Path) -> None:
    assert GOOD.faults == []
    bad = dataclasses.replace(GOOD, **change)  # type: ignore[arg-type]
    (fault,) = bad.faults
    assert words in fault
    assert f"- {fault}" in write_document(tmp_path, bad).read_text()


def test_the_outcome_is_kept_and_the_page_is_written_from_it(tmp_path: Path) -> None:
    write_outcome(GOOD, tmp_path / "records" / "outcome.json")
    assert read_outcome(tmp_path / "records" / "outcome.json") == GOOD
    text = write_document(tmp_path, GOOD).read_text()
    assert "Nothing." in text
    assert "| 2 of 2 " in text
    assert "a Dask worker, with thing-00 (train), after 1 jobs" in text
    assert [line for line in text.splitlines() if line.startswith("| thing-01 ")]

# SPDX-License-Identifier: GPL-3.0-or-later
"""``run-part``: a job made part by part, as a farm does, is the job; and its exit codes."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.jobs import part_process
from gaussian_wrapping_addon.core.jobs.client import prepare_job
from gaussian_wrapping_addon.core.jobs.parts.graph import (
    PARTS_NAME,
    new_state,
    plan_if_missing,
    read_parts,
    read_state,
    write_parts,
    write_state,
)
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.worker.helper_process import child_command
from tests.core.jobs import farm_jobs
from tests.core.jobs.farm_jobs import mesh_in, same_mesh, states, tiled_sphere, wait_until
from tests.core.jobs.small_disk import fill, mounted_disk


def start(folder: JobFolder, part: str, **changes: object) -> subprocess.Popen[str]:
    request = {
        "out": str(folder.root), "part": part, "threads": 1, "device": "", "attempt": 1,
        "driven": False, **changes,
    }  # fmt: skip
    return subprocess.Popen(
        child_command("jobs.part_process", json.dumps(request)),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


def run(folder: JobFolder, part: str, **changes: object) -> tuple[int, str]:
    """Run a part; return its exit code and what it said."""
    process = start(folder, part, **changes)
    out, errors = process.communicate(timeout=240)
    assert "Traceback" not in errors, errors
    return process.returncode, out


def plan_in(root: Path) -> JobFolder:
    """Return a job of two tiles whose parts are planned and not run."""
    folder, job = tiled_sphere(root, 2)
    prepare_job(folder.root, job)
    plan_if_missing(folder)
    return folder


@pytest.fixture
def planned(tmp_path: Path) -> JobFolder:
    return plan_in(tmp_path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> JobFolder:
    """Run the job in one process."""
    folder, job = tiled_sphere(tmp_path_factory.mktemp("whole"), 2)
    assert farm_jobs.run(folder, job).state == "DONE"
    return folder


def wait_until_begun(folder: JobFolder, part: str) -> None:
    """Wait until a part has a state, which is written as soon as it can be told to end."""
    wait_until(lambda: read_state(folder.root, part) is not None, 60.0)


@pytest.mark.proof
@pytest.mark.timeout(900)
def test_a_job_made_part_by_part_is_the_job(planned: JobFolder, whole: JobFolder) -> None:
    names = [part.name for part in read_parts(planned.root).parts]
    assert len([name for name in names if name.startswith("faces")]) == 2
    assert run(planned, names[-1])[0] == 2, "what it needs is not done"
    for name in names:
        code, said = run(planned, name)
        assert code == 0, said
        assert f"part {name} is done" in said
    assert planned.read_status().state == "DONE"
    assert same_mesh(planned, whole)
    assert run(planned, "plan-ball") == (0, '{"line": "part plan-ball was done before"}\n')


@pytest.mark.proof
@pytest.mark.timeout(900)
def test_a_list_that_cannot_grow_makes_its_tiles_in_one_part(
    planned: JobFolder, whole: JobFolder
) -> None:
    graph = read_parts(planned.root)
    kept = [p for p in graph.parts if p.kind not in ("points", "gather", "faces")]
    kept = [dataclasses.replace(p, needs=("plan-ball",)) if p.kind == "mesh" else p for p in kept]
    write_parts(planned.root, dataclasses.replace(graph, parts=tuple(kept)))
    for part in kept:
        assert run(planned, part.name)[0] == 0
    assert same_mesh(planned, whole)
    assert len(mesh_in(planned)[1]) > 100


def test_exit_codes_say_what_a_farm_may_do(planned: JobFolder) -> None:
    code, said = run(planned, "no-such-part")
    assert (code, "has no part no-such-part" in said) == (1, True)
    code, said = run(planned, "train")
    assert (code, "needs cameras, which is not done" in said) == (2, True)
    graph = read_parts(planned.root)
    write_parts(planned.root, dataclasses.replace(graph, code="0" * 12))
    code, said = run(planned, "cameras")
    assert (code, "Install the same version" in said) == (3, True)
    write_parts(planned.root, dataclasses.replace(graph, plan="other"))
    code, said = run(planned, "cameras")
    assert (code, "planned for another job" in said) == (1, True)
    (planned.root / PARTS_NAME).write_text("{")
    code, said = run(planned, "cameras")
    assert (code, "parts.json" in said) == (1, True)
    write_parts(planned.root, graph)
    assert states(planned) == {}
    planned.cancel_path.touch()
    assert run(planned, "cameras")[0] == 5
    planned.cancel_path.unlink()
    write_state(planned.root, "cameras", new_state(graph.plan, 1))  # of this process, which lives
    code, said = run(planned, "cameras")
    assert (code, f"is run by process {os.getpid()}" in said) == (2, True)


@pytest.mark.proof
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM")
def test_a_part_that_is_told_to_end_says_that_it_may_work_elsewhere(planned: JobFolder) -> None:
    for name in ("cameras", "train"):
        assert run(planned, name)[0] == 0
    process = start(planned, "plan-ball")
    wait_until_begun(planned, "plan-ball")
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=60)
    state = read_state(planned.root, "plan-ball")
    assert state is not None
    assert (process.returncode, state.state) == (2, "FAILED")
    assert "its process was ended" in out
    assert run(planned, "plan-ball")[0] == 0


@pytest.mark.proof
@pytest.mark.skipif(sys.platform == "win32", reason="no small disk is mounted there")
def test_a_part_on_a_full_disk_says_so_and_that_it_may_work_later(tmp_path: Path) -> None:
    with mounted_disk(tmp_path / "disk") as disk:
        folder = plan_in(disk)
        assert run(folder, "cameras")[0] == 0
        fill(disk / "filler")
        code, said = run(folder, "train")  # not even its state can be written
        assert (code, "No room" in said, "Make room" in said) == (2, True, True)
        assert read_state(folder.root, "train") is None
        (disk / "filler").unlink()
        assert run(folder, "train")[0] == 0
        process = start(folder, "plan-ball")
        wait_until_begun(folder, "plan-ball")
        while process.poll() is None:
            fill(disk / "filler")
        said, errors = process.communicate()
        assert "Traceback" not in errors, errors
        assert (process.returncode, "No room" in said) == (2, True)
        state = read_state(folder.root, "plan-ball")
        assert state is not None
        assert (state.state, state.exit_code) == ("FAILED", 2)
        assert "No room" in state.error
        assert not list(disk.rglob("*.writing.*"))
        (disk / "filler").unlink()
        assert run(folder, "plan-ball")[0] == 0


@pytest.mark.proof
@pytest.mark.skipif(sys.platform == "win32", reason="links need rights on Windows")
def test_links_are_refused_wherever_a_part_looks(planned: JobFolder, tmp_path: Path) -> None:
    for name in ("cameras", "train", "plan-ball"):
        assert run(planned, name)[0] == 0
    tiles = next(planned.stages.glob("mesh-ball-*")) / "tiles"
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "kept").write_text("kept")

    def refused(path: Path, target: Path, part: str) -> None:
        earlier = path.with_name("earlier")
        if path.exists():
            path.rename(earlier)
        path.symlink_to(target)
        code, said = run(planned, part)
        assert (code, "is a link" in said or "it is a link" in said) == (1, True), said
        path.unlink()
        if earlier.exists():
            earlier.rename(path)

    tile = "points-ball-0000"
    refused(planned.root / "parts", outside, tile)
    refused(tiles, outside, tile)
    refused(tiles.parent, outside, tile)
    refused(planned.stages / "train-more", outside, tile)
    refused(planned.root / "log.txt", outside / "kept", tile)
    refused(tiles / "plan.npz", outside / "kept", tile)
    refused(tiles / "anything.npz", outside / "kept", "mesh-ball")
    refused(tiles / "points-0000.npz", outside / "kept", tile)
    # What a part replaces is the link, not what it leads to.
    state = planned.root / "parts" / f"{tile}.json"
    state.unlink()
    state.symlink_to(outside / "kept")
    code, said = run(planned, tile)
    assert code == 0, said
    assert not state.is_symlink()
    assert [path.name for path in outside.iterdir()] == ["kept"]
    assert (outside / "kept").read_text() == "kept"


def test_a_part_of_a_tile_looks_at_no_other_tile(
    planned: JobFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[str] = []
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: looked.append(Path(path).name) or scandir(path))
    (planned.stages / "mesh-ball-0" / "tiles").mkdir(parents=True)
    (planned.root / "parts").mkdir(exist_ok=True)
    planned.check_entries(but=part_process.MANY)
    assert {"parts", "tiles"}.isdisjoint(looked)
    assert "mesh-ball-0" in looked
    planned.check_entries()
    assert {"parts", "tiles"} <= set(looked)

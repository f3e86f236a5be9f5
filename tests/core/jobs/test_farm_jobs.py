# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs on a Dask cluster of this computer: the same result, whatever is killed on the way."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.settings import (
    JobSettings,
    MeshingSettings,
    TextureSettings,
    TrainingSettings,
)
from gaussian_wrapping_addon.core.worker.spawn import process_alive
from tests.core.jobs import farm_jobs
from tests.core.jobs.farm_jobs import (
    kill,
    kind_of,
    parent_of,
    running,
    same_mesh,
    states,
    tiled_sphere,
    wait,
    wait_until,
)
from tests.core.jobs.finished_sphere import write_cube
from tests.core.jobs.small_disk import fill, mounted_disk
from tests.synthetic import write_ball_scene
from tools.version_comparison.contents import differences, read_contents

pytest.importorskip("distributed", reason="Dask is not installed: set-up-worker --add farm")
pytestmark = [
    pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="processes are killed by a signal"),
    pytest.mark.timeout(1800),
]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> JobFolder:
    """Mesh the sphere in tiles in one process."""
    folder, job = tiled_sphere(tmp_path_factory.mktemp("alone"))
    assert farm_jobs.run(folder, job).state == "DONE"
    return folder


@pytest.mark.proof
def test_two_processes_make_the_mesh_of_one_though_a_part_of_each_kind_is_killed(
    alone: JobFolder, tmp_path: Path
) -> None:
    folder, job = tiled_sphere(tmp_path, computers="local", processes=2)
    killed: dict[str, int] = {}

    def look() -> None:
        for name, state in running(folder):
            if kind_of(name) not in (*killed, "export"):  # the driver's own
                killed[kind_of(name)] = state.pid
                kill(state.pid)

    status = farm_jobs.run(folder, job, look)
    assert status.state == "DONE", status
    assert {"plan", "points", "gather", "faces", "mesh", "texture"} <= set(killed)
    assert same_mesh(folder, alone)
    attempts = [state.attempts for state in states(folder).values()]
    assert sum(attempts) - len(attempts) >= len(killed) - 2  # cameras and train may end first
    assert not list(running(folder))


@pytest.mark.proof
def test_dask_workers_that_die_are_replaced(alone: JobFolder, tmp_path: Path) -> None:
    folder, job = tiled_sphere(tmp_path, computers="local", processes=2)
    killed: dict[str, tuple[int, int]] = {}

    def look() -> None:
        for name, state in running(folder):
            if kind_of(name) in ("points", "faces") and kind_of(name) not in killed:
                killed[kind_of(name)] = (parent_of(state.pid), state.pid)
                kill(parent_of(state.pid))

    status = farm_jobs.run(folder, job, look)
    assert status.state == "DONE", status
    assert len(killed) == 2
    assert same_mesh(folder, alone)
    assert not any(process_alive(pid, 0) for pair in killed.values() for pid in pair)


@pytest.mark.proof
def test_a_driver_that_dies_leaves_nothing_behind_and_resumes(
    alone: JobFolder, tmp_path: Path
) -> None:
    folder, job = tiled_sphere(tmp_path, computers="local", processes=2)
    client = JobClient.start(folder.root, job, python=sys.executable)
    seen: list[int] = []

    def look() -> None:
        seen.extend(state.pid for name, state in running(folder) if kind_of(name) == "faces")
        if seen:
            kill(folder.read_status().pid)

    assert wait(client, look).state in ("LOST", "FAILED")
    wait_until(lambda: not list(running(folder)))
    done = {name for name, state in states(folder).items() if state.state == "DONE"}
    assert {"plan-ball", "gather-ball", "points-ball-0002"} <= done
    before = {name: states(folder)[name].token for name in done}
    status = wait(JobClient.resume(folder.root, python=sys.executable))
    assert status.state == "DONE", status
    assert same_mesh(folder, alone)
    kept = done - {"cameras"}
    assert {name: states(folder)[name].token for name in kept} == {n: before[n] for n in kept}


@pytest.mark.proof
def test_a_part_that_always_crashes_is_named_and_the_rest_is_done(tmp_path: Path) -> None:
    folder, job = tiled_sphere(tmp_path, computers="local", processes=2)
    times: set[str] = set()

    def look() -> None:
        for name, state in running(folder):
            if name == "faces-ball-0001" and state.token not in times:
                times.add(state.token)
                kill(state.pid)

    status = farm_jobs.run(folder, job, look)
    assert status.state == "FAILED"
    assert "Part faces-ball-0001 failed on" in status.error
    assert "signal 9" in status.error
    assert len(times) == 3
    assert not list(running(folder))
    missing = {"faces-ball-0001", "mesh-ball", "texture-ball", "export"}
    before = {name: state.token for name, state in states(folder).items() if name not in missing}
    assert wait(JobClient.resume(folder.root, python=sys.executable)).state == "DONE"
    after = states(folder)
    kept = set(before) - {"cameras"}
    assert {name: after[name].token for name in kept} == {name: before[name] for name in kept}


@pytest.mark.proof
def test_a_cancelled_job_leaves_nothing_running_and_resumes(
    alone: JobFolder, tmp_path: Path
) -> None:
    folder, job = tiled_sphere(tmp_path, computers="local", processes=2)
    client = JobClient.start(folder.root, job, python=sys.executable)

    def look() -> None:
        if any(kind_of(name) == "points" for name, _ in running(folder)):
            client.cancel()

    assert wait(client, look).state == "CANCELLED"
    wait_until(lambda: not list(running(folder)))
    assert wait(JobClient.resume(folder.root, python=sys.executable)).state == "DONE"
    assert same_mesh(folder, alone)


@pytest.mark.proof
@pytest.mark.parametrize("kind", ["points", "texture"])
def test_a_shared_folder_without_room_ends_the_job_in_one_sentence(
    kind: str, alone: JobFolder, tmp_path: Path
) -> None:
    with mounted_disk(tmp_path / "disk") as disk:
        _fill_and_resume(kind, alone, disk)


def _fill_and_resume(kind: str, alone: JobFolder, disk: Path) -> None:
    folder, job = tiled_sphere(disk, computers="local", processes=2)
    filler = disk / "filler"

    def look() -> None:
        if filler.exists() or any(name.startswith(kind) for name, _ in running(folder)):
            fill(filler)  # again, as something may have been removed

    status = farm_jobs.run(folder, job, look)
    assert status.state == "FAILED", status
    assert "No room" in status.error, status
    assert "Make room on that disk" in status.hint, status
    wait_until(lambda: not list(running(folder)))
    assert not folder.locked()
    assert not list(folder.root.rglob("*.writing.*"))
    filler.unlink()
    status = farm_jobs.run(folder, job)
    assert status.state == "DONE", status
    assert same_mesh(folder, alone)


def small_wrap(root: Path, **changes: object) -> JobFile:
    """Return the job that wraps a small scene with masks and in two tiles."""
    photos = root / "photos"
    if not photos.is_dir():
        write_ball_scene(photos, photos=12, width=64, height=48)
    settings = JobSettings(
        training=TrainingSettings(
            iterations=120, max_gaussians=1500, max_image_px=64
        ),
        meshing=MeshingSettings(points=300, tiles="2"), texture=TextureSettings(size_px=64),
        regions=(str(write_cube(root / "ball.json", 1.3)),), make_masks="region",
        export=("ply", "glb"), threads=1, **changes,
    )  # fmt: skip
    return make_job("wrap", photos, settings)


@pytest.mark.proof
def test_dask_workers_are_killed_in_the_parts_before_training(tmp_path: Path) -> None:
    alone, farmed = JobFolder(tmp_path / "alone"), JobFolder(tmp_path / "farmed")
    assert farm_jobs.run(alone, small_wrap(tmp_path)).state == "DONE"
    killed: dict[str, tuple[int, int]] = {}

    def look() -> None:
        for name, state in running(farmed):
            kind = kind_of(name)
            if kind in ("cameras", "masks") and kind not in killed:
                killed[kind] = (parent_of(state.pid), state.pid)
                kill(parent_of(state.pid))

    job = small_wrap(tmp_path, computers="local", processes=2)
    status = farm_jobs.run(farmed, job, look)
    assert status.state == "DONE", status
    assert set(killed) == {"cameras", "masks"}
    assert not any(process_alive(pid, 0) for pair in killed.values() for pid in pair)
    assert not list(running(farmed))
    made = read_contents(alone.result)
    found = differences(made, read_contents(farmed.result))
    # Only statistics of the mesh say how many processes there were.
    statistics = ("report.json :", "report.md :", "ball/figures.json : provenance.")
    assert [name for name, _ in found if not name.startswith(statistics)] == []
    assert [name for name in made.items if name.endswith(".ply : content")]

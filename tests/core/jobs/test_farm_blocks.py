# SPDX-License-Identifier: GPL-3.0-or-later
"""A training in blocks on two processes: the Gaussians of one, whatever is killed on the way."""

from __future__ import annotations

import dataclasses
import signal
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.gaussians.files import load_gaussians
from gaussian_wrapping_addon.core.jobs.parts.graph import done_state, read_parts
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from tests.core.jobs import farm_jobs
from tests.core.jobs.block_jobs import row_job
from tests.core.jobs.farm_jobs import kill, kind_of, running, same_mesh, states
from tests.core.training.test_trainer import assert_same

pytestmark = [
    pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="processes are killed by a signal"),
    pytest.mark.timeout(900),
]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> JobFolder:
    """Run the job in one process."""
    folder, job = row_job(tmp_path_factory.mktemp("alone"))
    status = farm_jobs.run(folder, job)
    assert status.state == "DONE", status
    return folder


def on_two(job: JobFile) -> JobFile:
    settings = dataclasses.replace(job.settings, computers="local", processes=2)
    return dataclasses.replace(job, settings=settings)


def same_gaussians(folder: JobFolder, other: JobFolder) -> None:
    first, second = (
        load_gaussians(next(f.stages.glob("train-*/gaussians.npz"))) for f in (folder, other)
    )
    assert_same(first, second)


def test_one_process_walks_all_blocks(alone: JobFolder) -> None:
    names = list(states(alone))
    assert {"coarse", "block-0000", "block-0001", "train"} <= set(names)
    report = (alone.result / "report.md").read_text()
    assert "| coarse training |" in report
    assert report.count("| training one block |") == 2
    assert "Trained in 2 blocks" in report


def test_the_coarse_training_is_not_done_without_its_plan(alone: JobFolder) -> None:
    """Who deletes a damaged plan, as is advised, has it made again by any engine."""
    state, plan = states(alone)["coarse"], read_parts(alone.root).plan
    assert done_state(alone.root, "coarse", plan) == state
    files = [alone.root / output for output in state.outputs if output.count("/") == 2]
    files = [path for path in files if path.is_file()]
    assert sorted(path.name for path in files) == ["blocks.json", "blocks.npz"]
    for path in files:
        aside = path.with_name("aside")
        path.rename(aside)
        assert done_state(alone.root, "coarse", plan) is None
        aside.rename(path)


@pytest.mark.proof
def test_two_processes_train_blocks_side_by_side_to_the_same_gaussians(
    alone: JobFolder, tmp_path: Path
) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed: set-up-worker --add farm")
    folder, job = row_job(tmp_path)
    together: set[frozenset[str]] = set()

    def look() -> None:
        together.add(frozenset(name for name, _ in running(folder)))

    status = farm_jobs.run(folder, on_two(job), look)
    assert status.state == "DONE", status
    assert any({"block-0000", "block-0001"} <= names for names in together)
    same_gaussians(folder, alone)
    assert same_mesh(folder, alone)


@pytest.mark.proof
def test_a_part_of_each_kind_is_killed_and_the_gaussians_are_the_same(
    alone: JobFolder, tmp_path: Path
) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed: set-up-worker --add farm")
    folder, job = row_job(tmp_path)
    killed: set[str] = set()

    def look() -> None:
        for name, state in running(folder):
            if kind_of(name) in ("coarse", "block", "train") and name not in killed:
                killed.add(name)
                kill(state.pid)

    status = farm_jobs.run(folder, on_two(job), look)
    assert status.state == "DONE", status
    assert {"coarse", "block-0000", "block-0001"} <= killed
    same_gaussians(folder, alone)
    assert not list(running(folder))

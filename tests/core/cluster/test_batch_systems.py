# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs of batch systems: the script that is submitted, and what cannot stand in one."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import Any

import pytest

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.farm.hosts import Wanted, make_job

SLURM = Wanted("slurm", 8, "32GB", "04:00:00", "gpu", "lab-7", ("--gres=gpu:1",))


@pytest.mark.parametrize(
    ("wanted", "head"),
    [
        (
            SLURM,
            ["#SBATCH -J gaussian-wrapping", "#SBATCH -p gpu", "#SBATCH -A lab-7", "#SBATCH -n 1",
             "#SBATCH --cpus-per-task=8", "#SBATCH --mem=30G", "#SBATCH -t 04:00:00",
             "#SBATCH --gres=gpu:1"],
        ),
        (
            replace(SLURM, system="pbs", directives=("-m n",)),
            ["#PBS -N gaussian-wrapping", "#PBS -q gpu", "#PBS -A lab-7",
             "#PBS -l select=1:ncpus=8:mem=30GB", "#PBS -l walltime=04:00:00", "#PBS -m n"],
        ),
    ],
)  # fmt: skip
def test_the_script_of_a_job(
    wanted: Wanted, head: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("dask_jobqueue", reason="set-up-worker --add farm")
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    job = make_job(
        wanted.validated(), "tls://head:8786", "worker-0", "python3 batch.py farm worker"
    )
    lines = [line for line in job.job_script().splitlines() if line]
    assert lines == ["#!/usr/bin/env bash", *head, "exec python3 batch.py farm worker"]


def test_without_the_commands_of_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("dask_jobqueue", reason="set-up-worker --add farm")
    monkeypatch.setattr(shutil, "which", lambda name: None if name == "scancel" else name)
    with pytest.raises(UsageError, match="There is no scancel on this computer"):
        make_job(SLURM, "tls://head:8786", "worker-0", "true")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"system": "sge"}, "is no batch system"),
        ({"cores": 0}, "--cores is out of range"),
        ({"memory": "32"}, "is no memory"),
        ({"memory": "32GB\nrm"}, "is no memory"),
        ({"time": "soon"}, "is no time"),
        ({"time": "1:00\n"}, "is no time"),
        ({"queue": "a b"}, "is no name of a queue"),
        ({"account": "a\nb"}, "is no name of a queue"),
        ({"directives": ("--a\nrm -r /",)}, "has a line break"),
        ({"directives": ("x" * 501,)}, "has a line break"),
        ({"logs": "/tmp/a\nrm -r x"}, "--logs has a line break"),
    ],
)
def test_what_cannot_stand_in_a_script(change: dict[str, Any], says: str) -> None:
    assert SLURM.validated() is SLURM
    with pytest.raises(UsageError) as caught:
        replace(SLURM, **change).validated()
    assert says in str(caught.value)


@pytest.mark.parametrize("time", ["30", "12:00:00", "2-12:00:00", "240:00:00"])
def test_times(time: str) -> None:
    assert replace(SLURM, time=time).validated().time == time

# SPDX-License-Identifier: GPL-3.0-or-later
"""The mesh stage on a finished training: cameras that the mesh is made from."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from gaussian_wrapping_addon.core.field import depth_samples
from gaussian_wrapping_addon.core.jobs.stages.mesh_stage import run_mesh
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.stage_folder import Stage, read_done
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.jobs.finished_sphere import write_cube, write_finished_sphere

HELD_OUT = {"000.png", "008.png"}
"""Of the twelve photos of the sphere, every eighth."""


def mesh_of(folder: JobFolder, meshing: MeshingSettings) -> Stage:
    """Mesh the cube around the sphere."""
    earlier = read_job(folder.job_path)
    path = write_cube(folder.root / "ball.json")
    settings = dataclasses.replace(earlier.settings, meshing=meshing, regions=(str(path),))
    job: JobFile = make_job("mesh", Path(earlier.source), settings)
    stages = {}
    for name in ("cameras", "train"):
        (found,) = folder.stages.glob(f"{name}-*")
        stages[name] = Stage(name, found.name.partition("-")[2], found, read_done(found), True)
    return run_mesh(
        folder, job, str(path), "ball", stages["cameras"], stages["train"], Progress(), threads=1
    )


@pytest.mark.parametrize("method", ["pam", "pivots"])
def test_every_part_of_the_mesh_stage_uses_the_chosen_cameras(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_finished_sphere(tmp_path)
    sampled = []
    honest = depth_samples.sample_depth_maps

    def watched(gaussians, cameras, *arguments, **named):  # type: ignore[no-untyped-def]
        sampled.append({camera.name for camera in cameras})
        return honest(gaussians, cameras, *arguments, **named)

    monkeypatch.setattr(depth_samples, "sample_depth_maps", watched)
    settings = MeshingSettings(method=method, points=300 if method == "pam" else 0)
    by_default = mesh_of(folder, settings)
    by_all = mesh_of(folder, dataclasses.replace(settings, cameras="all"))
    assert by_default.folder != by_all.folder
    assert by_default.done["provenance"]["cameras"] == "training"
    assert by_default.done["provenance"]["field_cameras"] == 10
    assert by_all.done["provenance"]["field_cameras"] == 12
    assert by_all.done["check"]["good"] is by_default.done["check"]["good"] is True
    assert sampled[1] - sampled[0] == HELD_OUT

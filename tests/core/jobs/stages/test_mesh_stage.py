# SPDX-License-Identifier: GPL-3.0-or-later
"""The mesh stage on a finished training: its cameras, and the mesh of the pivots alone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene
from gaussian_wrapping_addon.core.field import depth_samples
from gaussian_wrapping_addon.core.field.vacancy.vacancy import VacancyField
from gaussian_wrapping_addon.core.gaussians.gaussian_file import load_gaussians
from gaussian_wrapping_addon.core.jobs.stages.mesh_stage import run_mesh
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.stage_folder import Stage, read_done
from gaussian_wrapping_addon.core.mesh.mesh_file import load_mesh
from gaussian_wrapping_addon.core.meshing.points.pivots import pivot_rule
from gaussian_wrapping_addon.core.meshing.tetrahedra.delaunay import bounding_points, delaunay
from gaussian_wrapping_addon.core.meshing.tetrahedra.marching_tetrahedra import (
    bisect,
    marching_tetrahedra,
)
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


@pytest.mark.parametrize(("pivots", "box"), [(2, "normal"), (9, "normal"), (9, "gof")])
def test_a_job_makes_the_mesh_of_the_pivots_alone(
    pivots: int, box: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_finished_sphere(tmp_path)
    monkeypatch.setattr(
        depth_samples, "sample_depth_maps", lambda *_, **__: pytest.fail("sampled depth maps")
    )
    settings = MeshingSettings(
        method="pivots", pivots=pivots, pivot_box=box, pivot_samples="none", min_component_share=0.0
    )
    made = mesh_of(folder, settings)
    mesh = load_mesh(made.folder / "mesh.npz")
    assert made.done["check"]["good"] is True
    # The same by hand: Delaunay tetrahedra of exactly these points, labels, crossing edges.
    arrays = load_gaussians(next(folder.stages.glob("train-*")) / "gaussians.npz").arrays()
    own = pivot_rule(pivots, box)(arrays, np.arange(len(arrays.means)))
    assert made.done["provenance"]["pivots"] == len(own) == pivots * 600
    scene = load_saved_scene(next(folder.stages.glob("cameras-*")))
    ten = [camera for camera in scene.cameras if camera.name not in HELD_OUT]
    field = VacancyField(arrays, ten, threads=1)
    points = np.concatenate([own, bounding_points(own, 0)])
    tetrahedra = delaunay(points, seed=0, progress=Progress())
    inside = np.zeros(len(points), np.bool_)
    inside[: len(own)] = ~field.is_empty(own)
    edges, _ = marching_tetrahedra(tetrahedra, inside)
    begin, end = points[edges[:, 0]], points[edges[:, 1]]
    ends = bisect(begin, end, field.is_empty, np.full(len(edges), 1e-5), Progress())
    expected = (ends[0] + ends[1]) / 2
    # The region's corners lie in the ball's shadow: what the cut there adds is left out.
    found = mesh.vertices[np.linalg.norm(mesh.vertices, axis=1) < 1.2]
    tolerance = 0.02 * 4.5 / 48  # the job brackets to this share of a pixel
    for here, there in ((found, expected), (expected, found)):
        assert np.quantile(cKDTree(there).query(here)[0], 0.99) < tolerance
    assert len(found) == pytest.approx(len(expected), rel=0.05)

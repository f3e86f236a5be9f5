# SPDX-License-Identifier: GPL-3.0-or-later
"""A finished stage whose files are cut, changed or gone is done again; others are re-used."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gaussian_wrapping_addon.core.devices import choose_device
from gaussian_wrapping_addon.core.files import read_json, write_json
from gaussian_wrapping_addon.core.gaussians.files import load_gaussians, save_gaussians
from gaussian_wrapping_addon.core.jobs.stages import training
from gaussian_wrapping_addon.core.jobs.stages.cameras import run_cameras
from gaussian_wrapping_addon.core.jobs.stages.meshing import DENSE_MESH, load_region, run_mesh
from gaussian_wrapping_addon.core.jobs.stages.texture import run_texture
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile, make_job, read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.stage_folder import DONE_NAME, Stage, read_done
from gaussian_wrapping_addon.core.loading import load
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh, load_mesh, save_mesh
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene import scene
from gaussian_wrapping_addon.core.scene import scene as scene_file
from gaussian_wrapping_addon.core.scene.scene import POSES_NAME, load_refined_scene, save_poses
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.jobs.finished_sphere import write_cube, write_finished_sphere


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def turn_a_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


PROCESSOR = choose_device("cpu")
damaged = pytest.mark.parametrize("damage", [cut, turn_a_bit, Path.unlink])


@pytest.fixture
def folder(tmp_path: Path) -> JobFolder:
    return write_finished_sphere(tmp_path)


def run(folder: JobFolder) -> tuple[JobFile, Stage, Stage]:
    """Run the first two stages."""
    job = read_job(folder.job_path)
    cameras = run_cameras(folder, job, Progress(), threads=1)
    trained = training.TrainingStages(folder, job, cameras, 1, PROCESSOR).run(Progress())
    return job, cameras, trained


@damaged
@pytest.mark.parametrize("name", [scene_file.POINTS_NAME, scene_file.SCENE_NAME])
def test_damaged_cameras_are_loaded_again(
    folder: JobFolder, name: str, damage: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == scene_file.SCENE_NAME and damage is turn_a_bit:
        pytest.skip("a changed digit is still JSON")
    _, cameras, _ = run(folder)
    scene = scene_file.load_saved_scene(cameras.folder)
    monkeypatch.setattr(load, "load_scene", lambda *_, **__: scene)
    damage(cameras.folder / name)
    _, again, trained = run(folder)
    assert (cameras.reused, again.reused, trained.reused) == (True, False, True)
    assert np.array_equal(scene_file.load_saved_scene(again.folder).points, scene.points)


@damaged
@pytest.mark.parametrize("name", [training.GAUSSIANS_NAME, POSES_NAME])
def test_a_damaged_training_is_trained_again(
    folder: JobFolder, name: str, damage: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, cameras, trained = run(folder)
    scene = scene_file.load_saved_scene(cameras.folder)
    poses = np.array([view.camera.cam_from_world for view in scene.views])
    done = trained.folder / DONE_NAME
    write_json(done, {**read_json(done), training.REFINED: True})
    save_poses(trained.folder, poses)
    gaussians = load_gaussians(trained.folder / training.GAUSSIANS_NAME)

    def train(_: object, stage_folder: Path, *_more: object) -> dict[str, Any]:
        save_gaussians(stage_folder / training.GAUSSIANS_NAME, gaussians)
        save_poses(stage_folder, poses)
        return {training.REFINED: True}

    monkeypatch.setattr(training.TrainingStages, "_in_one_piece", train)
    assert run(folder)[2].reused
    damage(trained.folder / name)
    _, cameras, again = run(folder)
    assert (cameras.reused, again.reused) == (True, False)
    assert np.array_equal(
        load_gaussians(again.folder / training.GAUSSIANS_NAME).means, gaussians.means
    )
    found = load_refined_scene(cameras.folder, again.folder)
    assert np.array_equal([view.camera.cam_from_world for view in found.views], poses)
    assert run(folder)[2].reused


@damaged
@pytest.mark.parametrize("name", ["mesh.npz", DENSE_MESH])
def test_a_damaged_mesh_is_made_again(
    folder: JobFolder, name: str, damage: Callable[[Path], None]
) -> None:
    if name == DENSE_MESH and damage is Path.unlink:
        pytest.skip("a mesh that was not decimated has none")
    earlier, cameras, trained = run(folder)
    path = write_cube(folder.root / "ball.json")
    meshing = MeshingSettings(
        method="pivots", pivots=2, pivot_samples="none", min_component_share=0.0
    )
    settings = dataclasses.replace(earlier.settings, meshing=meshing, regions=(str(path),))
    job = make_job("mesh", Path(earlier.source), settings)

    def mesh() -> Stage:
        return run_mesh(
            folder, job, str(path), "ball", trained, Progress(), device=PROCESSOR,
            load=lambda device: load_region(job, str(path), cameras, trained, device, 1),
        )  # fmt: skip

    made = mesh()
    first = load_mesh(made.folder / "mesh.npz")
    if name == DENSE_MESH:
        save_mesh(made.folder / name, SurfaceMesh(first.vertices, first.faces))
    assert mesh().reused
    damage(made.folder / name)
    assert not mesh().reused
    assert np.array_equal(load_mesh(made.folder / "mesh.npz").vertices, first.vertices)


@damaged
def test_a_damaged_textured_mesh_is_made_again(
    folder: JobFolder, damage: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    class BegunAgainError(Exception):
        pass

    def begin(*_: Path) -> None:
        raise BegunAgainError

    monkeypatch.setattr(scene, "load_refined_scene", begin)  # what the work begins with
    job, cameras, trained = run(folder)
    meshed = Stage("mesh-ball", "key", folder.stages / "mesh-ball-key", {}, True)

    def texture() -> Stage:
        return run_texture(folder, job, "ball", cameras, trained, meshed, Progress(), threads=1)

    with pytest.raises(BegunAgainError):
        texture()
    (stage,) = folder.stages.glob("texture-ball-*")
    (stage / "files").mkdir()
    save_mesh(stage / "files" / "mesh.npz", SurfaceMesh(np.eye(3), np.array([[0, 1, 2]])))
    write_json(stage / "done.json", {"seconds": 1.0})
    assert texture().reused
    damage(stage / "files" / "mesh.npz")
    with pytest.raises(BegunAgainError):
        texture()
    assert read_done(stage) is None
